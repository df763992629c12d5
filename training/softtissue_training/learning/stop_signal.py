"""The signal with which schedulers such as SLURM announce that a job must end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def ended_by_signal(stop: threading.Event) -> Iterator[None]:
    """Let SIGTERM set an event while the context lasts; in other threads than the main one, do nothing."""

    def handle(_: int, __: FrameType | None) -> None:
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
