"""The anatomy at rest: a liver of other proportions than the phantom's, its vessels, the vena cava.

The solid is a liver of the phantom's family from another seed, with a slim right and a large left lobe, then stretched
and twisted as a whole, so that no part of it has the phantom's shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.experiments.breathing_liver.spec import BreathingSpec
from softtissue_training.phantom.anatomy import Part, check_inside, enter_organ, straight_way
from softtissue_training.phantom.implicit import Points, Values, capsule
from softtissue_training.phantom.isosurface import isosurface
from softtissue_training.phantom.liver_shape import LiverShape, random_liver
from softtissue_training.phantom.tumour import place_tumour
from softtissue_training.phantom.vessels import grow_tree, interior_points

Array = NDArray[np.float64]

_LOBE_RADII_RATIOS = np.array([[0.94, 1.0, 1.04], [0.96, 1.0, 1.06], [1.0, 1.05, 1.0], [1.18, 1.15, 1.05]])
_STRETCH = np.array([0.97, 1.06, 0.94])
_TWIST_RAD_PER_M = 1.6  # about the body's long axis
_WAVE_HEIGHT_M = 0.0028

# In the family's own space, m: the groove of the vena cava, and ways along which the vessels enter.
_CAVA = (np.array([0.010, 0.054, -0.045]), np.array([0.008, 0.046, 0.080]), 0.0145)
_PORTAL_ENTRY = (np.array([0.010, 0.060, -0.026]), np.array([-0.008, 0.0, 0.012]))
_HEPATIC_ENTRY = (np.array([0.012, 0.060, 0.056]), np.array([0.0, 0.008, 0.038]))
_VESSEL_DEPTH_M = 0.010
_VESSEL_END_RADIUS_M = 0.0021
_VESSEL_GAP_M = 0.008
_VESSEL_CANDIDATES = 700
_TUMOUR_RADIUS_M = 0.013
_TUMOUR_DEPTH_M = 0.025
_TUMOUR_GAP_M = 0.002


@dataclass(frozen=True)
class StretchedLiver:
    """A liver of the family, stretched and twisted; call it with points ``(n, 3)`` m, negative inside."""

    liver: LiverShape

    def __call__(self, points: Points) -> Values:
        """Return roughly the signed distance (m) of points ``(n, 3)`` (m), positive outside."""
        return self.liver(_turned(points, -_TWIST_RAD_PER_M) / _STRETCH)

    @property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper corner (m) of a box with room around the organ."""
        corners = np.stack(np.meshgrid(*np.array(self.liver.box).T, indexing="ij"), axis=-1).reshape(-1, 3)
        placed = placed_points(corners)
        return placed.min(axis=0) - 0.005, placed.max(axis=0) + 0.005


@dataclass(frozen=True)
class Anatomy:
    """The body at rest: no force acts on it. All in metres.

    Attributes
    ----------
    shape
        The solid.
    surface
        Its triangulated boundary.
    parts
        Vessels and tumour inside.
    cava
        The vena cava, which touches the liver from behind.
    """

    shape: StretchedLiver
    surface: SurfaceMesh
    parts: tuple[Part, ...]
    cava: SurfaceMesh


def placed_points(points: Points) -> Array:
    """Take points ``(n, 3)`` m from the family's space to the body."""
    return _turned(points * _STRETCH, _TWIST_RAD_PER_M)


def build_anatomy(
    spec: BreathingSpec, rng: np.random.Generator, progress: Callable[[str], None] = lambda _: None
) -> Anatomy:
    """Make the organ and what lies inside and beside it.

    Raises
    ------
    MeshError
        If a structure does not lie wholly inside the organ.
    """
    progress("organ surface")
    drawn = random_liver(rng)
    shape = StretchedLiver(
        replace(drawn, lobe_radii=drawn.lobe_radii * _LOBE_RADII_RATIOS, wave_height=_WAVE_HEIGHT_M)
    )
    surface = isosurface(shape, *shape.box, spec.organ_spacing)
    progress("vessels")
    candidates = interior_points(shape, shape.box, _VESSEL_DEPTH_M, _VESSEL_CANDIDATES, rng)
    root = enter_organ(shape, placed_points(straight_way(*_PORTAL_ENTRY)))
    portal = grow_tree(shape, root, spec.portal_ends, candidates, _VESSEL_END_RADIUS_M)
    candidates = interior_points(
        shape, shape.box, _VESSEL_DEPTH_M, _VESSEL_CANDIDATES, rng, free=lambda p: portal(p) > _VESSEL_GAP_M
    )
    root = enter_organ(shape, placed_points(straight_way(*_HEPATIC_ENTRY)))
    hepatic = grow_tree(shape, root, spec.hepatic_ends, candidates, _VESSEL_END_RADIUS_M)
    portal_mesh = isosurface(portal, *portal.box, spec.vessel_spacing, rounds=8)
    hepatic_mesh = isosurface(hepatic, *hepatic.box, spec.vessel_spacing, rounds=8)
    room = interior_points(shape, shape.box, _TUMOUR_DEPTH_M, 2000, rng)
    tumour = place_tumour(
        room, (portal_mesh.vertices, hepatic_mesh.vertices), _TUMOUR_RADIUS_M, _TUMOUR_GAP_M, rng
    )
    parts = (
        Part("portal vein", "vessel", portal_mesh, (0.25, 0.35, 0.85)),
        Part("hepatic veins", "vessel", hepatic_mesh, (0.35, 0.70, 0.90)),
        Part("tumour", "tumour", isosurface(tumour, *tumour.box, spec.vessel_spacing), (0.95, 0.85, 0.20)),
    )
    check_inside(shape, parts)
    return Anatomy(shape, surface, parts, _vena_cava(spec))


def _vena_cava(spec: BreathingSpec) -> SurfaceMesh:
    start, end, radius = _CAVA
    box = np.stack([start, end])
    # Made in the family's space, so that it lies in the groove however the body is stretched.
    tube = isosurface(
        lambda points: capsule(points, start, end, radius, radius),
        box.min(axis=0) - 2.0 * radius,
        box.max(axis=0) + 2.0 * radius,
        spec.organ_spacing,
    )
    return SurfaceMesh(placed_points(tube.vertices), tube.faces)


def _turned(points: Points, rate: float) -> Array:
    """Turn every point ``(n, 3)`` m about the z axis by an angle in proportion to its height, `rate` rad/m."""
    c, s = np.cos(rate * points[:, 2]), np.sin(rate * points[:, 2])
    x, y = points[:, 0], points[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, points[:, 2]], axis=1)
