"""Stages follow one another without gaps, and each is charged with what it waited for."""

import time

from softtissue_estimator.inference.stopwatch import Stopwatch


def test_stages_add_up_to_the_time_since_the_start() -> None:
    start = time.monotonic() - 5.0
    watch = Stopwatch(start)
    watch.lap("wait")
    watch.lap("work")
    assert list(watch.stages) == ["wait", "work"]
    assert watch.stages["wait"] >= 5.0 > watch.stages["work"] >= 0.0
    assert sum(watch.stages.values()) <= time.monotonic() - start


def test_a_stage_includes_the_wait_for_its_end() -> None:
    watch = Stopwatch(finish=lambda: time.sleep(0.05))
    watch.lap("network")
    assert watch.stages["network"] >= 0.05
