"""A thread that always works on the newest item and never on a queue. Knows no ROS."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

ItemT = TypeVar("ItemT")


class LatestWorker(Generic[ItemT]):
    """Calls `work` in a thread of its own with the newest item handed over.

    Parameters
    ----------
    work : callable
    on_crash : callable
        Takes what `work` raised; the thread goes on with the next item.
    name : str
        Of the thread.
    """

    def __init__(
        self,
        work: Callable[[ItemT], None],
        on_crash: Callable[[BaseException], object],
        name: str = "estimate",
    ) -> None:
        self._work, self._on_crash = work, on_crash
        self._condition = threading.Condition()
        self._item: ItemT | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: ItemT) -> ItemT | None:
        """Hand over an item and return the one that it replaces, if that was not yet begun."""
        with self._condition:
            replaced, self._item = self._item, item
            self._condition.notify()
        return replaced

    def take_back(self) -> ItemT | None:
        """Take back the item that is not yet begun."""
        with self._condition:
            item, self._item = self._item, None
        return item

    def stop(self, timeout_s: float) -> bool:
        """Stop after the item at work; return whether the thread ended within `timeout_s`."""
        with self._condition:
            self._stopping = True
            self._item = None
            self._condition.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._item is not None or self._stopping)
                if self._stopping:
                    return
                item, self._item = self._item, None
            if item is not None:
                try:
                    self._work(item)
                except Exception as error:  # the thread's owner reports it
                    self._on_crash(error)
                item = None  # it may hold much, and the next one may be long in coming
