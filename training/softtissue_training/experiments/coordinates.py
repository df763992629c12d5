"""The two patient coordinate systems of medical images, LPS and RAS."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.organ import Organ

CoordinateSystem = Literal["LPS", "RAS"]
"""Where x, y and z point: Left, Posterior, Superior (DICOM, ITK, files of Slicer 4.11 and later) or Right, Anterior,
Superior (inside 3D Slicer, FreeSurfer, files of earlier Slicer)."""

COORDINATE_SYSTEMS: tuple[CoordinateSystem, ...] = get_args(CoordinateSystem)
_NAMED: dict[str, CoordinateSystem] = {"RAS": "RAS", "0": "RAS", "LPS": "LPS", "1": "LPS"}


def named_system(text: str) -> CoordinateSystem | None:
    """Return the system that a file of 3D Slicer means: by name, or 0 for RAS and 1 for LPS; None if neither.

    Examples
    --------
    >>> named_system("0"), named_system("lps"), named_system("IJK")
    ('RAS', 'LPS', None)
    """
    return _NAMED.get(text.strip().upper())


def check_system(where: str, stated: CoordinateSystem, organ: Organ) -> None:
    """Raise InvalidInputError if the organ's files state another coordinate system than what stands beside them.

    Parameters
    ----------
    where
        What states it, for the message.
    """
    if organ.system not in (None, stated):
        raise InvalidInputError(
            f"{where}, system: expected {organ.system}, as the file of the organ's surface states, got {stated}"
        )


def convert_coordinates(points: FloatArray, source: CoordinateSystem, target: CoordinateSystem) -> FloatArray:
    """Express points in the other system: x and y change their sign, z stays.

    Parameters
    ----------
    points : (n, 3) float64
        Any unit, in `source`.
    source, target
        'LPS' or 'RAS'.

    Returns
    -------
    (n, 3) float64
        In `target`, a copy.

    Raises
    ------
    InvalidInputError
        A system is neither.

    Examples
    --------
    >>> convert_coordinates(np.array([[1.0, 2.0, 3.0]]), "LPS", "RAS").tolist()
    [[-1.0, -2.0, 3.0]]
    """
    for system in (source, target):
        if system not in COORDINATE_SYSTEMS:
            raise InvalidInputError(f"coordinate system: expected LPS or RAS, got {system!r}")
    sign = 1.0 if source == target else -1.0
    # Adding zero turns -0.0 into 0.0, which would look odd in files.
    converted: FloatArray = np.asarray(points, dtype=np.float64) * np.array([sign, sign, 1.0]) + 0.0
    return converted
