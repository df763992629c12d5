"""Where the numbers of a cloud lie in its bytes: views of the message's memory, in the layouts that drivers send."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField

from softtissue_estimator.errors import InvalidInputError

FLOATS = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
"""Types of numbers that positions may have."""
NUMBERS = FLOATS | {
    PointField.INT8: "i1",
    PointField.UINT8: "u1",
    PointField.INT16: "i2",
    PointField.UINT16: "u2",
    PointField.INT32: "i4",
    PointField.UINT32: "u4",
}
"""All types of numbers that a cloud can hold."""
_TYPE_NAME = {
    PointField.INT8: "int8",
    PointField.UINT8: "uint8",
    PointField.INT16: "int16",
    PointField.UINT16: "uint16",
    PointField.INT32: "int32",
    PointField.UINT32: "uint32",
    PointField.FLOAT32: "float32",
    PointField.FLOAT64: "float64",
}
_LARGEST_STEP = 65_536  # bytes of one point: far more than any camera's, and less than numpy's limit


def field_names(message: PointCloud2) -> list[str]:
    """Return the names of a cloud's fields, in order."""
    return [field.name for field in message.fields]


def columns(table: NDArray[Any], names: tuple[str, ...]) -> NDArray[np.floating]:
    """Return fields of (height, width) records as columns, (height width, k), read-only; a view if they lie evenly."""
    fields: Any = table.dtype.fields
    kinds = {fields[name][0] for name in names}
    gaps = set(np.diff([fields[name][1] for name in names]))
    if len(kinds) == len(gaps) == 1:
        first = table[names[0]]
        strides = (*first.strides, int(gaps.pop()))
        result = np.lib.stride_tricks.as_strided(first, (*first.shape, len(names)), strides)
    else:
        # What is no number is left out later.
        with np.errstate(invalid="ignore", over="ignore"):
            result = np.stack([table[name] for name in names], axis=-1)
    result = result.reshape(-1, len(names))  # copies where rows are padded
    result.flags.writeable = False
    return result


def records(message: PointCloud2, names: tuple[str, ...], types: Mapping[int, str] = FLOATS) -> NDArray[Any]:
    """View the bytes of a cloud as (height, width) records with the named fields.

    Parameters
    ----------
    message : PointCloud2
    names : tuple of str
    types : mapping
        Types that the fields may have: `FLOATS` or `NUMBERS`.

    Raises
    ------
    InvalidInputError
        If the cloud is empty, lacks a field or its sizes contradict each other.
    """
    width, height, step = _size(message)
    if width * height == 0:
        raise InvalidInputError(f"cloud: expected at least one point, got width {width} x height {height}")
    record = _record(message, names, types)
    row_step, size = int(message.row_step), len(message.data)
    # Drivers leave row_step unset or give it the size of the whole cloud. Where points fill the data, it says nothing.
    if size == width * step * height:
        row_step = width * step
    if height == 1 and row_step < width * step:
        row_step = width * step
    if row_step < width * step:
        raise InvalidInputError(
            f"cloud: expected row_step of at least width {width} x point_step {step} bytes, got {row_step}"
        )
    if size != row_step * height:
        raise InvalidInputError(
            f"cloud: expected {row_step * height} bytes of data (row_step {row_step} x height {height}), got {size}"
        )
    return np.ndarray((height, width), dtype=record, buffer=message.data, strides=(row_step, step))


def _size(message: PointCloud2) -> tuple[int, int, int]:
    """Return width, height and bytes of a point; one of the former that is 0 is 1 or what the others leave."""
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    points, rest = divmod(len(message.data), step) if step else (0, 1)
    if points > 0 and rest == 0:
        if height == 0 and width == points:
            height = 1
        elif width == 0 and height == 1:
            width = points
    return width, height, step


def _record(message: PointCloud2, names: tuple[str, ...], types: Mapping[int, str]) -> np.dtype[Any]:
    """Describe the named fields of one point."""
    fields = {field.name: field for field in message.fields}
    missing = [name for name in names if name not in fields]
    if missing:
        present = " ".join(field_names(message)) or "none"
        raise InvalidInputError(f"cloud: expected fields {' '.join(names)}, got {present}")
    if message.point_step > _LARGEST_STEP:
        raise InvalidInputError(
            f"cloud: expected point_step of at most {_LARGEST_STEP} bytes, got {message.point_step}"
        )
    order = ">" if message.is_bigendian else "<"
    formats, offsets = [], []
    for name in names:
        field = fields[name]
        if field.datatype not in types:
            got = _TYPE_NAME.get(field.datatype, f"type {field.datatype}")
            wanted = "float32 or float64" if types is FLOATS else "a number"
            raise InvalidInputError(f"cloud: expected field {name} to be {wanted}, got {got}")
        if field.count > 1:  # 0 is what some drivers leave there
            raise InvalidInputError(f"cloud: expected one number in field {name}, got {field.count}")
        formats.append(order + types[field.datatype])
        offsets.append(int(field.offset))
        size = np.dtype(formats[-1]).itemsize
        if field.offset + size > message.point_step:
            raise InvalidInputError(
                f"cloud: expected field {name} to end within point_step {message.point_step} bytes,"
                f" got offset {field.offset} + {size}"
            )
    return np.dtype(
        {"names": list(names), "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    )
