"""The messages as built: they survive serialisation, and their hot fields are flat arrays. Run by `colcon test`."""

import array
import math

import pytest
from ament_index_python.packages import get_package_prefix
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped
from rclpy.serialization import deserialize_message, serialize_message
from softtissue_msgs.msg import Correspondences, Distances, EstimatorStatus, Structures
from softtissue_msgs.srv import DecideRegistration, Distance, LoadOrgan, Reset, WarpPoints
from std_msgs.msg import ColorRGBA, Header

HEADER = Header(stamp=Time(sec=1_700_000_123, nanosec=987_654_321), frame_id="organ")

DISTANCES = Distances(
    header=HEADER,
    estimate_stamp=Time(sec=1_700_000_122, nanosec=3),
    names=["tumour", "vein"],
    kinds=["lesion", "vessel"],
    distance=[0.25, -0.125],
    sigma=[0.5, 0.0625],
    nearest=[Point(x=1.0, y=2.0, z=3.0), Point(x=4.0)],
    covariance=[0.125 * i for i in range(18)],
    ahead=[0.75, 0.875],
    ahead_sigma=[0.375, math.inf],
)

# Every field has a value that is neither its default nor that of a neighbour of the same type; floats are exact in
# single precision.
MESSAGES = {
    "Correspondences": Correspondences(
        header=HEADER,
        index=[0, 7, 4_000_000_000],
        reference=[0.125 * i for i in range(9)],
        sigma=[0.5, 0.25, 2.0],
    ),
    "Structures": Structures(
        header=HEADER,
        organ="Phantom liver",
        names=["tumour", "vein"],
        kinds=["lesion", "vessel"],
        colours=[ColorRGBA(r=0.25, g=0.5, b=0.75, a=1.0), ColorRGBA(r=0.125, g=0.375, b=0.625, a=0.5)],
        first_vertex=[0, 5, 9],
        first_face=[0, 2, 3],
        faces=[0, 1, 2, 2, 3, 4, 5, 7, 8],
        surface_faces=[0, 2, 1],
    ),
    "Distances": DISTANCES,
    "Distance.Request": Distance.Request(tool=PoseStamped(header=HEADER)),
    "Distance.Response": Distance.Response(
        result=Distance.Response.WRONG_FRAME, message="no pose", distances=DISTANCES
    ),
    "EstimatorStatus": EstimatorStatus(
        header=HEADER,
        level=EstimatorStatus.DEGRADED,
        reason="the cloud shows 3 % of the surface, expected at least 5 %",
        estimator="elastic",
        device="cuda:0",
        organ="Phantom liver – Größe 2",
        matching="tracks",
        registration="found",
        visible_fraction=0.03125,
        points_used=40_000,
        points_rejected=17,
        frames_received=2**40 + 1,
        frames_answered=2**40 - 2,
        frames_dropped=2,
        frames_refused=3,
        stage_names=["parse", "estimate"],
        stage_seconds=[0.0625, 0.5],
        total_seconds=0.75,
        registration_translation_error=0.0078125,
        registration_rotation_error=0.046875,
        registration_translation_sigma=0.001953125,
        registration_rotation_sigma=0.015625,
        outlier_fraction=0.375,
        innovation_rms=1.25,
        structure_names=["tumour", "portal vein"],
        structure_sigmas=[0.00390625, 0.125],
    ),
    "LoadOrgan.Request": LoadOrgan.Request(folder="/data/liver"),
    "LoadOrgan.Response": LoadOrgan.Response(
        result=LoadOrgan.Response.INVALID_ORGAN,
        message="no organ.yaml",
        name="liver",
        structures=3,
        vertices=20_000,
    ),
    "WarpPoints.Request": WarpPoints.Request(header=HEADER, points=[0.1, -0.2, 0.3]),
    "WarpPoints.Response": WarpPoints.Response(
        result=WarpPoints.Response.NOT_ACTIVE,
        message="the node is inactive",
        header=HEADER,
        points=[0.11, -0.22, 0.33],
        displacement=[0.01, -0.02, 0.03],
        sigma=[0.004],
    ),
    "DecideRegistration.Request": DecideRegistration.Request(decision=DecideRegistration.Request.FREEZE),
    "DecideRegistration.Response": DecideRegistration.Response(
        result=DecideRegistration.Response.INVALID, message="no registration"
    ),
    "Reset.Request": Reset.Request(),
    "Reset.Response": Reset.Response(
        result=Reset.Response.NOT_CONFIGURED, message="the node is unconfigured"
    ),
}


