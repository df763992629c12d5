"""The case folder of a breathing experiment: `organ.yaml` as for the node, `case.yaml` for the other breath."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

import softtissue_training
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.organ.mesh_io import read_mesh
from softtissue_estimator.organ.organ import Organ, Structure, load_organ
from softtissue_estimator.organ.organ_file import UNITS_M
from softtissue_estimator.organ.surface_repair import check_closed, clean_organ_surface
from softtissue_training.experiments.coordinates import (
    COORDINATE_SYSTEMS,
    CoordinateSystem,
    check_system,
    convert_coordinates,
)
from softtissue_training.experiments.yaml_entries import Entries, read_entries

FloatArray = NDArray[np.float64]

FILE_NAME = "case.yaml"
ALIGNMENTS = ("icp", "none")
INSIDE, SURFACE = "inside", "surface"
"""Names of the parts of a truth that are not structures."""
_KEYS = ("name", "unit", "system", "anterior", "surface_after", "structures_after", "alignment", "truth")
_LARGEST_VOLUME_RATIO = 2.0  # of the volume, by breathing and by segmenting differently
_FRONT_LPS = np.array([[0.0, -1.0, 0.0]])


def bundled_case() -> Path:
    """Folder of the case that comes with the package, a simulated breathing liver."""
    return Path(softtissue_training.__file__).parent / "cases" / "breathing_liver"


@dataclass(frozen=True, eq=False)
class Truth:
    """Where points of a simulated organ really went.

    Attributes
    ----------
    before
        (n, 3) m, in the preoperative frame.
    after
        (n, 3) m, in the frame of the deformed surface.
    part
        (n,) name of the structure, or `INSIDE` or `SURFACE` of the organ.
    """

    before: FloatArray
    after: FloatArray
    part: NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class BreathingCase:
    """An organ in two states of breath. Lengths in metres.

    Attributes
    ----------
    name
        The organ's, unless `case.yaml` says another.
    organ
        Preoperative state, with its structures and attached region.
    surface
        Deformed surface, in a frame of its own unless `alignment` is 'none'.
    structures
        Deformed structures by name, in that frame; each is one of the organ's.
    anterior
        (3,) direction from the back to the front in the organ's frame.
    alignment
        'icp' if the deformed frame has to be found by registration, 'none' if it is the organ's.
    truth
        Of simulated organs alone.
    """

    name: str
    organ: Organ
    surface: SurfaceMesh
    structures: dict[str, SurfaceMesh]
    anterior: FloatArray
    alignment: str
    truth: Truth | None

    @property
    def compared(self) -> tuple[Structure, ...]:
        """Structures of the organ that have a deformed counterpart, in the organ's order."""
        return tuple(structure for structure in self.organ.structures if structure.name in self.structures)


def load_case(folder: Path) -> BreathingCase:
    """Read a case folder.

    Raises
    ------
    OrganError, MeshError
        If the preoperative organ or a mesh cannot be used.
    InvalidInputError
        If `case.yaml` is missing or says something that cannot be meant.
    """
    folder = Path(folder)
    entries = read_entries(folder / FILE_NAME, _KEYS)
    unit = entries.choice("unit", tuple(UNITS_M))
    unit_m = UNITS_M[unit]
    anterior, alignment = _anterior(entries), entries.choice("alignment", ALIGNMENTS, ALIGNMENTS[0])
    surface_file, truth_file = entries.required_file("surface_after"), entries.file("truth")
    organ = load_organ(folder)
    if entries.value("system") is not None:
        check_system(
            str(entries.path), cast(CoordinateSystem, entries.choice("system", COORDINATE_SYSTEMS)), organ
        )
    surface = clean_organ_surface(read_mesh(surface_file, unit_m, organ.system), str(surface_file)).mesh
    check_closed(surface, str(surface_file))
    _check_volume(entries, surface, organ, unit)
    structures = _structures(entries, organ, unit_m)
    truth = None if truth_file is None else _read_truth(truth_file, unit_m)
    if not structures and truth is None:
        raise InvalidInputError(
            f"{entries.where('structures_after')}: expected at least one structure of organ.yaml in the other state, "
            "got none"
        )
    name = entries.text("name") or organ.name
    return BreathingCase(name, organ, surface, structures, anterior, alignment, truth)


def _structures(entries: Entries, organ: Organ, unit_m: float) -> dict[str, SurfaceMesh]:
    known = [structure.name for structure in organ.structures]
    found: dict[str, SurfaceMesh] = {}
    for entry in entries.mappings("structures_after", ("name", "mesh")):
        name = entry.required_text("name")
        if name not in known:
            raise InvalidInputError(
                f"{entry.where('name')}: expected a structure of organ.yaml ({', '.join(known) or 'it has none'}), "
                f"got {name!r}"
            )
        if name in found:
            raise InvalidInputError(
                f"{entry.where('name')}: expected each structure once, got {name!r} again"
            )
        found[name] = read_mesh(entry.required_file("mesh"), unit_m, organ.system).mesh
    return found


def _check_volume(entries: Entries, surface: SurfaceMesh, organ: Organ, unit: str) -> None:
    before, after = enclosed_volume(organ.surface), enclosed_volume(surface)
    if not 1.0 / _LARGEST_VOLUME_RATIO <= after / before <= _LARGEST_VOLUME_RATIO:
        raise InvalidInputError(
            f"{entries.where('surface_after')}: expected about the {1e6 * before:.0f} ml of the preoperative organ, "
            f"got {1e6 * after:.3g} ml with unit {unit}; another unit or another organ?"
        )


def _anterior(entries: Entries) -> FloatArray:
    system, given = entries.value("system"), entries.vector("anterior")
    if (system is None) == (given is None):
        raise InvalidInputError(
            f"{entries.path}: expected either system (LPS or RAS) or anterior (the direction to the front as three "
            f"numbers), got {'neither' if system is None else 'both'}"
        )
    if given is None:
        known = cast(CoordinateSystem, entries.choice("system", COORDINATE_SYSTEMS))
        return np.array(convert_coordinates(_FRONT_LPS, "LPS", known)[0])
    length = float(np.linalg.norm(given))
    if not length > 0.0:
        raise InvalidInputError(f"{entries.where('anterior')}: expected a direction, got {list(given)}")
    return np.array(given) / length


def _read_truth(path: Path, unit_m: float) -> Truth:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = [file[name] for name in ("before", "after", "part")]
            before, after = (np.asarray(array, dtype=np.float64) * unit_m for array in arrays[:2])
            part = arrays[2].astype(np.str_)
    # A damaged archive raises whatever the reader stumbles over.
    except Exception as error:
        raise InvalidInputError(
            f"{path}: expected an NPZ file with before (n, 3), after (n, 3) and part (n,), got one that cannot be read "
            f"({type(error).__name__}: {error})"
        ) from error
    if (
        before.ndim != 2
        or before.shape[1:] != (3,)
        or after.shape != before.shape
        or part.shape != before.shape[:1]
    ):
        raise InvalidInputError(
            f"{path}: expected before (n, 3), after (n, 3) and part (n,), got {before.shape}, {after.shape} and "
            f"{part.shape}"
        )
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        raise InvalidInputError(f"{path}: expected finite positions, got others")
    return Truth(before, after, part)
