"""Temporary files and child processes, which are gone however the program ends.

What is at work is known here, so that a program that cannot wait for its threads can still clean up (`clear`). What a
killed program leaves is removed by the next one.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

from softtissue_estimator.errors import SoftTissueError

_PREFIX = "softtissue_"
_STALE_S = 3600.0  # older, and its process gone: nobody needs it (processes of other containers are not seen)
_GRACE_S = 0.3  # for what a child may still clean up
_LOOK_S = 0.05
_MOST_PRINTED = 65_536  # bytes that are kept of what a program prints
_CONTAINED = Path(__file__).with_name("contained.py")

_lock = threading.RLock()
_paths: set[Path] = set()
_children: set["subprocess.Popen[bytes]"] = set()
_ending = False


@contextlib.contextmanager
def temporary(path: Path) -> Iterator[Path]:
    """Remove a file or folder at the end of the block, or of the program."""
    with _lock:
        _paths.add(path)
    try:
        yield path
    finally:
        _remove(path)
        with _lock:
            _paths.discard(path)


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder that is gone at the end of the block, or of the program."""
    _remove_stale(Path(tempfile.gettempdir()))
    with temporary(Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}_"))) as folder:
        yield folder


def run_contained(
    program: Sequence[str],
    folder: Path,
    environment: Mapping[str, str],
    timeout_s: float,
    say: Callable[[str], None] | None = None,
) -> "subprocess.CompletedProcess[str]":
    """Run a Python program in a process that ends with this one, and after `timeout_s` at the latest.

    Parameters
    ----------
    program : sequence of str
        Script and its arguments.
    folder : Path
        Where it runs.
    environment : mapping
    timeout_s : float
        s.
    say : callable, optional
        Takes every line that the program prints, soon after.

    Raises
    ------
    subprocess.TimeoutExpired
        If it did not end in time.
    SoftTissueError
        If this program is ending.
    """
    # Files, not pipes: what the program has started may keep those open after its end.
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = _begun(program, folder, environment, subprocess.DEVNULL, out, err)
        try:
            if say is None:
                child.wait(timeout_s)
            else:
                _wait_telling(child, out, timeout_s, say)
        finally:
            _end(child)
        return subprocess.CompletedProcess(child.args, child.returncode, _end_of(out), _end_of(err))


@contextlib.contextmanager
def contained(
    program: Sequence[str], folder: Path, environment: Mapping[str, str], errors: IO[bytes]
) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a Python program beside this one, which talks to it by its standard input and output, within the block.

    Parameters
    ----------
    program, folder, environment
        As of `run_contained`.
    errors : file
        Takes what it prints as errors.

    Raises
    ------
    SoftTissueError
        If this program is ending.
    """
    child = _begun(program, folder, environment, subprocess.PIPE, subprocess.PIPE, errors)
    try:
        yield child
    finally:
        _end(child)
        for pipe in (child.stdin, child.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


def _begun(
    program: Sequence[str],
    folder: Path,
    environment: Mapping[str, str],
    stdin: int,
    stdout: int | IO[bytes],
    stderr: IO[bytes],
) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-P", str(_CONTAINED), str(os.getpid()), *program]
    with _lock:
        if _ending:
            raise SoftTissueError("expected a program that goes on, got one that ends")
        child = subprocess.Popen(
            command,
            cwd=folder,
            env=dict(environment),
            stdin=stdin,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,  # a Ctrl-C is this program's business
        )
        _children.add(child)
    return child


def _end(child: "subprocess.Popen[bytes]") -> None:
    _kill(child)
    child.wait()
    with _lock:
        _children.discard(child)


def child_environment(*, one_thread: bool = False, folder: Path | None = None) -> dict[str, str]:
    """Return the environment of a program of this package that runs in another process.

    Parameters
    ----------
    one_thread : bool
        Whether libraries of linear algebra are to take one thread alone.
    folder : Path, optional
        For its own temporary files.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    if one_thread:
        environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return environment if folder is None else environment | {"TMPDIR": str(folder)}


def _wait_telling(
    child: "subprocess.Popen[bytes]", out: IO[bytes], timeout_s: float, say: Callable[[str], None]
) -> None:
    told, rest, end_s = 0, b"", time.monotonic() + timeout_s
    ended = False
    while not ended:
        ended = child.poll() is not None
        # Not by the file's own position, which is also the child's.
        printed = os.pread(out.fileno(), _MOST_PRINTED, told)
        told += len(printed)
        *lines, rest = (rest + printed).split(b"\n")
        for line in lines:
            say(line.decode(errors="replace"))
        ended = ended and not printed
        if time.monotonic() > end_s:
            raise subprocess.TimeoutExpired(child.args, timeout_s)
        if not printed and not ended:
            time.sleep(_LOOK_S)


def _end_of(file: IO[bytes]) -> str:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _MOST_PRINTED))
    return file.read().decode(errors="replace")


def clear() -> None:
    """End all children and remove all temporary files, at the end of the program: none begins any more."""
    global _ending
    with _lock:
        _ending = True
        for child in _children:
            # Some clean up after themselves.
            with contextlib.suppress(OSError):
                os.killpg(child.pid, signal.SIGTERM)
        end_s = time.monotonic() + _GRACE_S
        while time.monotonic() < end_s and any(child.poll() is None for child in _children):
            time.sleep(0.005)
        for child in _children:
            _kill(child)
        for path in _paths:
            _remove(path)


def _kill(child: "subprocess.Popen[bytes]") -> None:
    # With what it may have started, also if it has ended itself: it leads a group of its own.
    with contextlib.suppress(OSError):
        os.killpg(child.pid, signal.SIGKILL)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def _remove_stale(parent: Path) -> None:
    """Remove the folders of programs that were killed."""
    with contextlib.suppress(OSError):
        for folder in parent.glob(f"{_PREFIX}[0-9]*_*"):
            number = folder.name.removeprefix(_PREFIX).partition("_")[0]
            if number.isdigit() and not _alive(int(number)):
                with contextlib.suppress(OSError):
                    if (
                        time.time() - folder.stat().st_mtime > _STALE_S
                        and folder.stat().st_uid == os.getuid()
                    ):
                        _remove(folder)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True
