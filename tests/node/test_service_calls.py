"""Calls that take a while are done in order in a thread of their own; too many are refused, none is forgotten."""

import asyncio
import threading

import pytest

from node.awaiting import PATIENCE_S, run
from softtissue_estimator.ros.service_calls import ServiceCalls


def test_calls_beyond_the_most_are_refused_at_once_and_the_others_done_in_order():
    calls, go_on, done = ServiceCalls("test", most=3), threading.Event(), []

    async def scenario(executor):
        def work(number):
            assert go_on.wait(PATIENCE_S)
            done.append((number, threading.current_thread().name))

        taken = [asyncio.ensure_future(calls.done(lambda n=n: work(n), executor)) for n in range(3)]
        await asyncio.sleep(0.05)
        for number in range(3, 200):
            assert not await calls.done(lambda n=number: work(n), executor)
        assert done == []
        go_on.set()
        assert await asyncio.gather(*taken) == [True, True, True]
        assert await calls.done(lambda: work(200), executor), "there is room again"

    run(scenario)
    assert done == [(number, "test") for number in (0, 1, 2, 200)]


def test_an_error_is_raised_where_the_call_is_awaited_and_the_next_is_done():
    calls, done = ServiceCalls("test", most=1), []

    async def scenario(executor):
        with pytest.raises(KeyError, match="nothing"):
            await calls.done(lambda: {}["nothing"], executor)
        assert await calls.done(lambda: done.append(1), executor)

    run(scenario)
    assert done == [1]
