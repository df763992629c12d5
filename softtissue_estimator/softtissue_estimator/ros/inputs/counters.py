"""What became of the clouds since the node was activated. Knows no ROS."""

import threading
from collections.abc import Collection
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


@dataclass(frozen=True)
class Missing:
    """Numbers of messages that did not arrive before one that did.

    Attributes
    ----------
    lost : int
        Those that count as dropped.
    unheard : int
        Those that a new publisher had sent before it was discovered, where they are too many to be called lost.
    """

    lost: int = 0
    unheard: int = 0


class LossCounter:
    """Notices clouds lost on the way by gaps in a publisher's sequence numbers, which begin at 1.

    Parameters
    ----------
    known : collection of bytes
        Publishers that may have published before anybody listened; of the others, what is missing before the
        first message counts too, if it is little.
    """

    # A publisher that is further on was merely discovered late.
    _START = 20

    def __init__(self, known: Collection[bytes] = ()) -> None:
        self._known = frozenset(known)
        self._last: dict[bytes, int] = {}

    def missing_before(self, publisher: bytes, sequence: int) -> Missing:
        """Return how many messages of a publisher are missing before the one with this number."""
        last = self._last.get(publisher)
        self._last[publisher] = sequence
        if last is not None:
            return Missing(lost=max(0, sequence - last - 1))
        if publisher in self._known:
            return Missing()
        return Missing(lost=sequence - 1) if sequence <= self._START else Missing(unheard=sequence - 1)
