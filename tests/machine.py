"""A pytest plugin: tests marked `alone` run while no other test on this machine does, for they measure time.

Other processes of the same run wait meanwhile, and so do other runs, of this checkout or another one. The waiting is
in no test's time.
"""

import contextlib
import fcntl
import os
import tempfile
import time
from pathlib import Path

import pytest

# So long may a test of another run take; then nobody waits for it any more.
PATIENCE_S = 300.0


class Machine:
    """Whether tests run beside each other, kept in locks of files, which end with the processes that hold them.

    Parameters
    ----------
    folder : Path
        Of the two files; the same for all who wait for each other.
    patience_s : float
        For how long a lock is waited for.
    """

    def __init__(self, folder: Path, patience_s: float = PATIENCE_S):
        folder.mkdir(parents=True, exist_ok=True)
        self._patience_s = patience_s
        # Who waits to be alone stands in the door, so that nobody else comes in.
        self._door, self._room = (os.open(folder / name, os.O_CREAT | os.O_RDWR) for name in ("door", "room"))

    @contextlib.contextmanager
    def beside_others(self):
        """Be in the room, with others."""
        with self._locked(self._door, fcntl.LOCK_EX):
            entered = self._lock(self._room, fcntl.LOCK_SH)
        try:
            yield
        finally:
            if entered:
                fcntl.flock(self._room, fcntl.LOCK_UN)

    @contextlib.contextmanager
    def alone(self):
        """Be in the room when all others have left it."""
        with self._locked(self._door, fcntl.LOCK_EX), self._locked(self._room, fcntl.LOCK_EX):
            yield

    @contextlib.contextmanager
    def _locked(self, file, how):
        held = self._lock(file, how)
        try:
            yield
        finally:
            if held:
                fcntl.flock(file, fcntl.LOCK_UN)

    def _lock(self, file, how) -> bool:
        end = time.monotonic() + self._patience_s
        while True:
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(file, how | fcntl.LOCK_NB)
                return True
            if time.monotonic() > end:
                return False
            time.sleep(0.005)


class AlonePlugin:
    """Gives every test the machine as it needs it."""

    def __init__(self):
        self._machine = Machine(Path(tempfile.gettempdir()) / f"softtissue-tests-{os.getuid()}")

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        # At the end, where each of them stops others only once.
        items.sort(key=needs_the_machine)

    # First, so that pytest-timeout, which counts all that it wraps, does not count the waiting.
    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item):
        machine = self._machine
        with machine.alone() if needs_the_machine(item) else machine.beside_others():
            return (yield)


def needs_the_machine(item) -> bool:
    return item.get_closest_marker("alone") is not None
