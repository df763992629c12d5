"""A small phantom case: an ellipsoid that is held at one end and bent at the other, as the files a user has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
import yaml

from estimator.shapes import write_ellipsoid_tets
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.experiments.fcsv import write_fcsv
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.markups_json import write_markups_json

HALF_AXES_M = np.array([0.060, 0.045, 0.040])
MARKERS_M = np.array([[0.03, 0.01, 0.005], [0.0, -0.01, 0.01], [0.045, -0.005, -0.01], [-0.02, 0.02, 0.0]])


def ellipsoid(subdivisions: int = 3) -> SurfaceMesh:
    """The organ before, m."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return SurfaceMesh(np.asarray(sphere.vertices) * HALF_AXES_M, np.asarray(sphere.faces))


def bend(points: np.ndarray) -> np.ndarray:
    """Displacement (n, 3) m: none at the end that is held, 12 mm downwards at the other."""
    moved = np.zeros_like(points)
    moved[:, 2] = -0.012 * ((points[:, 0] + 0.06) / 0.12) ** 2
    return moved


def seen_points(count: int) -> np.ndarray:
    """Points of the upper side of the organ before, (count, 3) m."""
    mesh = ellipsoid(4)
    upper = np.flatnonzero((mesh.vertices[:, 2] > 0.015) & (mesh.vertices[:, 0] > -0.03))
    return mesh.vertices[upper[np.linspace(0, len(upper) - 1, count).astype(int)]]


def write_case(
    folder: Path, *, correspondences: int | None = 13, surface: bool = False, coarse: bool = False
) -> Path:
    """Write the case: millimetres, LPS meshes, markers as Slicer's lists, correspondences as one table.

    The organ of a coarse one brings tetrahedra, with which answers take a fraction of the time.
    """
    folder.mkdir(parents=True, exist_ok=True)
    organ = ellipsoid()
    trimesh.Trimesh(1e3 * organ.vertices, organ.faces, process=False).export(folder / "organ.ply")
    attached = {"patch": {"centre": [-60, 0, 0], "share": 0.15}}
    content = {"name": "Ellipsoid", "unit": "mm", "surface": "organ.ply", "attached": attached}
    if coarse:
        write_ellipsoid_tets(folder / "tetrahedra.vtu", 1e3 * HALF_AXES_M)
        content["tetrahedra"] = "tetrahedra.vtu"
    (folder / "organ.yaml").write_text(yaml.safe_dump(content))
    labels = tuple(f"M{number}" for number in range(1, 5))
    write_fcsv(folder / "markers_before.fcsv", LabelledPoints(labels, MARKERS_M), "LPS")
    after = LabelledPoints(labels[::-1], (MARKERS_M + bend(MARKERS_M))[::-1])
    write_markups_json(folder / "markers_after.mrk.json", after, "LPS")
    if correspondences is not None:
        write_table(folder / "correspondences.csv", seen_points(correspondences))
    if surface:
        deformed = 1e3 * (organ.vertices + bend(organ.vertices))
        trimesh.Trimesh(deformed, organ.faces, process=False).export(folder / "surface_after.ply")
        visible = {"centre": [20, 0, 45], "share": 0.4}
        (folder / "case.yaml").write_text(yaml.safe_dump({"sigma": 0.5, "visible": visible}))
    return folder


def write_table(path: Path, points: np.ndarray) -> None:
    """Write points (m) before and after as a table in millimetres."""
    rows = 1e3 * np.hstack([points, points + bend(points)])
    lines = [",".join(f"{value:.6f}" for value in row) for row in rows]
    path.write_text("x,y,z,x_after,y_after,z_after\n" + "\n".join(lines) + "\n")
