"""The normals that the fields of a cloud hold, as PCL writes them and as others do."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.point_normals import read_normals, turn_normals

NAMES = ("normal_x", "normal_y", "normal_z")
TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
NORMALS = np.array([[0.0, 0.0, 1.0], [np.nan, np.nan, np.nan], [0.5, -0.25, 2.0], [0.0, 0.0, 0.0]])


def cloud(types, big=False, height=1, names=NAMES):
    """A cloud of points at the origin with normals, each field of a type of its own, after a gap of four bytes."""
    order = ">" if big else "<"
    kinds = [(name, order + "f4") for name in ("x", "y", "z", "gap")]
    rows = np.zeros(len(NORMALS), dtype=kinds + [(n, order + t) for n, t in zip(names, types, strict=True)])
    for name, column in zip(names, NORMALS.T, strict=False):
        rows[name] = np.nan_to_num(column) if rows[name].dtype.kind != "f" else column
    fields = [
        PointField(name=name, offset=offset, datatype=TYPES[kind.str[1:]], count=1)
        for name, (kind, offset) in rows.dtype.fields.items()
        if name != "gap"
    ]
    width = len(rows) // height
    return PointCloud2(
        height=height, width=width, fields=fields, is_bigendian=big, point_step=rows.itemsize,
        row_step=width * rows.itemsize, data=rows.tobytes(),
    )  # fmt: skip


@pytest.mark.parametrize("types", [("f4",) * 3, ("f8",) * 3, ("f4", "f8", "f4")])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("height", [1, 2])
def test_floats_are_read_row_by_row_with_what_is_no_number(types, big, height):
    np.testing.assert_array_equal(read_normals(cloud(types, big, height)), NORMALS)


def test_order_of_the_fields_does_not_matter():
    message = cloud(("f4",) * 3)
    message.fields = message.fields[::-1]
    np.testing.assert_array_equal(read_normals(message), NORMALS)


def test_cloud_without_such_fields_has_none():
    assert read_normals(cloud((), names=())) is None


@pytest.mark.parametrize("names", [("normal_x",), ("normal_x", "normal_z"), ("normal_y", "normal_z")])
def test_some_of_the_fields_are_refused(names):
    got = "x y z " + " ".join(names)
    with pytest.raises(
        InvalidInputError, match=f"^cloud: expected fields normal_x normal_y normal_z, got {got}$"
    ):
        read_normals(cloud(("f4",) * len(names), names=names))


@pytest.mark.parametrize(
    ("kind", "name"), [("i1", "int8"), ("u1", "uint8"), ("i2", "int16"), ("i4", "int32"), ("u4", "uint32")]
)
def test_whole_numbers_are_refused(kind, name):
    with pytest.raises(
        InvalidInputError, match=f"^cloud: expected field normal_y to be float32 or float64, got {name}$"
    ):
        read_normals(cloud(("f4", kind, "f4")))


def test_field_of_several_numbers_is_refused():
    message = cloud(("f4",) * 3)
    message.fields[-1].count = 3
    with pytest.raises(InvalidInputError, match="one number in field normal_z, got 3"):
        read_normals(message)


def test_normals_are_turned_and_not_shifted():
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    motion[:3, 3] = [5.0, 6.0, 7.0]
    normals = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 1.0], [np.nan, 0.0, 0.0], [3e38, -3e38, np.inf]], "f4")
    turned = turn_normals(motion, normals)
    np.testing.assert_allclose(turned[:2], [[0.0, 1.0, 0.0], [-2.0, 0.0, 1.0]], atol=1e-12)
    assert not np.isfinite(turned[2:]).all(axis=1).any()
    assert turned.dtype == np.float64
