"""A phantom case: an organ, what was observed of its deformed surface, and markers inside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces
from softtissue_estimator.organ.mesh_io import read_mesh
from softtissue_estimator.organ.organ import Organ, load_organ
from softtissue_estimator.organ.organ_file import read_organ_file
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_estimator.organ.surface_patch import patch
from softtissue_training.experiments.coherent_point_drift import spread_points
from softtissue_training.experiments.coordinates import check_system
from softtissue_training.experiments.paired_points import (
    PairedPoints,
    read_pair_of_lists,
    read_table_of_pairs,
)
from softtissue_training.experiments.phantom.case_file import CaseFile, Pairs, read_case_file
from softtissue_training.experiments.point_lists import read_points

FloatArray = NDArray[np.float64]

_MOST_OUTSIDE_M = 0.005  # a marker's own size and the surface's error
_SURFACE_SPACING_M, _SURFACE_POINTS = 0.004, 2000


@dataclass(frozen=True, eq=False)
class ObservedSurface:
    """Points of the organ's surface after the deformation.

    Attributes
    ----------
    points
        (n, 3) m, in the frame of the organ, whose attached part has not moved; in any where the pose is not known.
    normals
        (n, 3) outward; None where the source has no faces.
    """

    points: FloatArray
    normals: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Truth:
    """Where everything truly went, which only simulations know: (q, 3) m of `Organ.query_points`, after."""

    positions: FloatArray


@dataclass(frozen=True, eq=False)
class PhantomCase:
    """Everything about one case, in metres and the organ's frame.

    Attributes
    ----------
    name
        For the report.
    organ
        Before.
    markers
        Landmarks inside it.
    sigma_m
        Standard deviation of each component of what was observed, m.
    correspondences
        Surface points of which both positions are known; None if there are none.
    spread_share
        Share of the surface that few correspondences are spread over; None for the nearest to them.
    surface_after
        The surface after, or a visible part of it, without correspondences; None if there is none.
    sparse
        How many of the correspondences also to try alone; None to leave that out.
    tracking_noise_m
        Standard deviation of fresh noise on every coordinate in each frame of a bag of the case, m; 0 for none.
    truth
        None but for simulations.
    pose_known
        Whether `surface_after` is in the organ's frame, nearly at least.
    registration_sigma
        Standard deviations of each component of a known pose, m and rad; None where it is exact.
    """

    name: str
    organ: Organ
    markers: PairedPoints
    sigma_m: float
    correspondences: PairedPoints | None = None
    spread_share: float | None = None
    surface_after: ObservedSurface | None = None
    sparse: int | None = None
    tracking_noise_m: float = 0.0
    truth: Truth | None = None
    pose_known: bool = True
    registration_sigma: tuple[float, float] | None = None


def load_phantom_case(folder: Path) -> PhantomCase:
    """Read a case's folder; `docs/reference/case_folders.md` says what belongs into it.

    Raises
    ------
    SoftTissueError
        Something is missing, cannot be read or does not fit together, in one sentence.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InvalidInputError(f"case {folder}: expected a folder, found none")
    file = read_case_file(folder, read_organ_file(folder).unit)
    organ = load_organ(folder)
    check_system(f"case {folder}", file.system, organ)
    markers = _read_pairs(file.markers, file, "markers")
    _check_inside(markers, organ)
    correspondences = None
    if file.correspondences is not None:
        correspondences = _read_pairs(file.correspondences, file, "correspondences")
        _check_on_surface(correspondences, organ)
    return PhantomCase(
        name=file.name,
        organ=organ,
        markers=markers,
        sigma_m=file.sigma_m,
        correspondences=correspondences,
        spread_share=file.spread_share,
        surface_after=None if file.surface_after is None else _read_surface(file.surface_after, file),
        tracking_noise_m=file.tracking_noise_m,
        pose_known=file.pose_known,
        registration_sigma=file.registration_sigma,
    )


def points_of_surface(mesh: SurfaceMesh, faces: NDArray[np.bool_] | None = None) -> ObservedSurface:
    """Cover faces (m,) of a surface, or all of it, with at most 2000 points, about 4 mm apart, and their normals."""
    points, face, _ = sample_faces(mesh, faces, _SURFACE_SPACING_M)
    chosen = spread_points(points, _SURFACE_POINTS)
    corners = mesh.triangles[face[chosen]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return ObservedSurface(points[chosen], normals)


def _read_pairs(source: Pairs, file: CaseFile, what: str) -> PairedPoints:
    if isinstance(source, tuple):
        return read_pair_of_lists(*source, file.unit_m, file.system, what)
    return read_table_of_pairs(source, file.unit_m, file.system, what)


def _read_surface(path: Path, file: CaseFile) -> ObservedSurface:
    if path.suffix.lower() == ".csv":
        if file.visible is not None:
            raise InvalidInputError(
                f"visible: expected a mesh as surface_after, of which a part can be taken, got points {path}"
            )
        points = read_points(path, file.unit_m, file.system).points
        return ObservedSurface(points[spread_points(points, _SURFACE_POINTS)])
    mesh = read_mesh(path, file.unit_m, file.system).mesh
    if file.visible is None:
        return points_of_surface(mesh)
    centre, share = file.visible
    chosen = patch(mesh, np.array(centre), share)
    return points_of_surface(mesh, np.asarray(chosen[mesh.faces].all(axis=1)))


def _check_inside(markers: PairedPoints, organ: Organ) -> None:
    outside = signed_distance(organ.surface, markers.before)
    if outside.max() <= _MOST_OUTSIDE_M:
        return
    worst = int(outside.argmax())
    raise InvalidInputError(
        f"markers before: expected them inside the organ, got {markers.labels[worst]} {1e3 * outside[worst]:.0f} mm "
        f"outside{_mirror_hint(markers.before, organ, outside)}"
    )


def _check_on_surface(pairs: PairedPoints, organ: Organ) -> None:
    limit = EstimatorConfig().max_reference_distance_m
    away = np.abs(signed_distance(organ.surface, pairs.before))
    if away.max() <= limit:
        return
    worst = int(away.argmax())
    raise InvalidInputError(
        f"correspondences before: expected them within {1e3 * limit:.0f} mm of the organ's surface, got "
        f"{pairs.labels[worst]} {1e3 * away[worst]:.0f} mm away{_mirror_hint(pairs.before, organ, away)}"
    )


def _mirror_hint(points: FloatArray, organ: Organ, distance: FloatArray) -> str:
    mirrored = signed_distance(organ.surface, points * [-1.0, -1.0, 1.0])
    if mirrored.max() < 0.3 * distance.max():
        return "; with x and y reversed they fit, so the coordinate system (LPS, RAS) is probably wrong"
    return ""
