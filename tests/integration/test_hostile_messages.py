"""No message and no call ends the node; what cannot be used is refused in a sentence, and a good cloud is answered."""

import itertools
import tempfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.serialization import serialize_message
from softtissue_msgs.srv import LoadOrgan, WarpPoints

from integration.harness import running_node, write_organ
from integration.scene import CAMERA_FROM_ORGAN, Scene, registration_message

stamps = itertools.count(1_700_000_000_000_000_000, 100_000_000)
OK, INVALID = 0, 2
LONGEST_SENTENCE = 300


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"), coarse=True)


@pytest.fixture(scope="module")
def scene(folder):
    return Scene(folder)


@pytest.fixture(scope="module")
def running(folder, tmp_path_factory):
    # So that what a cloud leaves behind is the same however busy the machine is.
    with running_node(folder, tmp_path_factory.mktemp("node"), tracking_patience_s=60.0) as node_and_client:
        yield node_and_client


@pytest.fixture
def client(running, scene):
    """The client; afterwards a good cloud must be answered and the counts balanced."""
    node, client = running
    client.statuses.clear()
    yield client
    client.clouds.publish(scene.cloud(stamp := next(stamps)))
    status = client.status_of(stamp)
    assert status.level == OK, (status.reason, node.text)
    client.answer_of(stamp)
    settled = status.frames_answered + status.frames_dropped + status.frames_refused
    assert status.frames_received == settled
    assert node.process.poll() is None
    assert all(len(s.reason) <= LONGEST_SENTENCE and s.reason.isprintable() for s in client.statuses)


def refused_status(client, cloud):
    """Status that bears the very stamp of a cloud that is refused."""
    stamp = cloud.header.stamp

    def found():
        return next((s for s in client.statuses if s.header.stamp == stamp), None)

    client.clouds.publish(cloud)
    status = client.wait(found, f"status of {stamp}")
    assert (status.level, status.points_used) == (INVALID, 0)
    assert "expected" in status.reason and "got" in status.reason
    assert not any(answer.header.stamp == stamp for answer in client.answers)
    return status


@pytest.mark.parametrize(
    ("sec", "nanosec"),
    [(2**31 - 1, 2**32 - 1), (200, 2_345_678_901), (201, 10**9), (-1, 0), (-(2**31), 2**32 - 1)],
)
def test_stamp_out_of_range_is_refused_as_it_is(client, scene, sec, nanosec):
    cloud = scene.cloud(0)
    cloud.header.stamp = Time(sec=sec, nanosec=nanosec)
    assert "stamp" in refused_status(client, cloud).reason


def test_latest_stamp_in_range_is_answered(client, scene):
    client.clouds.publish(scene.cloud(latest := (2**31 - 1) * 10**9 + 10**9 - 1))
    assert client.status_of(latest).level == OK
    client.answer_of(latest)


LARGEST = 2**32 - 1
SIZES = [
    {"point_step": LARGEST},
    {"point_step": LARGEST, "row_step": LARGEST},
    {"point_step": 2**31},
    {"point_step": 0},
    {"width": LARGEST},
    {"height": LARGEST},
    {"height": LARGEST, "width": LARGEST, "point_step": LARGEST, "row_step": LARGEST},
]


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_absurd_sizes_are_refused(client, scene, sizes):
    cloud = scene.cloud(next(stamps))
    for name, value in sizes.items():
        setattr(cloud, name, value)
    refused_status(client, cloud)


@pytest.mark.parametrize("rows", [1, 2])
def test_absurd_row_step_matters_not_where_all_other_sizes_agree(client, scene, rows):
    cloud = scene.cloud(stamp := next(stamps))
    cloud.height, cloud.width, cloud.row_step = rows, cloud.width // rows, LARGEST
    client.clouds.publish(cloud)
    assert (client.status_of(stamp).level, client.status_of(stamp).points_used) == (OK, len(scene.points))
    client.answer_of(stamp)


@pytest.mark.parametrize(
    "change", [{"offset": LARGEST}, {"count": LARGEST}, {"datatype": 255}, {"name": 5000 * "x\n"}]
)
def test_absurd_fields_are_refused(client, scene, change):
    cloud = scene.cloud(next(stamps))
    for name, value in change.items():
        setattr(cloud.fields[1], name, value)
    refused_status(client, cloud)


@pytest.mark.parametrize("frame", [5000 * "a", "a\nb\x1b[2J", "\u202e\u2028", "\ud7ff"])
def test_frame_of_any_text_is_refused_in_one_short_line(client, scene, frame):
    refused_status(client, scene.cloud(next(stamps), frame=frame))


@pytest.mark.parametrize("value", [1e30, 3.4e38, -1e20, 1e-45])
def test_coordinates_of_any_size_end_nothing(client, scene, value):
    points = np.full_like(scene.points, value)
    client.clouds.publish(scene.cloud(stamp := next(stamps), points=points))
    client.status_of(stamp)


