"""Messages to arrays and back, for the layouts that drivers send; references are packed by hand."""

import gc
import itertools
import struct

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from softtissue_msgs.msg import Correspondences
from std_msgs.msg import Header

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs import conversions
from softtissue_estimator.ros.inputs.cloud_layout import columns
from softtissue_estimator.ros.inputs.correspondences import read_correspondences
from softtissue_estimator.ros.outputs import serialised

POINTS = np.array([[0.125, -0.25, 0.5], [1.0, 2.0, -3.0], [-0.0625, 7.0, 0.75], [4.0, 5.0, 6.0]])


def pack(code, points, step, offsets, width, height, row_padding, big):
    """Lay out points by hand: `code` is 'f' or 'd', `offsets` the bytes at which x, y and z begin."""
    order = ">" if big else "<"
    rows = []
    for row in range(height):
        data = bytearray(b"\xee" * (step * width + row_padding))
        for column in range(width):
            for value, offset in zip(points[row * width + column], offsets, strict=True):
                struct.pack_into(order + code, data, column * step + offset, value)
        rows.append(bytes(data))
    kind = {"f": PointField.FLOAT32, "d": PointField.FLOAT64}[code]
    fields = [
        PointField(name=n, offset=o, datatype=kind, count=1) for n, o in zip("xyz", offsets, strict=True)
    ]
    return PointCloud2(
        header=Header(stamp=Time(sec=12, nanosec=345), frame_id="camera"),
        width=width, height=height, fields=fields, is_bigendian=big, point_step=step,
        row_step=step * width + row_padding, data=b"".join(rows),
    )  # fmt: skip


LAYOUTS = {
    "tight float32": ("f", 12, (0, 4, 8)),
    "realsense": ("f", 16, (0, 4, 8)),
    "velodyne-like": ("f", 22, (4, 8, 12)),
    "z y x": ("f", 20, (16, 4, 0)),
    "float64": ("d", 24, (0, 8, 16)),
    "float64 unaligned": ("d", 29, (1, 10, 20)),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(
    ("shape", "padding", "big"),
    list(itertools.product([(4, 1), (2, 2), (1, 4)], [0, 7], [False, True])),
)
def test_every_layout_reads_the_same_points(layout, shape, padding, big):
    code, step, offsets = LAYOUTS[layout]
    cloud = conversions.read_cloud(pack(code, POINTS, step, offsets, *shape, padding, big))
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert (cloud.frame, cloud.stamp_ns, cloud.reference) == ("camera", 12_000_000_345, None)


@pytest.mark.parametrize(
    ("code", "step", "offsets"), [LAYOUTS["realsense"], LAYOUTS["velodyne-like"], LAYOUTS["float64"]]
)
@pytest.mark.parametrize("big", [False, True])
def test_reading_neither_copies_nor_allows_to_write(code, step, offsets, big):
    message = pack(code, POINTS, step, offsets, 4, 1, 0, big)
    cloud = conversions.read_cloud(message)
    assert np.shares_memory(cloud.points, np.frombuffer(message.data, dtype=np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        cloud.points[:] = 0.0


def test_points_stay_when_the_message_is_gone():
    message = pack("f", POINTS, 16, (0, 4, 8), 4, 1, 0, False)
    points = conversions.read_cloud(message).points
    del message
    gc.collect()
    np.testing.assert_array_equal(points, POINTS)


def test_position_and_reference_come_from_their_own_fields():
    message = pack("f", POINTS, 24, (0, 4, 8), 4, 1, 0, False)
    data = np.frombuffer(bytes(message.data), dtype="<f4").reshape(4, 6).copy()
    data[:, 3:] = POINTS[::-1]
    message.data = data.tobytes()
    message.fields = [
        *message.fields,
        *(PointField(name=f"ref_{n}", offset=12 + 4 * i, datatype=7, count=1) for i, n in enumerate("xyz")),
    ]
    cloud = conversions.read_cloud(message)
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.reference, POINTS[::-1])


def test_driver_that_leaves_row_step_unset():
    message = pack("f", POINTS, 16, (0, 4, 8), 4, 1, 0, False)
    message.row_step = 0
    np.testing.assert_array_equal(conversions.read_cloud(message).points, POINTS)


@pytest.mark.parametrize(
    ("shape", "changes"),
    [
        ((2, 2), {"row_step": 0}),
        ((2, 2), {"row_step": 64}),
        ((2, 2), {"row_step": 2}),
        ((1, 4), {"row_step": 2**32 - 1}),
        ((4, 1), {"row_step": 64 + 1600}),
        ((4, 1), {"row_step": 16}),
        ((4, 1), {"height": 0}),
        ((4, 1), {"height": 0, "row_step": 0}),
        ((4, 1), {"width": 0}),
    ],
)
def test_one_size_that_contradicts_the_others_does_not_matter(shape, changes):
    """Width, height, step and amount of data say the same; row_step, or a size that is 0, does not."""
    message = pack("f", POINTS, 16, (0, 4, 8), *shape, 0, False)
    for name, value in changes.items():
        setattr(message, name, value)
    np.testing.assert_array_equal(conversions.read_cloud(message).points, POINTS)


def broken(**changes):
    message = pack("f", POINTS, 16, (0, 4, 8), 4, 1, 0, False)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def fields(*names, datatype=PointField.FLOAT32, step=4):
    return [PointField(name=n, offset=step * i, datatype=datatype, count=1) for i, n in enumerate(names)]


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (broken(width=0, data=b""), "at least one point, got width 0"),
        (broken(fields=fields("x", "y", "depth")), "fields x y z, got x y depth"),
        (broken(fields=[]), "got none"),
        (broken(fields=fields("x", "y", "z", datatype=PointField.INT16)), "float32 or float64, got int16"),
        (broken(fields=fields("x", "y", "z", step=8)), "point_step 16 bytes, got offset 16 \\+ 4"),
        (broken(data=b"\x00" * 63), "expected 64 bytes of data .* got 63"),
        (broken(data=b"\x00" * 80), "expected 64 bytes of data .* got 80"),
        (broken(height=2, row_step=32), "row_step of at least"),
        (broken(height=2, row_step=128), "expected 256 bytes of data .row_step 128 x height 2., got 64"),
        (broken(height=0, width=3), "at least one point, got width 3 x height 0"),
        (broken(height=2, width=0), "at least one point, got width 0 x height 2"),
        (broken(point_step=2**32 - 1), "point_step of at most 65536 bytes, got 4294967295"),
        (
            broken(fields=[*fields("x", "y"), PointField(name="z", offset=8, datatype=7, count=3)]),
            "field z, got 3",
        ),
        (broken(fields=fields("x", "y", "z", "ref_x"), point_step=16), "ref_x ref_y ref_z, got x y z ref_x"),
    ],
)
def test_unusable_cloud_is_refused_in_a_sentence(message, words):
    with pytest.raises(InvalidInputError, match=words):
        conversions.read_cloud(message)


