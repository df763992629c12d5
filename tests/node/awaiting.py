"""Stands in for rclpy's executor where coroutines await what other threads do."""

import asyncio

PATIENCE_S = 10.0


class Loop:
    """Stands in for rclpy's executor: its futures are finished in other threads."""

    def __init__(self, loop):
        self._loop = loop

    def create_future(self):
        return ThreadedFuture(self._loop.create_future(), self._loop)

    def wake(self):
        pass


class ThreadedFuture:
    def __init__(self, future, loop):
        self._future, self._loop = future, loop

    def set_result(self, value):
        self._loop.call_soon_threadsafe(self._future.set_result, value)

    def set_exception(self, error):
        self._loop.call_soon_threadsafe(self._future.set_exception, error)

    def __await__(self):
        return self._future.__await__()


def run(scenario):
    """Run a coroutine function that takes an executor."""

    async def main():
        return await asyncio.wait_for(scenario(Loop(asyncio.get_running_loop())), PATIENCE_S)

    return asyncio.run(main())
