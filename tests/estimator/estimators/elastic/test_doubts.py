"""Why an answer must not be relied on: each reason alone, and none where all is well."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from softtissue_estimator.estimators.diagnosis import RegistrationEstimate
from softtissue_estimator.estimators.elastic.doubts import Shown, Troubles, disbelief, doubts
from softtissue_estimator.estimators.elastic.registration_error import expected_error
from softtissue_estimator.observation.rigid import RigidMotion

CENTRE = np.array([0.1, -0.2, 0.3])
OBSERVED = np.array([[0.0, 0.0, 0.010], [0.0, 0.0, 0.004]])
WELL = {
    "sensor_m": 0.0002,
    "slide_m": 0.0002,
    "plausible": True,
    "farthest_m": 0.049,
    "unexplained_m": 0.0004,
    "off_m": 0.008,
    "off_rad": 0.08,
    "outliers": 0.2,
    "lost": False,
    "surprised": False,
    "moved": False,
    "attachment_moves": False,
    "contested": False,
}


def said(**wrong):
    found = WELL | wrong
    mean = torch.zeros(4, 3, dtype=torch.float64)
    mean[2, 1] = found["farthest_m"]
    prior = SimpleNamespace(fields=torch.tensor([found["sensor_m"] ** 2, found["slide_m"] ** 2]))
    posterior = SimpleNamespace(
        mean=mean,
        plausible=found["plausible"],
        amplitudes=SimpleNamespace(prior=prior),
        observed=SimpleNamespace(field_components=(1, 2)),
        innovation=1.4,
        attachment_moves=found["attachment_moves"],
        contested=found["contested"],
    )
    turn = Rotation.from_rotvec([found["off_rad"], 0.0, 0.0]).as_matrix()
    motion = RigidMotion(turn, CENTRE - turn @ CENTRE + [0.0, found["off_m"], 0.0])
    registration = RegistrationEstimate(CENTRE, motion, np.eye(6))
    expected = expected_error(CENTRE, 0.005, 0.05)
    return doubts(
        posterior,
        OBSERVED,
        found["unexplained_m"],
        registration,
        expected,
        found["outliers"],
        Troubles(found["lost"], found["surprised"], found["moved"]),
    )


def test_nothing_is_said_where_all_is_well():
    assert said() == ()


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"outliers": 0.3}, "30 % of the points torn off"),
        ({"lost": True}, "answered anew"),
        ({"moved": True}, "stays what it is, got one off by 8 mm and 5 degrees by now"),
        ({"surprised": True}, "1.4 times its standard deviation, and that for a second"),
        ({"unexplained_m": 0.0021}, "2.1 mm that no load explains"),
        ({"sensor_m": 0.0019}, "errors of 1.9 mm that they share"),
        ({"slide_m": 0.001}, "errors of 1.4 mm that they share"),
        ({"off_m": 0.022}, "off by 22 mm and 5 degrees"),
        ({"off_rad": 0.21}, "off by 8 mm and 12 degrees"),
        ({"attachment_moves": True}, "an attachment that moves"),
        ({"contested": True}, "held and registered as told, got what fits another better"),
        ({"plausible": False}, "torn or inverted"),
        ({"farthest_m": 0.051}, "some that move far more"),
    ],
)
def test_each_reason_is_said_alone(wrong, sentence):
    (reason,) = said(**wrong)
    assert sentence in reason


def told(patches=400, share=0.2, before=600.0, unexplained=0.0004, plausible=True, farthest=0.019):
    mean = torch.zeros(4, 3, dtype=torch.float64)
    mean[2, 1] = farthest
    posterior = SimpleNamespace(
        mean=mean, plausible=plausible, observed=SimpleNamespace(displacement=OBSERVED)
    )
    return disbelief(posterior, unexplained, Shown(patches, share, before))


def test_an_organ_that_fits_is_believed_however_it_was_found():
    assert told() == told(before=0.0) == told(before=0.0, share=0.02) == ""


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"patches": 140}, "140 cells of 5 mm that may be on it where 600 were"),
        ({"unexplained": 0.0021}, "does not fit it, by 2.1 mm"),
        ({"plausible": False}, "torn or moves far more"),
        ({"farthest": 0.021}, "torn or moves far more"),
    ],
)
def test_what_does_not_fit_a_lost_organ_is_not_believed(wrong, sentence):
    assert sentence in told(**wrong)


def test_a_first_cloud_that_shows_enough_is_answered_however_it_fits():
    wrong = {"unexplained": 0.0021, "plausible": False, "before": 0.0}
    assert told(**wrong) == ""
    assert "does not fit" in told(**wrong, share=0.04)