def test_correspondences_default_to_the_first_rows():
    message = Correspondences(reference=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    pairs = read_correspondences(message, rows=9)
    np.testing.assert_array_equal(pairs.index, [0, 1])
    np.testing.assert_array_equal(pairs.reference, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    assert pairs.sigma is None


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"reference": []}, "3 numbers an entry, got 0"),
        ({"reference": [1.0] * 8}, "3 numbers an entry, got 8"),
        ({"reference": [1.0] * 12}, "as many entries as the cloud has points \\(3\\), got 4"),
        ({"reference": [float("inf")] + [1.0] * 5}, "finite references, got 1 of 2"),
        ({"reference": [1.0] * 6, "index": [0]}, "index to have 2 entries or none, got 1"),
        ({"reference": [1.0] * 6, "index": [0, 3]}, "index below the cloud's 3 rows, got 3"),
        ({"reference": [1.0] * 6, "index": [2, 2]}, "at most once"),
        ({"reference": [1.0] * 6, "sigma": [0.1]}, "sigma to have 2 entries or none, got 1"),
        ({"reference": [1.0] * 6, "sigma": [0.1, 0.0]}, "positive finite sigma .* got 1 of 2"),
    ],
)
def test_unusable_correspondences_are_refused_in_a_sentence(given, words):
    with pytest.raises(InvalidInputError, match=words):
        read_correspondences(Correspondences(**given), rows=3)


def transform(x, y, z, w, shift=(0.0, 0.0, 0.0)):
    message = TransformStamped()
    rotation, translation = message.transform.rotation, message.transform.translation
    rotation.x, rotation.y, rotation.z, rotation.w = x, y, z, w
    translation.x, translation.y, translation.z = shift
    return message


def test_transform_turns_the_right_way():
    half = np.sqrt(0.5)
    matrix = conversions.read_transform(transform(0.0, 0.0, half, half, (1.0, 2.0, 3.0)))
    # A quarter turn about z takes x to y.
    np.testing.assert_allclose(matrix @ [1.0, 0.0, 0.0, 1.0], [1.0, 3.0, 3.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (transform(0.0, 0.0, 0.0, 0.0), "length 1, got 0"),
        (transform(1.0, 1.0, 0.0, 0.0), "length 1, got 1.414"),
        (transform(float("nan"), 0.0, 0.0, 1.0), "finite"),
        (transform(0.0, 0.0, 0.0, 1.0, (float("inf"), 0.0, 0.0)), "finite"),
        (transform(0.0, 0.0, 1e308, 1e308), "length 1, got 1.41"),
        (transform(0.0, 0.0, 0.0, 1.0, (0.0, -1000.5, 0.0)), "at most 1000 m, got 1000"),
    ],
)
def test_unusable_transform_is_refused(message, words):
    with pytest.raises(InvalidInputError, match=words):
        conversions.read_transform(message)


@pytest.mark.parametrize(("sec", "nanosec"), [(-1, 0), (0, 10**9), (2**31 - 1, 2**32 - 1)])
def test_stamp_that_an_answer_could_not_bear_is_refused(sec, nanosec):
    message = broken(header=Header(stamp=Time(sec=sec, nanosec=nanosec)))
    with pytest.raises(InvalidInputError, match=f"less than 1000000000 ns, got {sec} s {nanosec} ns"):
        conversions.check_cloud(message, with_reference=False)
    latest = broken(header=Header(stamp=Time(sec=2**31 - 1, nanosec=10**9 - 1)))
    conversions.check_cloud(latest, with_reference=False)


def test_stamp_of_a_serialised_message():
    message = broken()
    data = serialize_message(message)
    assert serialised.read_stamp(data) == 12_000_000_345
    changed = deserialize_message(serialised.with_stamp(data, 99_000_000_001), PointCloud2)
    assert (changed.header.stamp.sec, changed.header.stamp.nanosec) == (99, 1)
    changed.header.stamp = message.header.stamp
    assert changed == message


def test_columns_of_different_types_bear_numbers_that_are_none():
    """A signalling NaN, which only a damaged message has: what is no number is told later, in a sentence."""
    table = np.zeros((1, 3), dtype=[("x", "<f4"), ("y", "<f8"), ("z", "<f4")])
    table.view(np.uint8).reshape(1, 3, 16)[0, 1, :4] = np.frombuffer(bytes.fromhex("0100a07f"), np.uint8)
    with np.errstate(all="raise"):
        found = columns(table, ("x", "y", "z"))
    np.testing.assert_array_equal(np.isnan(found), [[False] * 3, [True, False, False], [False] * 3])
