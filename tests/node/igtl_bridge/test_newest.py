"""What clients are told, when, and what no longer."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")
pytest.importorskip("pyigtl", reason="pyigtl, of the extra `igtl`, is not installed")

from geometry_msgs.msg import PoseWithCovarianceStamped
from softtissue_msgs.msg import EstimatorStatus, Structures
from std_msgs.msg import ColorRGBA

from estimator.igtl.reference import split, surface
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.igtl_bridge.newest import STATUS, TRANSFORM, Newest
from softtissue_estimator.ros.inputs.conversions import make_cloud, time_message

S = 1_000_000_000
AGE = 1.0
RECORD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "sigma")])
POINTS = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]])


def described(names=("vein", "tumour"), organ="Liver", rows=4):
    message = Structures(
        names=list(names), kinds=list(names), colours=[ColorRGBA()] * len(names), organ=organ
    )
    message.first_vertex = [rows * n for n in range(len(names) + 1)]
    message.first_face = list(range(len(names) + 1))
    message.faces = [rows * n + corner for n in range(len(names)) for corner in (0, 1, 3)]
    message.surface_faces = [0, 1, 2]
    return message


def cloud(stamp, points=None, shift=0.0):
    points = np.concatenate([POINTS, POINTS + 0.1]) if points is None else points
    table = np.zeros(len(points), dtype=RECORD)
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis] + shift
    return make_cloud(table, "organ", stamp)


def pose(stamp, z=0.2):
    message = PoseWithCovarianceStamped()
    message.header.frame_id, message.header.stamp = "eye", time_message(stamp)
    message.pose.pose.orientation.w, message.pose.pose.position.z = 1.0, z
    return message


def status(level=EstimatorStatus.OK, reason="", stamp=0):
    message = EstimatorStatus(level=level, reason=reason)
    message.header.stamp = time_message(stamp)
    return message


class Bridge(Newest):
    """With a clock that the test turns."""

    def __init__(self, system="LPS"):
        self.now = 100.0
        super().__init__(system, lambda: self.now, lambda: 1e9 + self.now)

    def told(self, after=0.0):
        """Messages by device, taken apart, and withdrawn devices, so much later."""
        self.now += after
        due = self.due(AGE)
        return {name: split(message.data) for name, message in due.messages.items()}, due.withdrawn

    def words(self, after=0.0):
        return self.told(after)[0][STATUS][4][4:].decode()


@pytest.fixture
def bridge():
    made = Bridge()
    made.take_structures(described())
    made.take_status(status())
    return made


def test_each_structure_is_a_device_in_ras_and_mm(bridge):
    bridge.take_points(cloud(5 * S))
    bridge.take_surface(cloud(5 * S, POINTS))
    bridge.take_pose(pose(5 * S))
    told, withdrawn = bridge.told()
    assert withdrawn == [] and set(told) == {STATUS, TRANSFORM, "Liver", "vein", "tumour"}
    kinds = {name: kind for name, (kind, *_) in told.items()}
    assert [kinds[name] for name in (STATUS, TRANSFORM, "vein")] == ["STRING", "TRANSFORM", "POLYDATA"]
    points, faces = surface(told["tumour"][4])
    np.testing.assert_allclose(points, 1e3 * (POINTS + 0.1) * [-1, -1, 1], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(faces, [[0, 1, 3]])
    points, faces = surface(told["Liver"][4])
    np.testing.assert_allclose(points, 1e3 * POINTS * [-1, -1, 1], rtol=1e-5)
    np.testing.assert_array_equal(faces, [[0, 1, 2]])
    assert {told[name][2] for name in ("Liver", "vein", "tumour", TRANSFORM)} == {5.0}  # stamps of the answer


def test_organ_in_ras_stays_as_it_is():
    bridge = Bridge("RAS")
    bridge.take_structures(described())
    bridge.take_points(cloud(5 * S))
    points, _ = surface(bridge.told()[0]["vein"][4])
    np.testing.assert_allclose(points, 1e3 * POINTS, rtol=1e-5)


def test_an_answer_is_told_once_and_only_the_newest(bridge):
    bridge.take_points(cloud(5 * S))
    bridge.take_points(cloud(6 * S, shift=0.001))
    told, _ = bridge.told()
    assert told["vein"][2] == 6.0
    assert bridge.told(0.5) == ({}, [])
    bridge.take_points(cloud(7 * S))
    assert set(bridge.told()[0]) == {"vein", "tumour"}


def test_answer_that_is_too_old_is_withdrawn_and_said(bridge):
    bridge.take_points(cloud(5 * S))
    bridge.take_pose(pose(5 * S))
    assert bridge.words() == "OK"
    told, withdrawn = bridge.told(0.99)
    assert (told, withdrawn) == ({}, [])
    told, withdrawn = bridge.told(0.02)
    assert sorted(withdrawn) == [TRANSFORM, "tumour", "vein"]
    assert told[STATUS][4][4:] == b"NO ANSWER: expected an answer within 1 s (maximum_age_s), got none"
    assert set(told) == {STATUS}
    bridge.take_points(cloud(7 * S))
    assert bridge.words() == "OK"


def test_invalid_ends_what_was_told_and_what_was_on_its_way(bridge):
    bridge.take_points(cloud(5 * S))
    bridge.told()
    bridge.take_status(status(EstimatorStatus.INVALID, "the organ is lost", 6 * S))
    bridge.take_points(cloud(6 * S))  # came late: it is not after what was INVALID
    told, withdrawn = bridge.told()
    assert sorted(withdrawn) == ["tumour", "vein"] and set(told) == {STATUS}
    assert told[STATUS][4][4:] == b"INVALID: the organ is lost"
    bridge.take_points(cloud(7 * S))
    assert {"vein", "tumour"} <= set(bridge.told()[0])
    bridge.take_status(status(EstimatorStatus.DEGRADED, "little is seen", 7 * S))
    assert bridge.words() == "DEGRADED: little is seen"


def test_status_is_told_when_it_changes_and_every_second(bridge):
    bridge.take_points(cloud(5 * S))
    assert bridge.words() == "OK"
    assert STATUS not in bridge.told(0.5)[0]
    bridge.take_points(cloud(6 * S))
    assert bridge.told(0.6)[0][STATUS][2] == 1e9 + 101.1


def test_before_anything_came_it_is_said_what_is_missing():
    bridge = Bridge()
    bridge.take_points(cloud(5 * S))  # of an organ that nobody described yet
    assert (
        bridge.words() == "NO ANSWER: expected structures of the organ within 1 s (maximum_age_s), got none"
    )


def test_another_organ_takes_the_devices_of_the_one_before(bridge):
    bridge.take_points(cloud(5 * S))
    bridge.take_surface(cloud(5 * S, POINTS))
    bridge.told()
    bridge.take_structures(described(names=("artery",), organ="Kidney"))
    told, withdrawn = bridge.told()
    assert sorted(withdrawn) == ["Liver", "tumour", "vein"] and not {"artery", "Kidney"} & set(told)
    bridge.take_points(cloud(6 * S, POINTS))
    bridge.take_surface(cloud(6 * S, POINTS))
    assert {"artery", "Kidney"} <= set(bridge.told()[0])


def test_structure_may_be_called_as_another_device():
    bridge = Bridge()
    bridge.take_structures(described(names=(STATUS, "Liver")))
    bridge.take_points(cloud(5 * S))
    assert set(bridge.told()[0]) == {STATUS, "Status 2", "Liver 2"}


def test_messages_that_cannot_be_used_are_refused_and_leave_the_others(bridge):
    bridge.take_points(cloud(5 * S))
    wrong = described()
    wrong.faces = [0, 1, 2, 99]
    bad = np.concatenate([POINTS, POINTS])
    bad[3] = np.nan
    for take, message, words in (
        (bridge.take_structures, wrong, "triangles"),
        (bridge.take_points, cloud(6 * S, POINTS), "expected 8 rows in an answer, got 4"),
        (bridge.take_points, cloud(6 * S, bad), "finite"),
        (bridge.take_surface, cloud(6 * S, POINTS[:2]), "expected at least 3 rows of a surface, got 2"),
        (bridge.take_pose, pose(6 * S, np.inf), "finite"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            take(message)
    assert bridge.told()[0]["vein"][2] == 5.0
