"""What became of the clouds since the node was activated. Knows no ROS."""

import threading
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Counts:
    """Numbers of clouds: received = answered + dropped + refused + those in work or waiting."""

    received: int = 0
    answered: int = 0
    dropped: int = 0
    refused: int = 0


class FrameCounters:
    """Counts from several threads; read as one consistent value."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = Counts()

    def add(self, *, received: int = 0, answered: int = 0, dropped: int = 0, refused: int = 0) -> None:
        """Add to the counts."""
        with self._lock:
            old = self._counts
            self._counts = Counts(
                old.received + received, old.answered + answered, old.dropped + dropped, old.refused + refused
            )

    def clear(self) -> None:
        """Set all counts to zero."""
        with self._lock:
            self._counts = Counts()

    @property
    def counts(self) -> Counts:
        """The counts now."""
        with self._lock:
            return replace(self._counts)


class LossCounter:
    """Notices clouds lost on the way by gaps in a publisher's sequence numbers."""

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}

    def lost_before(self, publisher: bytes, sequence: int) -> int:
        """Return how many messages of a publisher are missing before the one with this number."""
        last = self._last.get(publisher)
        self._last[publisher] = sequence
        return 0 if last is None else max(0, sequence - last - 1)
