"""Random organ-like closed surfaces (paper, section "Training data": a primitive, extruded and deformed several times).

A sphere becomes a random rounded box, which is extruded, tapered, bent, twisted and pushed by a smooth random field.
Every step moves the vertices of one sphere, so that the surface stays closed and of genus 0; that it does not cut
itself is checked at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import igl.predicates
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_training.organs.deformations import bend, extrude, push, superellipsoid, taper, twist
from softtissue_training.organs.resampling import resample

FloatArray = NDArray[np.float64]
Shapes = Literal["random", "liver", "mixed"]
SHAPES: tuple[Shapes, ...] = ("random", "liver", "mixed")

CUBE_SIDE_M = 0.30
"""Side of the cube that a training organ must lie in (paper, section "Grid")."""
VOLUME_RANGE_M3 = (0.2e-3, 3.0e-3)
"""Organs from a kidney to a large liver; 0.2 to 3 litres."""
_SPHERE_SUBDIVISIONS = 5
_PUSHES = 6


@dataclass(frozen=True)
class ShapeFamily:
    """Ranges that a random organ is drawn from; lengths in metres, angles in radians.

    Attributes
    ----------
    half_axes
        Lowest and highest half-axis along x, y and z.
    roundness
        Exponent of the rounded box (`superellipsoid`).
    extrusions
        Lowest and highest number of extrusions and dents.
    extrusion_height
        Lowest and highest height relative to the half-axis in that direction; negative heights are dents.
    extrusion_width
        Lowest and highest width relative to the mean half-axis.
    taper
        Relative loss of cross-section from the middle to the thin end.
    bend
        Angle between the two ends.
    """

    half_axes: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    roundness: tuple[float, float]
    extrusions: tuple[int, int]
    extrusion_height: tuple[float, float]
    extrusion_width: tuple[float, float]
    taper: tuple[float, float]
    bend: tuple[float, float]


RANDOM_FAMILIES = (
    # Blobs with lobes and dents.
    ShapeFamily(
        ((0.022, 0.095),) * 3, (2.0, 3.0), (2, 6), (-0.30, 0.50), (0.25, 0.60), (0.0, 0.35), (0.0, 0.7)
    ),
    # Small bodies with few long extrusions.
    ShapeFamily(
        ((0.030, 0.065),) * 3, (2.0, 2.5), (2, 4), (0.35, 1.10), (0.30, 0.60), (0.0, 0.30), (0.0, 0.6)
    ),
)
LIVER_FAMILY = ShapeFamily(
    # Wide and flat, thick on the right and thin on the left, hollow below.
    ((0.080, 0.115), (0.060, 0.090), (0.035, 0.055)),
    (2.0, 3.0),
    (2, 5),
    (-0.30, 0.35),
    (0.25, 0.60),
    (0.30, 0.65),
    (0.3, 1.2),
)
_FIRST_RANDOM_SHARE = 0.7
_LIVER_SHARE = 0.3
"""Share of livers where `shapes` is mixed."""


def random_organ_surface(
    rng: np.random.Generator, edge_length_m: float = 0.010, shapes: Shapes = "random"
) -> SurfaceMesh:
    """Draw an organ-like closed surface, its bounding box centred on the origin.

    Parameters
    ----------
    rng
        Source of all randomness.
    edge_length_m
        Mean edge length of the triangles, metres.
    shapes
        Any organ, livers, or three in ten livers.

    Returns
    -------
    SurfaceMesh
        Closed, of genus 0, free of self-intersections, outward winding, metres.

    Raises
    ------
    MeshError
        The shape drawn does not fit the cube or the range of volumes, or it cuts itself.
    """
    family = _draw_family(rng, shapes)
    sphere = trimesh.creation.icosphere(subdivisions=_SPHERE_SUBDIVISIONS, radius=1.0)
    faces = np.asarray(sphere.faces, dtype=np.int64)
    half_axes = np.array([rng.uniform(*limits) for limits in family.half_axes])

    directions = np.asarray(sphere.vertices, dtype=np.float64)
    points = superellipsoid(directions, half_axes, rng.uniform(*family.roundness))
    for _ in range(rng.integers(family.extrusions[0], family.extrusions[1], endpoint=True)):
        centre = int(np.argmax(directions @ rng.normal(size=3)))
        # Relative to the organ's reach in that direction, so that flat organs stay flat.
        height = rng.uniform(*family.extrusion_height) * float(np.abs(directions[centre]) @ half_axes)
        width = rng.uniform(*family.extrusion_width) * half_axes.mean()
        points = extrude(points, faces, centre, height, width)
    points = taper(points, half_axes[0], rng.uniform(*family.taper))
    points = bend(points, half_axes[0], rng.uniform(*family.bend))
    points = twist(points, half_axes[0], rng.uniform(-0.6, 0.6))
    points = push(
        points,
        points[rng.integers(len(points), size=_PUSHES)],
        rng.uniform(0.025, 0.060, size=_PUSHES),
        rng.normal(scale=0.006, size=(_PUSHES, 3)),
    )
    points = Rotation.random(random_state=rng).apply(points)

    fine = _centred(SurfaceMesh(points, faces))
    _check_size(fine)
    # Once more: triangles cut corners.
    surface = _centred(resample(fine, edge_length_m))
    _check_size(surface)
    check_self_intersection(surface)
    return surface


def check_self_intersection(surface: SurfaceMesh) -> None:
    """Raise MeshError where triangles that share no vertex, or more than they should, cut each other."""
    found, pairs, _ = igl.predicates.find_self_intersections(surface.vertices, surface.faces)
    if found:
        raise MeshError(f"organ surface must not cut itself, got {len(pairs)} pairs of triangles that do")


def _draw_family(rng: np.random.Generator, shapes: Shapes) -> ShapeFamily:
    # Two numbers are drawn whatever the choice, so that random organs are the same in both cases.
    kind, which = rng.uniform(size=2)
    if shapes == "liver" or (shapes == "mixed" and kind < _LIVER_SHARE):
        return LIVER_FAMILY
    return RANDOM_FAMILIES[0 if which < _FIRST_RANDOM_SHARE else 1]


def _centred(mesh: SurfaceMesh) -> SurfaceMesh:
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    return SurfaceMesh(mesh.vertices - middle, mesh.faces)


def _check_size(mesh: SurfaceMesh) -> None:
    reach = float(np.abs(mesh.vertices).max())
    if reach > CUBE_SIDE_M / 2.0:
        raise MeshError(
            f"organ must lie within {CUBE_SIDE_M / 2.0:.3f} m of the cube's centre, got {reach:.3f} m"
        )
    volume = enclosed_volume(mesh)
    low, high = VOLUME_RANGE_M3
    if not low <= volume <= high:
        raise MeshError(
            f"organ volume must be {low * 1e3:.1f} to {high * 1e3:.1f} litres, got {volume * 1e3:.2f}"
        )
