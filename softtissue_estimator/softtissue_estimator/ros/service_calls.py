"""Calls of services that take a while: worked off by a thread of their own, only so many at a time. Knows no ROS."""

import queue
import threading
from collections.abc import Callable
from typing import Any


class ServiceCalls:
    """A thread for the calls of one service, so that messages are taken meanwhile.

    Parameters
    ----------
    name : str
        Of the thread.
    most : int
        Calls in hand, at work and waiting, beyond which no other is taken: whoever calls without end neither fills
        the memory nor keeps more than one thread busy.
    """

    def __init__(self, name: str, most: int) -> None:
        self._most, self._in_hand = most, 0
        self._lock = threading.Lock()
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    async def done(self, work: Callable[[], None], executor: Any) -> bool:
        """Await work; return whether it was done, and not refused because too many calls are in hand.

        Parameters
        ----------
        work : callable
            What it raises is raised here.
        executor : rclpy.executors.Executor
            That which awaits.
        """
        with self._lock:
            if self._in_hand >= self._most:
                return False
            self._in_hand += 1
        future = executor.create_future()

        def run() -> None:
            try:
                work()
                failure = None
            except Exception as error:  # raised again where the result is awaited
                failure = error
            with self._lock:
                self._in_hand -= 1
            if failure is None:
                future.set_result(None)
            else:
                future.set_exception(failure)
            # The executor looks at the awaiting callback again only when something wakes it.
            executor.wake()

        self._calls.put(run)
        await future
        return True

    def _run(self) -> None:
        while True:
            self._calls.get()()
