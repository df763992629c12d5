"""Organs for tests of speed: the bundled liver with structures of a given size."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
import yaml
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import Organ, load_organ
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_estimator.support.resources import bundled_organ

FloatArray = NDArray[np.float64]

RING_VERTICES = 10_000  # and 20,000 triangles
_VERTICES_ACROSS = 100
_TUBE_RADIUS_RATIO = 0.35  # radius of a ring's tube over that of its circle
_GRID_SPACING_M = 0.004
_RING_MARGIN_M = 0.002
_LEAST_REACH_M = 0.003


def ring_organ(folder: Path, vertices: int, progress: Callable[[str], None]) -> Organ:
    """Write the bundled liver with rings of together so many vertices inside, unless it is there, and load it.

    Each ring is a closed tube of up to 10,000 vertices and twice as many triangles.

    Parameters
    ----------
    folder : Path
        For `organ.yaml` and its meshes.
    vertices : int
        A multiple of 100, at least 1,000.

    Raises
    ------
    InvalidInputError
        If no rings of such a number can be made.
    """
    if vertices < 1000 or vertices % _VERTICES_ACROSS:
        raise InvalidInputError(f"structures: expected a multiple of 100 vertices from 1000, got {vertices}")
    marker = folder / "organ.yaml"
    if not marker.is_file():
        progress(f"writing an organ with structures of {vertices} vertices to {folder}")
        folder.mkdir(parents=True, exist_ok=True)
        sizes = _sizes(vertices)
        liver = load_organ(bundled_organ())
        centres, radius = _places(liver.surface, len(sizes))
        names = []
        for number, (centre, size) in enumerate(zip(centres, sizes, strict=True), start=1):
            mesh = ring(size // _VERTICES_ACROSS, _VERTICES_ACROSS, radius, _TUBE_RADIUS_RATIO * radius)
            names.append(f"ring_{number}")
            # In millimetres, as the liver's own file is.
            points = 1e3 * (mesh.vertices + centre)
            trimesh.Trimesh(points, mesh.faces, process=False).export(folder / f"{names[-1]}.ply")
        _write_yaml(marker, names)
    return load_organ(folder)


def ring(around: int, across: int, radius_m: float, tube_m: float) -> SurfaceMesh:
    """Return a torus about the z axis with `around` x `across` vertices and twice as many triangles, wound outward."""
    first, second = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    angle, tilt = 2.0 * np.pi * first / around, 2.0 * np.pi * second / across
    distance = radius_m + tube_m * np.cos(tilt)
    vertices = np.stack([distance * np.cos(angle), distance * np.sin(angle), tube_m * np.sin(tilt)], axis=-1)
    number = first * across + second
    right, up = np.roll(number, -1, axis=0), np.roll(number, -1, axis=1)
    both = np.roll(right, -1, axis=1)
    corners = np.stack([np.stack([number, right, both], axis=-1), np.stack([number, both, up], axis=-1)])
    return SurfaceMesh(vertices.reshape(-1, 3), corners.reshape(-1, 3))


def _sizes(vertices: int) -> list[int]:
    full, rest = divmod(vertices, RING_VERTICES)
    return [RING_VERTICES] * full + ([rest] if rest else [])


def _places(surface: SurfaceMesh, count: int) -> tuple[list[FloatArray], float]:
    """Find centres of spheres of one radius (m) inside a surface, none of which touch."""
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    axes = [np.arange(a, b, _GRID_SPACING_M) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    depth = -signed_distance(surface, points)
    reach = float(depth.max())
    while reach > _LEAST_REACH_M:
        found: list[FloatArray] = []
        free = depth >= reach
        while free.any() and len(found) < count:
            centre = points[np.argmax(np.where(free, depth, -np.inf))]
            found.append(centre)
            free &= np.linalg.norm(points - centre, axis=1) >= 2.0 * reach
        if len(found) == count:
            return found, (reach - _RING_MARGIN_M) / (1.0 + _TUBE_RADIUS_RATIO)
        reach *= 0.9
    raise InvalidInputError(f"structures: expected room for {count} rings inside the organ, got less")


def _write_yaml(path: Path, names: list[str]) -> None:
    source = bundled_organ()
    entries = yaml.safe_load((source / "organ.yaml").read_text(encoding="utf-8"))
    for name in (entries["surface"], entries["tetrahedra"], entries["attached"]["vertices"]):
        shutil.copy(source / name, path.parent / name)
    entries["name"] = f"Phantom liver with {len(names)} ring{'s' if len(names) > 1 else ''}"
    entries["structures"] = [
        {
            "name": name.replace("_", " "),
            "kind": "vessel",
            "mesh": f"{name}.ply",
            "colour": [0.25, 0.35, 0.85],
        }
        for name in names
    ]
    # Last, so that a folder with it is complete.
    path.write_text(yaml.safe_dump(entries, sort_keys=False), encoding="utf-8")
