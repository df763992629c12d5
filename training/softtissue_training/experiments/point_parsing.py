"""What the readers of point lists share."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_training.experiments.coordinates import CoordinateSystem, convert_coordinates
from softtissue_training.experiments.labelled_points import LabelledPoints

MM = 1e-3  # m

_NUMBER = re.compile(r"\s*[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:e[-+]?\d+)?\s*$", re.IGNORECASE | re.ASCII)

_log = logging.getLogger(__name__)


def is_number(field: str) -> bool:
    """Tell whether a text is a number, with a decimal point or comma.

    Examples
    --------
    >>> is_number("-1,5"), is_number("2e3"), is_number("1_000"), is_number("x")
    (True, True, False, False)
    """
    return bool(_NUMBER.match(field))


def finite_coordinates(
    path: Path, line: int, fields: Sequence[str], decimal_comma: bool = False
) -> list[float]:
    """Turn three texts into finite numbers, or say in which line they are none."""
    try:
        plain = [field.replace(",", ".") if decimal_comma else field for field in fields]
        # Python takes 1_000 for a number.
        values = [float(field) for field in plain if is_number(field)]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise InvalidInputError(
            f"points {path}, line {line}: expected three finite coordinates, got {', '.join(fields)!r}"
        )
    return values


def points_read(
    path: Path,
    labels: Sequence[str],
    points_m: FloatArray,
    source: CoordinateSystem,
    system: CoordinateSystem,
    undefined: int,
) -> LabelledPoints:
    """Convert (n, 3) points (m) from the file's coordinate system; tell of those that were left out as undefined.

    Raises
    ------
    InvalidInputError
        None is left.
    """
    if undefined:
        _log.info("points %s: %d without a defined position are left out", path, undefined)
    if not labels:
        raise InvalidInputError(
            f"points {path}: expected at least one point, got none ({undefined} without a defined position)"
        )
    return LabelledPoints(tuple(labels), convert_coordinates(points_m, source, system))
