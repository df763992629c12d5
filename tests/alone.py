"""A pytest plugin: tests marked `alone` run while no other test of the run does, for they measure time.

The other processes of the run wait meanwhile; of several runs on a machine, one at a time measures. The waiting is in
no test's time.
"""

import contextlib
import fcntl
import os
import tempfile
import time
from pathlib import Path

import pytest

# So long may another test take; then nobody waits for it any more.
PATIENCE_S = 300.0


class Turns:
    """Who may run now, kept in locks of files, which end with the processes that hold them.

    Parameters
    ----------
    machine : Path
        File of those who measure, of all runs.
    run : Path, optional
        Folder of two files, the same for all processes of a run; not needed by a single one.
    patience_s : float
        For how long a lock is waited for.
    """

    def __init__(self, machine: Path, run: Path | None = None, patience_s: float = PATIENCE_S):
        self._patience_s = patience_s
        self._measuring = _opened(machine)
        # Who waits to be alone in the room stands in the door, so that nobody else comes in.
        self._door, self._room = (_opened(run / name) for name in ("door", "room")) if run else (None, None)

    @contextlib.contextmanager
    def beside_others(self):
        """Be in the room, with others of the run."""
        with self._held(self._door, fcntl.LOCK_EX):
            entering = contextlib.ExitStack()
            entering.enter_context(self._held(self._room, fcntl.LOCK_SH))
        with entering:
            yield

    @contextlib.contextmanager
    def alone(self):
        """Be in the room when all others have left it, and nobody of another run measures."""
        with (
            self._held(self._measuring, fcntl.LOCK_EX),
            self._held(self._door, fcntl.LOCK_EX),
            self._held(self._room, fcntl.LOCK_EX),
        ):
            yield

    @contextlib.contextmanager
    def _held(self, file, how):
        held = file is not None and self._lock(file, how)
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


def _opened(path: Path) -> int:
    return os.open(path, os.O_CREAT | os.O_RDWR)


class AlonePlugin:
    """Gives every test its turn."""

    def __init__(self, config: pytest.Config):
        worker = hasattr(config, "workerinput")
        machine = Path(tempfile.gettempdir()) / f"softtissue-tests-measuring-{os.getuid()}"
        self._turns = Turns(machine, Path(config.option.basetemp).parent if worker else None)

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        # At the end, where each of them stops others only once.
        items.sort(key=measures)

    # First, so that pytest-timeout, which counts all that it wraps, does not count the waiting.
    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item):
        with self._turns.alone() if measures(item) else self._turns.beside_others():
            return (yield)


def measures(item: pytest.Item) -> bool:
    """Tell whether a test is marked `alone`."""
    return item.get_closest_marker("alone") is not None
