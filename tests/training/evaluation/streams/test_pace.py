"""Between two frames the other threads get their time, whether the machine is busy or not."""

import itertools
import sys
import threading
import time

import pytest

from softtissue_training.evaluation.streams import pace as pacing
from softtissue_training.evaluation.streams.pace import Pace


def compute(seconds):
    """Keep a core busy for so much processor time of this thread."""
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        sum(range(1000))


def test_frames_are_not_early():
    pace, moments = Pace(0.03), []
    for _ in range(5):
        pace.wait()
        moments.append(time.perf_counter())
    steps = [later - sooner for sooner, later in itertools.pairwise(moments)]
    assert min(steps) >= 0.03


def test_a_frame_waits_until_threads_rest(monkeypatch):
    runs = itertools.chain([True] * 7, [False, True], itertools.repeat(False))
    asked = []
    monkeypatch.setattr(pacing, "_others_run", lambda: asked.append(next(runs)) or asked[-1])
    monkeypatch.setattr(pacing, "_computed_by_others", lambda: 0.0)
    pace = Pace(0.01)
    pace.wait()
    assert asked == []
    pace.wait()
    assert asked == [True] * 7 + [False, True] + [False] * 3


def test_a_frame_does_not_wait_longer_than_threads_have_in_use(monkeypatch):
    computed = iter([5.0, 5.004, 5.009, 5.011, 5.011])
    asked = []
    monkeypatch.setattr(pacing, "_others_run", lambda: not asked.append(1))
    monkeypatch.setattr(pacing, "_computed_by_others", lambda: next(computed))
    pace = Pace(0.01)
    pace.wait()
    pace.wait()
    assert len(asked) == 2 and list(computed) == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says whether a thread rests")
def test_a_thread_that_computes_is_seen_and_one_that_rests_is_not():
    end = threading.Event()
    resting = threading.Thread(target=end.wait)
    resting.start()
    before = pacing._computed_by_others()
    worker = threading.Thread(target=compute, args=(0.3,))
    worker.start()
    seen = []
    while worker.is_alive():
        seen.append(pacing._others_run())
        time.sleep(0.004)
    assert sum(seen) > 0.5 * len(seen)
    assert pacing._computed_by_others() - before == pytest.approx(0.3, abs=0.1)
    states = [pacing._state(pacing.Path("/proc/self/task", str(resting.native_id))) for _ in range(5)]
    assert states == ["S"] * 5
    end.set()
    resting.join()
