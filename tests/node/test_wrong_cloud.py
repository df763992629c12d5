"""One wrong cloud among good ones: it is not answered at level OK, and the answers after it are as without it."""

import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import write_organ
from integration.scene import Scene
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import create_estimator
from softtissue_estimator.ros.degradation import degradation_reasons
from softtissue_estimator.ros.frames import Frame, FrameAnswerer
from softtissue_estimator.ros.inputs.registration import Registration

FRAMES_BEFORE, FRAMES_AFTER = 20, 24
FRAMES_SPOILT = 8
MOST_SPOILT_M = 0.0015
CONFIG = EstimatorConfig(
    device="cpu", tracking=True, tracking_patience_s=600.0, minimum_visible_fraction=0.01, frame_budget_s=60.0
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return Scene(write_organ(tmp_path_factory.mktemp("organ"), coarse=True))


def torn_lobe(scene):
    """The cloud, with all that lies beyond x = 30 mm 100 mm further away."""
    points = scene.points.copy()
    points[scene.reference[:, 0] > 0.03] += [0.1, 0.0, 0.0]
    return points


def mirrored(scene):
    """The cloud, mirrored about the plane y = 0 of the organ's frame."""
    return scene.points * [1.0, -1.0, 1.0]


def played(scene, wrong):
    """Play clouds, each when the one before is explained; return the wrong one's reasons, and what follows."""
    estimator, registration = create_estimator(CONFIG), Registration(None)
    estimator.load_organ(scene.organ)
    answerer = FrameAnswerer(scene.organ, estimator)
    after, reasons = [], None
    for number in range(FRAMES_BEFORE + 1 + FRAMES_AFTER):
        points = wrong if number == FRAMES_BEFORE else scene.points
        frame = Frame(scene.cloud((1 + number) * 100_000_000, points=points), None, time.monotonic(), 0)
        try:
            answer = answerer.answer(frame, CONFIG, registration)
        except InvalidInputError as error:
            if number != FRAMES_BEFORE:
                raise
            reasons = [str(error)]
        else:
            if number == FRAMES_BEFORE:
                reasons = degradation_reasons(answer, 0.0, CONFIG)
            elif number > FRAMES_BEFORE:
                after.append(answer.estimate.displacement)
    estimator.close()
    return reasons, np.array(after)


@pytest.fixture(scope="module")
def undisturbed(scene):
    reasons, after = played(scene, scene.points)
    assert reasons == []
    return after


@pytest.fixture(scope="module")
def with_a_torn_lobe(scene):
    return played(scene, torn_lobe(scene))


@pytest.fixture(scope="module")
def with_a_mirrored_cloud(scene):
    return played(scene, mirrored(scene))


@pytest.mark.parametrize("wrong", ["with_a_torn_lobe", "with_a_mirrored_cloud"])
def test_wrong_cloud_is_not_answered_at_level_ok(request, wrong):
    reasons, _ = request.getfixturevalue(wrong)
    assert reasons


def test_answers_after_a_mirrored_cloud_are_as_without_it(with_a_mirrored_cloud, undisturbed):
    _, after = with_a_mirrored_cloud
    assert np.linalg.norm(after - undisturbed, axis=2).max() < MOST_SPOILT_M


def test_answers_are_soon_as_without_a_cloud_with_a_torn_lobe(with_a_torn_lobe, undisturbed):
    """It is followed without the lobe; what is then supposed of the lobe differs for some frames from mesh to mesh."""
    _, after = with_a_torn_lobe
    assert np.linalg.norm(after - undisturbed, axis=2)[FRAMES_SPOILT:].max() < MOST_SPOILT_M