@pytest.mark.parametrize("topic", ["clouds", "pairs", "registrations"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_bytes_that_are_no_message_are_left(client, scene, topic, share):
    messages = {
        "clouds": scene.cloud(next(stamps)),
        "pairs": scene.pairs(next(stamps)),
        "registrations": registration_message(CAMERA_FROM_ORGAN),
    }
    whole = serialize_message(messages[topic])
    noise = np.random.default_rng(int(100 * share)).bytes(len(whole))
    keep = int(share * len(whole))
    for data in (whole[: max(keep, 4)], whole[:4] + noise[4:], whole[:keep] + noise[keep:]):
        getattr(client, topic).publish(data)
        client.spin(0.1)


@pytest.mark.parametrize(
    ("part", "value"), [("translation", 1e308), ("translation", 1e4), ("rotation", 1e308), ("rotation", 0.0)]
)
def test_absurd_registration_is_left(running, client, part, value):
    bad = registration_message(CAMERA_FROM_ORGAN)
    for axis in "xyzw" if part == "rotation" else "xyz":
        setattr(getattr(bad.transform, part), axis, value)
    client.registrations.publish(bad)
    running[0].wait_for_text("registration: expected", 10.0)


@pytest.mark.parametrize(
    "points", [[1e200, 0.0, 0.0], [0.0, -1e308, 0.0], [0.0, 0.0, 1e5], [float("inf"), 0.0, 0.0]]
)
def test_warp_points_far_away_is_refused(client, scene, points):
    client.clouds.publish(scene.cloud(stamp := next(stamps)))
    client.answer_of(stamp)
    response = client.call(WarpPoints, "warp_points", WarpPoints.Request(points=points))
    assert response.result == WarpPoints.Response.INVALID_POINTS
    assert "expected" in response.message and "got" in response.message


def parameter(kind, name="frame_budget_s"):
    return Parameter(name=name, value=ParameterValue(type=kind))


@pytest.mark.parametrize("kind", [10, 77, 255])
def test_parameter_types_that_do_not_exist_are_refused(client, kind):
    good = Parameter(
        name="no_data_timeout_s", value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=7.0)
    )
    request = SetParameters.Request(parameters=[good, parameter(kind)])
    results = client.call(SetParameters, "set_parameters", request).results
    assert [r.successful for r in results] == [False, False]
    assert f"got {kind}" in results[1].reason
    request = SetParametersAtomically.Request(parameters=[good, parameter(kind)])
    result = client.call(SetParametersAtomically, "set_parameters_atomically", request).result
    assert not result.successful and f"got {kind}" in result.reason
    names = GetParameters.Request(names=["no_data_timeout_s"])
    values = client.call(GetParameters, "get_parameters", names).values
    assert values[0].double_value == 2.0, "all are refused or none"


@pytest.mark.parametrize("kind", range(10))
@pytest.mark.parametrize(
    "name", ["frame_budget_s", "organ", "minimum_points", "use_sim_time", "nobody\nknows"]
)
def test_parameters_of_every_type_are_answered(client, kind, name):
    request = SetParameters.Request(parameters=[parameter(kind, name)])
    (result,) = client.call(SetParameters, "set_parameters", request).results
    assert result.successful or result.reason


@pytest.mark.parametrize("number", [0, 1, 55, 99, 255])
def test_transition_that_does_not_exist_is_refused(client, number):
    request = ChangeState.Request(transition=Transition(id=number))
    assert not client.call(ChangeState, "change_state", request).success


@pytest.mark.parametrize(
    "path", ["/nowhere", "/proc/1", "x" * 300, "/a" * 3000, "~nosuchuser", "/tmp/\x1b[2J\n", "/dev/zero"]
)
def test_load_organ_of_any_path_is_answered(client, path):
    response = client.call(LoadOrgan, "load_organ", LoadOrgan.Request(folder=path))
    assert response.result == LoadOrgan.Response.INVALID_ORGAN
    assert response.message.isprintable() and len(response.message) <= LONGEST_SENTENCE


def test_load_organ_outside_of_the_root_is_refused(client, folder, tmp_path_factory):
    # By default where the configured organ lies, and the bundled organs.
    sibling = write_organ(tmp_path_factory.mktemp("sibling"))
    response = client.call(LoadOrgan, "load_organ", LoadOrgan.Request(folder=str(sibling)))
    assert response.result == LoadOrgan.Response.SUCCESS, response.message
    with tempfile.TemporaryDirectory() as elsewhere:
        write_organ(Path(elsewhere))
        response = client.call(LoadOrgan, "load_organ", LoadOrgan.Request(folder=elsewhere))
        assert response.result == LoadOrgan.Response.INVALID_ORGAN
        assert "organ_root" in response.message
        (sibling / "organ.yaml").write_text(f"unit: mm\nsurface: {elsewhere}/surface.ply\n")
        response = client.call(LoadOrgan, "load_organ", LoadOrgan.Request(folder=str(sibling)))
        assert response.result == LoadOrgan.Response.INVALID_ORGAN
        assert "organ_root" in response.message
    text = ParameterValue(type=ParameterType.PARAMETER_STRING_ARRAY, string_array_value=["/"])
    request = SetParameters.Request(parameters=[Parameter(name="organ_root", value=text)])
    (result,) = client.call(SetParameters, "set_parameters", request).results
    assert not result.successful, "nobody on the ROS graph widens it"
    back = client.call(LoadOrgan, "load_organ", LoadOrgan.Request(folder=str(folder)))
    assert back.result == LoadOrgan.Response.SUCCESS, back.message
