"""What the estimator found out about its input, on `~/status` and `/diagnostics`."""

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from scipy.spatial.transform import Rotation

from softtissue_estimator.estimators.diagnosis import Diagnosis, RegistrationEstimate
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.ros.inputs.counters import Counts
from softtissue_estimator.ros.outputs.status import (
    INVALID,
    OK,
    Condition,
    Report,
    Setup,
    diagnostics_message,
    status_message,
)


def report(registration):
    diagnosis = Diagnosis(registration, outlier_share=0.25, innovation_rms=1.5)
    return Report(OK, diagnosis=diagnosis, structures=("tumour", "vein"), structure_sigma=(0.0015, math.nan))


def registration_off():
    """By 5 mm and 3 degrees, known to 2 mm and 1 degree."""
    centre, turn = np.array([0.1, 0.2, 0.3]), Rotation.from_rotvec([0.0, np.radians(3.0), 0.0]).as_matrix()
    correction = RigidMotion(turn, centre - turn @ centre + np.array([0.003, 0.004, 0.0]))
    variances = np.square([0.002] * 3 + [np.radians(1.0)] * 3)
    return RegistrationEstimate(centre, correction, np.diag(variances))


def values(of):
    (status,) = diagnostics_message("node", Time(), Condition("active"), of, Setup(), Counts()).status
    return {entry.key: entry.value for entry in status.values}


def test_status_says_how_far_the_registration_is_off_and_how_sure_that_is():
    message = status_message(report(registration_off()), Setup(), Counts())
    assert message.registration_translation_error == pytest.approx(0.005)
    assert message.registration_rotation_error == pytest.approx(math.radians(3.0))
    assert message.registration_translation_sigma == pytest.approx(0.002)
    assert message.registration_rotation_sigma == pytest.approx(math.radians(1.0))
    assert (message.outlier_fraction, message.innovation_rms) == (0.25, 1.5)
    assert message.structure_names == ["tumour", "vein"]
    assert message.structure_sigmas[0] == pytest.approx(0.0015) and math.isnan(message.structure_sigmas[1])


def test_registration_that_is_taken_for_exact_has_no_error():
    message = status_message(report(None), Setup(), Counts())
    for what in ("translation", "rotation"):
        assert math.isnan(getattr(message, f"registration_{what}_error"))
        assert math.isnan(getattr(message, f"registration_{what}_sigma"))
    assert message.outlier_fraction == 0.25


def test_refusal_knows_nothing_of_its_input():
    message = status_message(Report(INVALID, "expected a cloud, got none"), Setup(), Counts())
    found = (message.registration_translation_error, message.outlier_fraction, message.innovation_rms)
    assert all(map(math.isnan, found))
    assert list(message.structure_names) == list(message.structure_sigmas) == []
    assert values(Report(INVALID))["outlier fraction"] == "nan"


def test_diagnostics_say_the_same_in_mm_and_degrees():
    shown = values(report(registration_off()))
    assert (shown["registration off by (mm)"], shown["registration off by (deg)"]) == ("5.00", "3.00")
    assert (shown["registration sigma (mm)"], shown["registration sigma (deg)"]) == ("2.00", "1.00")
    assert (shown["outlier fraction"], shown["innovation rms"]) == ("0.250", "1.50")
    assert (shown["largest sigma of tumour (mm)"], shown["largest sigma of vein (mm)"]) == ("1.50", "nan")


def of_condition(condition, about):
    (status,) = diagnostics_message("node", Time(), condition, about, Setup(), Counts()).status
    return status.level, status.message


@pytest.mark.parametrize(
    ("condition", "level", "words"),
    [
        (Condition("unconfigured"), DiagnosticStatus.WARN, "unconfigured: clouds are answered only"),
        (Condition("inactive"), DiagnosticStatus.WARN, "inactive"),
        (Condition("finalized"), DiagnosticStatus.ERROR, "finalized"),
        (
            Condition("unconfigured", failure="organ x: expected, got"),
            DiagnosticStatus.ERROR,
            "unconfigured: organ x",
        ),
        (Condition("active"), DiagnosticStatus.OK, "no cloud yet"),
    ],
)
def test_node_that_answers_nothing_is_not_ok_for_monitors(condition, level, words):
    found, message = of_condition(condition, Report(OK))
    assert found == level and message.startswith(words)


def test_monitors_hear_what_became_of_the_newest_cloud():
    assert of_condition(Condition("active"), Report(OK, total_s=0.01)) == (DiagnosticStatus.OK, "ok")
    refused = of_condition(Condition("active"), Report(INVALID, "expected a cloud, got none"))
    assert refused == (DiagnosticStatus.ERROR, "expected a cloud, got none")


def test_status_and_diagnostics_say_what_a_cloud_was_matched_by():
    found = Report(OK, matching="bare")
    assert status_message(found, Setup(), Counts()).matching == values(found)["matching"] == "bare"
    assert status_message(Report(OK), Setup(), Counts()).matching == ""
