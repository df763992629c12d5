"""The answer: bytes changed in place say what a message filled point by point would say."""

import struct

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from integration.harness import write_organ
from softtissue_estimator.organ.organ import load_organ, make_organ
from softtissue_estimator.ros.outputs.answer_buffer import AnswerBuffer


@pytest.fixture(scope="module")
def organ(tmp_path_factory):
    return load_organ(write_organ(tmp_path_factory.mktemp("organ")))


def read(data):
    message = deserialize_message(data, PointCloud2)
    assert len(message.data) == 32 * message.width == message.row_step
    rows = [struct.unpack_from("<6fIf", bytes(message.data), 32 * row) for row in range(message.width)]
    return message, rows


def test_every_frame_overwrites_stamp_positions_displacements_and_sigma(organ):
    buffer = AnswerBuffer(organ)
    inside, rng = len(organ.structure_points), np.random.default_rng(0)
    for stamp in (7_000_000_009, 1_795_349_735_568_633_870):
        displacement = rng.normal(size=organ.query_points.shape)
        sigma = rng.uniform(size=len(displacement))
        message, rows = read(buffer.serialised(organ.query_points + displacement, displacement, sigma, stamp))
        assert len(rows) == inside
        np.testing.assert_allclose(
            [r[:3] for r in rows], (organ.query_points + displacement)[:inside], rtol=1e-6
        )
        np.testing.assert_allclose([r[3:6] for r in rows], displacement[:inside], rtol=1e-6)
        assert [r[6] for r in rows] == organ.structure_index.tolist()
        np.testing.assert_allclose([r[7] for r in rows], sigma[:inside], rtol=1e-6)
        assert message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec == stamp


def test_surface_has_its_own_rows(organ):
    inside, displacement = (
        len(organ.structure_points),
        np.arange(3.0 * len(organ.query_points)).reshape(-1, 3),
    )
    sigma = np.arange(1.0 * len(organ.query_points))
    data = AnswerBuffer(organ, surface=True).serialised(organ.query_points, displacement, sigma, 7)
    _, rows = read(data)
    np.testing.assert_allclose([r[:3] for r in rows], organ.surface.vertices, rtol=1e-6)
    np.testing.assert_allclose([r[3:6] for r in rows], displacement[inside:], rtol=1e-6)
    assert {r[6] for r in rows} == {len(organ.structures)}
    np.testing.assert_allclose([r[7] for r in rows], sigma[inside:])


def test_message_describes_itself(organ):
    message, _ = read(AnswerBuffer(organ).serialised(organ.query_points, organ.query_points, None, 0))
    assert (message.header.frame_id, message.height, message.point_step) == ("organ", 1, 32)
    assert message.is_dense and not message.is_bigendian
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        *((n, 4 * i, 7, 1) for i, n in enumerate(["x", "y", "z", "dx", "dy", "dz"])),
        ("structure", 24, 6, 1),
        ("sigma", 28, 7, 1),
    ]


def test_missing_sigma_is_nan_also_after_a_frame_that_had_one(organ):
    buffer, zeros = AnswerBuffer(organ), np.zeros_like(organ.query_points)
    buffer.serialised(zeros, zeros, np.ones(len(zeros)), 1)
    _, rows = read(buffer.serialised(zeros, zeros, None, 2))
    assert np.isnan([r[7] for r in rows]).all()


def test_bytes_of_a_frame_do_not_change_with_the_next(organ):
    buffer, zeros = AnswerBuffer(organ), np.zeros_like(organ.query_points)
    first = buffer.serialised(zeros, zeros, None, 1)
    before = bytes(bytearray(first))
    buffer.serialised(zeros + 1.0, zeros, None, 2)
    assert first == before


def test_organ_without_structures(organ):
    bare = make_organ(organ.name, organ.frame, organ.surface, (), organ.attached)
    message, rows = read(AnswerBuffer(bare).serialised(bare.query_points, bare.query_points, None, 5))
    assert rows == [] and message.header.stamp.nanosec == 5
