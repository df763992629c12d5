"""Why an answer is DEGRADED, in one sentence that holds."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.diagnosis import Diagnosis
from softtissue_estimator.ros.degradation import degradation_reasons, in_one_sentence

ORGAN = SimpleNamespace(structures=[SimpleNamespace(name="tumour"), SimpleNamespace(name="portal vein")])


def answer(doubts=(), sigma=(0.001, 0.001), **changes):
    found = SimpleNamespace(diagnosis=Diagnosis(doubts=doubts))
    usual = {"visible_fraction": 1.0, "rejected_fraction": 0.0, "pose": SimpleNamespace(doubt="")}
    return SimpleNamespace(estimate=found, organ=ORGAN, structure_sigma=np.array(sigma), **usual | changes)


def reasons(of, **settings):
    return degradation_reasons(of, 0.01, EstimatorConfig(**settings))


def test_nothing_is_wrong_with_a_good_answer():
    assert reasons(answer()) == []
    assert reasons(answer(sigma=(np.nan, np.nan))) == []


def test_every_doubt_is_a_reason_and_comes_first():
    doubts = ("the innovations: expected 1, got 5", "the pose: expected less, got more")
    assert reasons(answer(doubts, visible_fraction=0.01))[:2] == list(doubts)
    assert len(reasons(answer(doubts, visible_fraction=0.01))) == 3


def test_structure_that_is_too_uncertain_is_named():
    (said,) = reasons(answer(sigma=(0.001, 0.0123)))
    assert said == (
        "standard deviation: expected at most 5 mm in every structure, got 12.3 mm in 'portal vein'"
    )
    (said,) = reasons(answer(sigma=(0.02, 0.0123)))
    assert said.endswith("got 20 mm in 'tumour' and more than that in 1 other(s)")
    assert reasons(answer(sigma=(0.001, 0.0123)), maximum_sigma_m=0.0124) == []
    assert len(reasons(answer(sigma=(0.001, np.nan)), maximum_sigma_m=0.0005)) == 1


@pytest.mark.parametrize("count", [1, 2, 3, 20])
def test_reasons_are_one_sentence_of_whole_reasons(count):
    said = in_one_sentence([f"reason {number}: {'x' * 80}" for number in range(count)])
    assert len(said) <= 300 and said.isprintable()
    whole = said.count("x" * 80)
    assert whole == min(count, 3)
    assert said.endswith(f"; and {count - whole} more") == (whole < count)


def test_reason_that_is_too_long_is_cut():
    said = in_one_sentence(["a\n" + "x" * 900, "b"])
    assert len(said) <= 300 and said.startswith("a x") and said.endswith("; and 1 more")
    assert in_one_sentence([]) == ""


def test_pose_of_another_stamp_is_a_reason():
    doubt = "tf2: expected a transform at the cloud's stamp, got one 0.100 s older than the cloud"
    assert reasons(answer(pose=SimpleNamespace(doubt=doubt))) == [doubt]
