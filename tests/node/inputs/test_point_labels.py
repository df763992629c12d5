"""Which points of a cloud are of the organ, and which track each belongs to, as its fields say."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from sensor_msgs.msg import PointCloud2, PointField

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.point_labels import NO_LABEL, read_labels

TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud(big=False, **columns):
    """A cloud of points at the origin with more fields, each a type and its numbers."""
    order = ">" if big else "<"
    kinds = [(name, order + "f4") for name in "xyz"]
    kinds += [(name, order + kind) for name, (kind, _) in columns.items()]
    rows = np.zeros(len(next(iter(columns.values()))[1]), dtype=kinds)
    for name, (_, numbers) in columns.items():
        rows[name] = numbers
    fields = [
        PointField(name=name, offset=offset, datatype=TYPES[kind.str[1:]], count=1)
        for name, (kind, offset) in rows.dtype.fields.items()
    ]
    return PointCloud2(
        height=1, width=len(rows), fields=fields, is_bigendian=big, point_step=rows.itemsize,
        row_step=rows.nbytes, data=rows.tobytes(),
    )  # fmt: skip


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("big", [False, True])
def test_every_type_of_number_masks_and_labels_and_counts(kind, big):
    message = cloud(
        big, organ_mask=(kind, [0, 1, 100, 1]), label=(kind, [3, 3, 3, 4]), id=(kind, [7, 0, 100, 5])
    )
    labels = read_labels(message, 3)
    assert labels.organ.tolist() == [False, True, True, False]
    assert labels.track.tolist() == [7, 0, 100, 5] and labels.track.dtype == np.int64
    assert read_labels(message, NO_LABEL).organ.tolist() == [False, True, True, True]


def test_what_is_not_finite_is_neither_of_the_organ_nor_a_track():
    nan = float("nan")
    message = cloud(
        organ_mask=("f4", [nan, 1.0, 1.0]), label=("f4", [0.0, nan, 0.0]), id=("f4", [nan, np.inf, 2.0])
    )
    labels = read_labels(message, 0)
    assert labels.organ.tolist() == [False, False, True]
    assert labels.track.tolist() == [-1, -1, 2]


def test_numbers_of_tracks_keep_all_their_bits():
    assert read_labels(cloud(id=("u4", [2**32 - 1, 2**31])), NO_LABEL).track.tolist() == [2**32 - 1, 2**31]


def test_cloud_without_such_fields_says_nothing():
    labels = read_labels(cloud(intensity=("f4", [1.0, 2.0])), 0)
    assert labels.organ is None and labels.track is None


@pytest.mark.parametrize(
    ("fields", "organ_label", "words"),
    [
        ({"organ_mask": ("u1", [0, 0])}, NO_LABEL, "some points that organ_mask says .* none of 2"),
        ({"label": ("u1", [1, 2])}, 5, "some points that label 5 says"),
        ({"label": ("u1", [5, 2]), "organ_mask": ("u1", [0, 1])}, 5, "organ_mask and label 5"),
    ],
)
def test_cloud_without_a_point_of_the_organ_is_refused(fields, organ_label, words):
    with pytest.raises(InvalidInputError, match=words):
        read_labels(cloud(**fields), organ_label)


def test_field_that_is_no_number_is_refused():
    message = cloud(id=("u4", [1, 2]))
    message.fields[-1].count = 2
    with pytest.raises(InvalidInputError, match="one number in field id, got 2"):
        read_labels(message, NO_LABEL)
