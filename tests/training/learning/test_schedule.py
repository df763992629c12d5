import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.learning.schedule import Schedule, learning_rate
from softtissue_training.learning.training_config import get_config
from softtissue_training.learning.training_state import Progress


def test_learning_rate_rises_and_falls():
    config = get_config("tiny", learning_rate=1.0, warmup_steps=10)
    rates = [learning_rate(config, step, step / 100) for step in range(101)]
    assert rates[0] == pytest.approx(0.1)
    assert np.argmax(rates) == 9
    assert rates[-1] == pytest.approx(0.0)


def test_steps_go_before_time_and_without_either_the_rate_stays():
    config = get_config("tiny", learning_rate=1.0, warmup_steps=1)
    half_of_the_steps = Progress(step=50, seconds=999.0)
    assert Schedule(steps=100, time_limit_s=1000.0).learning_rate(config, half_of_the_steps) == 0.5
    half_of_the_time = Progress(step=99_999, seconds=500.0)
    assert Schedule(time_limit_s=1000.0).learning_rate(config, half_of_the_time) == pytest.approx(0.5)
    assert Schedule(patience=3).learning_rate(config, half_of_the_time) == 1.0


def test_validations_come_at_steps_or_by_the_clock():
    def due(schedule):
        return [
            step for step in range(1, 61) if schedule.is_validation_due(Progress(step=step, seconds=step))
        ]

    assert due(Schedule(steps=60)) == list(range(3, 61, 3))
    assert due(Schedule(steps=60, validate_every_steps=25)) == [25, 50]
    by_clock = Schedule(time_limit_s=600.0)
    assert not by_clock.is_validation_due(Progress(step=7, seconds=130.0, validated_seconds=100.0))
    assert by_clock.is_validation_due(Progress(step=7, seconds=131.0, validated_seconds=100.0))
    assert not Schedule(steps=60).is_validation_due(Progress(step=3, validated_step=3))


def test_a_run_without_an_end_is_refused():
    with pytest.raises(InvalidInputError, match="a number of steps, a time limit or a patience, got none"):
        Schedule()
