"""Read and check `case.yaml` of a phantom case; every mistake is one sentence that names the key.

Everything may be left out where the files have the usual names: `correspondences.csv`, `markers_before.mrk.json`,
`surface_after.stl` and so on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.organ_file import UNITS_M
from softtissue_training.experiments.coordinates import COORDINATE_SYSTEMS, CoordinateSystem
from softtissue_training.experiments.point_lists import POINT_FORMATS
from softtissue_training.experiments.yaml_entries import Entries, read_entries

FILE_NAME = "case.yaml"
_KEYS = (
    "name",
    "unit",
    "system",
    "sigma",
    "markers",
    "correspondences",
    "spread",
    "surface_after",
    "visible",
    "pose",
    "registration_sigma",
    "tracking_noise",
)
_MESH_FORMATS = (".ply", ".stl", ".obj", ".vtk", ".vtp", ".vtu", ".msh")
_DEFAULT_SIGMA_M = 0.001

Pairs = Path | tuple[Path, Path]


@dataclass(frozen=True)
class CaseFile:
    """Content of `case.yaml`; paths are complete, lengths in metres.

    Attributes
    ----------
    name
        Of the case.
    unit_m
        Length of the unit of CSV files and of `surface_after`, m.
    system
        Coordinate system of the organ's meshes, of CSV files and of `surface_after`.
    sigma_m
        Standard deviation of each component of a correspondence or of a point of the surface after, m.
    markers
        Two lists of points, or one table.
    correspondences
        The same; None if there are none.
    spread_share
        Share of the surface that few correspondences are spread over; None for the nearest to them.
    surface_after
        Mesh or list of points; None if there is none.
    visible
        A point (m) and the share of the surface after around it that was visible; None for all of it.
    tracking_noise_m
        Standard deviation of fresh noise on every coordinate in each frame of a bag of the case, m; 0 for none.
    pose_known
        Whether the surface after is in the organ's frame, nearly at least.
    registration_sigma
        Standard deviations of each component of a known pose, m and rad; None where it is exact.
    """

    name: str
    unit_m: float
    system: CoordinateSystem
    sigma_m: float
    markers: Pairs
    correspondences: Pairs | None
    spread_share: float | None
    surface_after: Path | None
    visible: tuple[tuple[float, float, float], float] | None
    tracking_noise_m: float
    pose_known: bool
    registration_sigma: tuple[float, float] | None


def read_case_file(folder: Path, organ_unit: str) -> CaseFile:
    """Read `case.yaml` in a folder, if there is one, and find the files of the usual names.

    Parameters
    ----------
    organ_unit
        'mm' or 'm': the unit unless `case.yaml` says another.

    Raises
    ------
    InvalidInputError
        The file says something that cannot be meant, or a file that must be there is not.
    """
    path = folder / FILE_NAME
    entries = read_entries(path, _KEYS, required=False)
    unit = entries.choice("unit", tuple(UNITS_M), organ_unit)
    unit_m = UNITS_M[unit]
    system = cast(CoordinateSystem, entries.choice("system", COORDINATE_SYSTEMS, "LPS"))
    sigma = entries.number("sigma", 1e-5 / unit_m, 0.05 / unit_m)
    correspondences = _pairs(entries, "correspondences")
    surface_after = entries.file("surface_after") or _usual(folder, "surface_after")
    markers = _pairs(entries, "markers")
    if markers is None:
        raise InvalidInputError(
            f"case {folder}, markers: expected markers_before and markers_after (Slicer's point lists or CSV), a table "
            f"markers.csv, or others named in {FILE_NAME}, found none"
        )
    if correspondences is None and surface_after is None:
        raise InvalidInputError(
            f"case {folder}: expected correspondences, or the organ's surface after as surface_after, found neither"
        )
    pose_known = entries.choice("pose", ("known", "unknown"), "known") == "known"
    registration_sigma = _registration_sigma(entries, unit_m)
    if registration_sigma is not None and not pose_known:
        raise InvalidInputError(
            f"{entries.where('registration_sigma')}: expected a known pose beside it, got pose: unknown"
        )
    return CaseFile(
        name=entries.text("name") or folder.resolve().name,
        unit_m=unit_m,
        system=system,
        sigma_m=_DEFAULT_SIGMA_M if sigma is None else sigma * unit_m,
        markers=markers,
        correspondences=correspondences,
        spread_share=_spread_share(entries),
        surface_after=surface_after,
        visible=_visible(entries, unit_m),
        tracking_noise_m=unit_m * (entries.number("tracking_noise", 0.0, 0.05 / unit_m) or 0.0),
        pose_known=pose_known,
        registration_sigma=registration_sigma,
    )


def _pairs(entries: Entries, key: str) -> Pairs | None:
    given, folder = entries.value(key), entries.path.parent
    if isinstance(given, Mapping):
        inner = Entries(entries.path, given, key, ("before", "after"))
        before, after = inner.file("before"), inner.file("after")
        if before is None or after is None:
            raise InvalidInputError(f"{entries.where(key)}: expected before and after, got {dict(given)!r}")
        return before, after
    if given is not None:
        return entries.file(key)
    table = folder / f"{key}.csv"
    if table.is_file():
        return table
    first, second = (_usual(folder, f"{key}_{time}", POINT_FORMATS) for time in ("before", "after"))
    if (first is None) != (second is None):
        raise InvalidInputError(
            f"case {folder}, {key}: expected {key}_before and {key}_after, found only {first or second}"
        )
    return None if first is None or second is None else (first, second)


def _usual(folder: Path, stem: str, endings: tuple[str, ...] = (*_MESH_FORMATS, ".csv")) -> Path | None:
    found = [folder / f"{stem}{ending}" for ending in endings if (folder / f"{stem}{ending}").is_file()]
    if len(found) > 1:
        raise InvalidInputError(
            f"case {folder}: expected one file {stem}, found {', '.join(path.name for path in found)}; name the right "
            f"one in {FILE_NAME}"
        )
    return found[0] if found else None


def _spread_share(entries: Entries) -> float | None:
    given = entries.value("spread")
    if given is None:
        return None
    if not isinstance(given, Mapping):
        raise InvalidInputError(f"{entries.where('spread')}: expected a mapping with share, got {given!r}")
    return Entries(entries.path, given, "spread", ("share",)).number("share", 0.001, 1.0)


def _visible(entries: Entries, unit_m: float) -> tuple[tuple[float, float, float], float] | None:
    given = entries.value("visible")
    if given is None:
        return None
    if not isinstance(given, Mapping):
        raise InvalidInputError(
            f"{entries.where('visible')}: expected a mapping with centre and share, got {given!r}"
        )
    inner = Entries(entries.path, given, "visible", ("centre", "share"))
    centre, share = inner.vector("centre"), inner.number("share", 0.001, 1.0)
    if centre is None:
        raise InvalidInputError(f"{inner.where('centre')}: expected 3 numbers, got nothing")
    if share is None:
        raise InvalidInputError(f"{inner.where('share')}: expected a number from 0.001 to 1, got nothing")
    x, y, z = centre
    return (x * unit_m, y * unit_m, z * unit_m), share


def _registration_sigma(entries: Entries, unit_m: float) -> tuple[float, float] | None:
    given = entries.value("registration_sigma")
    if given is None:
        return None
    keys = ("translation", "rotation")
    if not isinstance(given, Mapping):
        raise InvalidInputError(
            f"{entries.where('registration_sigma')}: expected a mapping with translation and rotation, got {given!r}"
        )
    inner = Entries(entries.path, given, "registration_sigma", keys)
    translation, degrees = inner.number("translation", 0.0, 0.1 / unit_m), inner.number("rotation", 0.0, 45.0)
    if translation is None or degrees is None:
        raise InvalidInputError(
            f"{entries.where('registration_sigma')}: expected translation and rotation, got {dict(given)!r}"
        )
    return translation * unit_m, math.radians(degrees)
