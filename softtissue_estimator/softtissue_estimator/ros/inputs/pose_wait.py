"""Clouds whose pose is about to arrive wait for it, and hold nothing else up. Knows no ROS."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

ItemT = TypeVar("ItemT")

_MOST = 16  # that wait: half a second of a fast camera's clouds


@dataclass(frozen=True)
class _Entry(Generic[ItemT]):
    item: ItemT
    stamp_ns: int
    end_s: float


class PoseWait(Generic[ItemT]):
    """Hands items on when their pose is known or their time is over, never an older one after a newer one.

    Parameters
    ----------
    awaits : callable
        Says whether the pose of an item may still arrive.
    hand_on : callable
        Takes an item that waits no longer.
    drop : callable
        Takes one that a newer one overtook.
    """

    def __init__(
        self,
        awaits: Callable[[ItemT], bool],
        hand_on: Callable[[ItemT], None],
        drop: Callable[[ItemT], None],
    ) -> None:
        self._awaits, self._hand_on, self._drop = awaits, hand_on, drop
        self._entries: list[_Entry[ItemT]] = []
        self._newest_ns: int | None = None

    @property
    def waiting(self) -> int:
        """Number of items that wait."""
        return len(self._entries)

    def add(self, item: ItemT, stamp_ns: int, now_s: float, timeout_s: float) -> None:
        """Hand an item on, at once if its pose is known or cannot arrive any more.

        Parameters
        ----------
        item : object
        stamp_ns : int
            Its stamp, nanoseconds.
        now_s, timeout_s : float
            Now, and how long it may wait, s on a monotonic clock.
        """
        if timeout_s > 0.0 and self._awaits(item):
            self._entries.append(_Entry(item, stamp_ns, now_s + timeout_s))
            if len(self._entries) > _MOST:
                self._drop(self._entries.pop(0).item)
        else:
            self._newest_ns = stamp_ns
            self._hand_on(item)

    def poll(self, now_s: float) -> None:
        """Look for those whose pose arrived or whose time is over."""
        entries, self._entries = self._entries, []
        for entry in entries:
            if now_s < entry.end_s and self._awaits(entry.item):
                self._entries.append(entry)
            elif self._newest_ns is not None and entry.stamp_ns < self._newest_ns:
                self._drop(entry.item)
            else:
                self._newest_ns = entry.stamp_ns
                self._hand_on(entry.item)

    def clear(self) -> None:
        """Forget what waits."""
        self._entries, self._newest_ns = [], None
