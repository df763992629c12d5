"""A thread that works on the newest item."""

import threading
import time
import weakref

from softtissue_estimator.support.latest_worker import LatestWorker
from softtissue_estimator.support.memory import gone


class Item:
    """Something that can be referred to weakly."""


def test_worker_takes_the_newest_and_hands_back_the_replaced():
    release, begun, done = threading.Event(), threading.Event(), []

    def work(item):
        begun.set()
        assert release.wait(10.0)
        done.append(item)

    crashes = []
    worker = LatestWorker(work, crashes.append)
    assert worker.put(1) is None
    assert begun.wait(10.0)
    assert worker.put(2) is None
    assert worker.put(3) == 2
    release.set()
    end = time.monotonic() + 10.0
    while len(done) < 2 and time.monotonic() < end:
        time.sleep(0.001)
    assert worker.stop(10.0)
    assert (done, crashes) == ([1, 3], [])


def test_worker_reports_a_crash_and_goes_on():
    crashes, reported = [], threading.Event()

    def crash(error):
        crashes.append(error)
        reported.set()

    worker = LatestWorker(lambda item: 1 / item, crash)
    worker.put(0)
    assert reported.wait(10.0)
    assert isinstance(crashes[0], ZeroDivisionError)
    reported.clear()
    worker.put(0)
    assert reported.wait(10.0)
    assert len(crashes) == 2
    assert worker.stop(10.0)


def test_worker_keeps_nothing_of_an_item_that_is_done():
    done = threading.Event()
    worker, item = LatestWorker(lambda _: done.set(), print), Item()
    kept = weakref.ref(item)
    worker.put(item)
    del item
    assert done.wait(10.0)
    assert gone(kept, 10.0)
    assert worker.stop(10.0)
