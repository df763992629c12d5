"""Random organ-like closed surfaces (paper, section "Training data": a primitive, extruded and deformed).

A sphere is turned into a random rounded box, grows lobes and dents, and is then tapered, bent, twisted and pushed about
by a smooth random field. Every step is a smooth map, so that the surface stays closed and of genus 0; what folds over
itself is found when it is filled with tetrahedra.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import MeshError
from softtissue_estimator.mesh import SurfaceMesh

FloatArray = NDArray[np.float64]

CUBE_SIDE_M = 0.30
"""Side of the cube that a training organ must lie in (paper, section "Grid")."""
VOLUME_RANGE_M3 = (0.2e-3, 3.0e-3)
"""Organs from a kidney to a large liver; 0.2 to 3 litres."""
_SPHERE_SUBDIVISIONS = 5


@dataclass(frozen=True)
class ShapeFamily:
    """Ranges that a random organ is drawn from; lengths in metres, angles in radians.

    Attributes
    ----------
    half_axes
        Lowest and highest half-axis along x, y and z.
    roundness
        Exponent q of the rounded box |x|^q + |y|^q + |z|^q = 1; 2 is an ellipsoid.
    lobes
        Lowest and highest number of lobes and dents.
    lobe_height
        Lowest and highest relative height; negative heights are dents.
    taper
        Relative loss of cross-section from the middle to the thin end.
    bend
        Angle between the two ends.
    """

    half_axes: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    roundness: tuple[float, float]
    lobes: tuple[int, int]
    lobe_height: tuple[float, float]
    taper: tuple[float, float]
    bend: tuple[float, float]


FAMILIES = (
    ShapeFamily(((0.030, 0.090),) * 3, (2.0, 3.0), (2, 7), (-0.25, 0.45), (0.0, 0.35), (0.0, 0.7)),
    # Liver-like: wide, flattened, thick on one side and thin on the other, hollow below.
    ShapeFamily(
        ((0.070, 0.100), (0.050, 0.080), (0.028, 0.048)),
        (2.0, 3.0),
        (1, 4),
        (-0.2, 0.35),
        (0.25, 0.65),
        (0.3, 1.2),
    ),
    # Few strong lobes: the paper's repeated extrusion.
    ShapeFamily(((0.030, 0.065),) * 3, (2.0, 2.5), (2, 4), (0.3, 0.9), (0.0, 0.3), (0.0, 0.6)),
)
_FAMILY_SHARES = (0.5, 0.3, 0.2)


def random_organ_surface(rng: np.random.Generator, edge_length_m: float = 0.010) -> SurfaceMesh:
    """Draw an organ-like closed surface, its bounding box centred on the origin.

    Parameters
    ----------
    rng
        Source of all randomness.
    edge_length_m
        Mean edge length of the triangles, metres.

    Returns
    -------
    SurfaceMesh
        Closed, outward winding, metres.

    Raises
    ------
    MeshError
        The shape drawn does not fit the cube or the range of volumes.
    """
    family = FAMILIES[rng.choice(len(FAMILIES), p=_FAMILY_SHARES)]
    sphere = trimesh.creation.icosphere(subdivisions=_SPHERE_SUBDIVISIONS, radius=1.0)
    directions = np.asarray(sphere.vertices, dtype=np.float64)
    half_axes = np.array([rng.uniform(*limits) for limits in family.half_axes])

    points = directions * _radius(directions, family, rng)[:, None] * half_axes
    points = _taper(points, half_axes[0], rng.uniform(*family.taper))
    points = _bend(points, half_axes[0], rng.uniform(*family.bend))
    points = _twist(points, half_axes[0], rng.uniform(-0.6, 0.6))
    points = points + _smooth_field(points, rng)
    points = Rotation.random(rng=rng).apply(points)
    points = points - 0.5 * (points.min(axis=0) + points.max(axis=0))

    fine = SurfaceMesh(points, np.asarray(sphere.faces, dtype=np.int64))
    _check_size(fine)
    return resample(fine, edge_length_m)


def resample(mesh: SurfaceMesh, edge_length_m: float) -> SurfaceMesh:
    """Return the surface with triangles of about one size, by collapsing the shortest edges and relaxing.

    Parameters
    ----------
    mesh
        Closed surface with triangles much smaller than `edge_length_m`.

    Raises
    ------
    MeshError
        The edges could not be collapsed that far.
    """
    area = float(igl.doublearea(mesh.vertices, mesh.faces).sum()) / 2.0
    wanted_faces = int(area / (np.sqrt(3.0) / 4.0 * edge_length_m**2))
    if wanted_faces >= len(mesh.faces):
        raise MeshError(
            f"resampling needs a finer surface: {wanted_faces} faces wanted, got {len(mesh.faces)}"
        )
    vertices, faces = igl.decimate(mesh.vertices, mesh.faces, wanted_faces)[:2]
    coarse = trimesh.Trimesh(vertices, faces, process=False)
    if not coarse.is_watertight or coarse.euler_number != 2:
        raise MeshError(
            f"resampled surface must be closed and of genus 0, got Euler number {coarse.euler_number}"
        )
    return SurfaceMesh(_relaxed(coarse, mesh), np.asarray(coarse.faces, dtype=np.int64))


def _relaxed(coarse: trimesh.Trimesh, fine: SurfaceMesh, rounds: int = 4) -> FloatArray:
    """Move vertices towards the mean of their neighbours and back onto the fine surface, (n, 3)."""
    averaging = trimesh.smoothing.laplacian_calculation(coarse, equal_weight=True)
    points = np.asarray(coarse.vertices, dtype=np.float64)
    for _ in range(rounds):
        moved = 0.5 * points + 0.5 * (averaging @ points)
        points = np.asarray(
            igl.point_mesh_squared_distance(moved, fine.vertices, fine.faces)[2], dtype=np.float64
        )
    return points


def _radius(directions: FloatArray, family: ShapeFamily, rng: np.random.Generator) -> FloatArray:
    """Radius of a rounded box with lobes and dents in each direction, (n,), relative to the half-axes."""
    q = rng.uniform(*family.roundness)
    radius: FloatArray = np.sum(np.abs(directions) ** q, axis=1) ** (-1.0 / q)
    for _ in range(rng.integers(family.lobes[0], family.lobes[1] + 1)):
        towards = rng.normal(size=3)
        towards /= np.linalg.norm(towards)
        width = rng.uniform(0.25, 0.7)
        height = rng.uniform(*family.lobe_height)
        radius = radius * (1.0 + height * np.exp(-(1.0 - directions @ towards) / width**2))
    return radius


def _taper(points: FloatArray, half_length: float, loss: float) -> FloatArray:
    """Shrink the cross-section smoothly along x, down to `1 - loss` at the thin end."""
    scale = 1.0 - loss * 0.5 * (1.0 + np.tanh(points[:, 0] / half_length))
    return points * np.stack([np.ones_like(scale), 0.5 * (1.0 + scale), scale], axis=1)


def _bend(points: FloatArray, half_length: float, angle: float) -> FloatArray:
    """Bend the x axis into an arc in the x-z plane with `angle` between its ends."""
    if angle < 1e-3:
        return points
    radius = 2.0 * half_length / angle
    # Beyond the half-length (lobes) the arc goes on straight, so that thick organs do not fold.
    phi = np.clip(points[:, 0] / radius, -0.6 * angle, 0.6 * angle)
    rest = points[:, 0] - phi * radius
    arm = radius - points[:, 2]
    return np.stack(
        [
            arm * np.sin(phi) + rest * np.cos(phi),
            points[:, 1],
            radius - arm * np.cos(phi) + rest * np.sin(phi),
        ],
        axis=1,
    )


def _twist(points: FloatArray, half_length: float, angle: float) -> FloatArray:
    """Turn each cross-section about x, by `angle` in all from the middle to an end."""
    phi = angle * np.tanh(points[:, 0] / half_length)
    cos, sin = np.cos(phi), np.sin(phi)
    return np.stack(
        [points[:, 0], cos * points[:, 1] - sin * points[:, 2], sin * points[:, 1] + cos * points[:, 2]],
        axis=1,
    )


def _smooth_field(points: FloatArray, rng: np.random.Generator, centres: int = 6) -> FloatArray:
    """Return a sum of Gaussian pushes at random surface points, (n, 3) metres."""
    field = np.zeros_like(points)
    for centre in points[rng.integers(len(points), size=centres)]:
        width = rng.uniform(0.025, 0.060)
        push = rng.normal(scale=0.006, size=3)
        field += push * np.exp(-np.sum((points - centre) ** 2, axis=1) / (2.0 * width**2))[:, None]
    return field


def _check_size(mesh: SurfaceMesh) -> None:
    reach = float(np.abs(mesh.vertices).max())
    if reach > CUBE_SIDE_M / 2.0:
        raise MeshError(
            f"organ must lie within {CUBE_SIDE_M / 2.0:.3f} m of the cube's centre, got {reach:.3f} m"
        )
    volume = float(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume)
    low, high = VOLUME_RANGE_M3
    if not low <= volume <= high:
        raise MeshError(
            f"organ volume must be {low * 1e3:.1f} to {high * 1e3:.1f} litres, got {volume * 1e3:.2f}"
        )