def roundtrip(message):
    return deserialize_message(serialize_message(message), type(message))


@pytest.mark.parametrize("name", MESSAGES)
def test_message_survives_serialisation(name):
    assert roundtrip(MESSAGES[name]) == MESSAGES[name]


@pytest.mark.parametrize("name", MESSAGES)
def test_every_field_is_exercised(name):
    message, empty = MESSAGES[name], type(MESSAGES[name])()
    fields = [
        field
        for field in message.get_fields_and_field_types()
        if field != "structure_needs_at_least_one_member"
    ]
    assert [field for field in fields if getattr(message, field) == getattr(empty, field)] == []


@pytest.mark.parametrize(
    ("message", "field", "typecode"),
    [
        (Correspondences, "index", "I"),
        (Correspondences, "reference", "f"),
        (Correspondences, "sigma", "f"),
        (EstimatorStatus, "stage_seconds", "f"),
        (EstimatorStatus, "structure_sigmas", "f"),
        (Distances, "distance", "d"),
        (Distances, "covariance", "d"),
        (WarpPoints.Request, "points", "d"),
        (WarpPoints.Response, "points", "d"),
        (WarpPoints.Response, "displacement", "d"),
        (WarpPoints.Response, "sigma", "d"),
    ],
)
def test_hot_field_is_one_flat_array(message, field, typecode):
    value = getattr(message(), field)
    assert isinstance(value, array.array)
    assert value.typecode == typecode


def test_nan_stands_for_no_answer():
    response = roundtrip(WarpPoints.Response(sigma=[0.5, math.nan], points=[math.nan]))
    assert response.sigma[0] == 0.5
    assert math.isnan(response.sigma[1])
    assert math.isnan(response.points[0])


@pytest.mark.parametrize(
    ("message", "constants"),
    [
        (EstimatorStatus, {"OK": 0, "DEGRADED": 1, "INVALID": 2}),
        (
            LoadOrgan.Response,
            {"SUCCESS": 0, "INVALID_ORGAN": 1, "NOT_CONFIGURED": 2, "INTERNAL_ERROR": 3, "BUSY": 4},
        ),
        (
            WarpPoints.Response,
            {
                "SUCCESS": 0,
                "NO_ESTIMATE": 1,
                "INVALID_POINTS": 2,
                "WRONG_FRAME": 3,
                "NOT_ACTIVE": 4,
                "INTERNAL_ERROR": 5,
                "BUSY": 6,
            },
        ),
        (
            Distance.Response,
            {
                "SUCCESS": 0,
                "NO_ESTIMATE": 1,
                "INVALID_TOOL": 2,
                "WRONG_FRAME": 3,
                "NOT_ACTIVE": 4,
                "INTERNAL_ERROR": 5,
                "BUSY": 6,
            },
        ),
        (DecideRegistration.Request, {"ACCEPT": 1, "REJECT": 2, "FREEZE": 3}),
        (
            DecideRegistration.Response,
            {"SUCCESS": 0, "INVALID": 1, "NOT_ACTIVE": 2, "INTERNAL_ERROR": 3},
        ),
        (Reset.Response, {"SUCCESS": 0, "NOT_CONFIGURED": 1, "INTERNAL_ERROR": 2, "BUSY": 3}),
    ],
)
def test_constants_keep_their_values(message, constants):
    # Recorded bags hold the numbers, so the numbers may not move.
    assert {name: getattr(message, name) for name in constants} == constants


def test_package_is_in_the_ament_index():
    assert get_package_prefix("softtissue_msgs")
