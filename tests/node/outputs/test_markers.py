"""The organ's markers: bytes changed in place say what a message filled point by point would say."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.serialization import deserialize_message
from visualization_msgs.msg import Marker, MarkerArray

from integration.harness import write_organ
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.ros.outputs.markers import MarkerBuffer, delete_all


@pytest.fixture(scope="module")
def organ(tmp_path_factory):
    return load_organ(write_organ(tmp_path_factory.mktemp("organ")))


def corners(marker):
    return np.array([[p.x, p.y, p.z] for p in marker.points])


def test_bytes_hold_the_moved_triangles_of_every_mesh(organ):
    buffer = MarkerBuffer(organ)
    rng = np.random.default_rng(0)
    for stamp, lifetime_s in ((1_234_567_890_000_000_001, 1.5), (2_000_000_000_999_999_999, 0.25)):
        positions = organ.query_points + rng.normal(scale=0.01, size=organ.query_points.shape)
        message = deserialize_message(buffer.serialised(positions, stamp, lifetime_s), MarkerArray)
        meshes = [*(s.mesh for s in organ.structures), organ.surface]
        names = [*(s.name for s in organ.structures), organ.name]
        assert [m.ns for m in message.markers] == names
        first = 0
        for marker, mesh in zip(message.markers, meshes, strict=True):
            expected = positions[first : first + len(mesh.vertices)][mesh.faces].reshape(-1, 3)
            np.testing.assert_array_equal(corners(marker), expected)
            assert marker.header.frame_id == "organ"
            assert marker.header.stamp.sec * 1_000_000_000 + marker.header.stamp.nanosec == stamp
            assert (marker.type, marker.action) == (Marker.TRIANGLE_LIST, Marker.ADD)
            assert marker.lifetime.sec + 1e-9 * marker.lifetime.nanosec == pytest.approx(lifetime_s)
            assert (marker.scale.x, marker.pose.orientation.w) == (1.0, 1.0)
            first += len(mesh.vertices)


def test_structures_are_coloured_and_the_organ_translucent(organ):
    message = deserialize_message(MarkerBuffer(organ).serialised(organ.query_points, 0, 1.0), MarkerArray)
    colours = [(m.color.r, m.color.g, m.color.b, m.color.a) for m in message.markers]
    for colour, structure in zip(colours, organ.structures, strict=False):
        np.testing.assert_allclose(colour, structure.colour, atol=1e-6)
    assert 0.0 < colours[-1][3] < 0.5
    assert len({m.id for m in message.markers}) == len(message.markers)


def test_delete_all():
    message = delete_all("organ")
    assert [(m.action, m.header.frame_id) for m in message.markers] == [(Marker.DELETEALL, "organ")]
