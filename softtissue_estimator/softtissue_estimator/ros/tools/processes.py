"""Programs that run as processes beside this one: found, started, listened to and ended."""

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from softtissue_estimator.errors import InvalidInputError

PACKAGE = "softtissue_estimator"
STOP_TIMEOUT_S = 8.0


def executable(name: str) -> Path:
    """Find an installed executable as `ros2 run` does.

    Raises
    ------
    InvalidInputError
        If it is not installed.
    """
    from ament_index_python.packages import PackageNotFoundError, get_package_prefix

    try:
        path = Path(get_package_prefix(PACKAGE)) / "lib" / PACKAGE / name
    except PackageNotFoundError:
        raise InvalidInputError(
            f"package {PACKAGE}: expected it in the ament index, got nothing there"
        ) from None
    if not path.is_file():
        raise InvalidInputError(f"executable {name}: expected {path}, got nothing there")
    return path


@contextmanager
def process(command: list[str], **keywords: Any) -> Iterator["subprocess.Popen[str]"]:
    """Run a process in a group of its own and end the group afterwards, also when a signal comes while it starts."""
    child = None
    try:
        with _signals_held_back():
            child = subprocess.Popen(command, start_new_session=True, text=True, **keywords)
        yield child
    finally:
        if child is not None:
            _end(child)


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Handle SIGINT and SIGTERM at the end of the block.

    A handler that raises within Popen leaves a process that runs and that nobody knows.
    """
    if threading.current_thread() is not threading.main_thread():  # to which alone Python gives signals
        yield
        return
    arrived: list[int] = []
    before = {
        number: signal.signal(number, lambda sent, _frame: arrived.append(sent))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for received in arrived:
        # Sent again, so that it does what it would have done, whatever its handler is.
        signal.raise_signal(received)


def _end(child: "subprocess.Popen[str]") -> None:
    # Not SIGINT, at which a Python that has only just been started prints a traceback.
    for number, patience in ((signal.SIGTERM, STOP_TIMEOUT_S), (signal.SIGKILL, STOP_TIMEOUT_S)):
        if child.poll() is None:
            os.killpg(child.pid, number)
        try:
            child.wait(patience)
            return
        except subprocess.TimeoutExpired:
            continue


@contextmanager
def relayed_process(command: list[str], log: Path, name: str) -> Iterator["subprocess.Popen[str]"]:
    """Run a process as `process` does; what it says on standard error goes where `_relay` writes it."""
    with process(command, stderr=subprocess.PIPE) as child:
        threading.Thread(target=_relay, args=(child.stderr, log, name), name="relay", daemon=True).start()
        yield child


def _relay(stream: TextIO, log: Path, name: str) -> None:
    """Write a process's lines to a file, and to the terminal those that say how it goes on."""
    with log.open("w", encoding="utf-8") as file:
        for line in stream:
            file.write(line)
            file.flush()
            # Warnings come with every late frame; the table counts them.
            if "[WARN]" not in line:
                print(f"  {name}: {line.rstrip()}", flush=True)
