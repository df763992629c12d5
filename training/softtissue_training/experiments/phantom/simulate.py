"""Make a phantom case of any organ by simulation, to try the experiment before there is a second scan.

    python -m softtissue_training.experiments.phantom.simulate ORGAN --out CASE

ORGAN is a folder with `organ.yaml`. The organ is filled with tetrahedra by Gmsh, held where it is attached, pushed far
from there, and solved by this package's finite elements; estimators have neither its mesh nor its Poisson's ratio. The
case's folder then holds markers, few correspondences with noise, and a noisy part of the surface after.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces, vertex_areas
from softtissue_estimator.organ.organ import Organ, load_organ
from softtissue_estimator.organ.organ_file import FILE_NAME, read_organ_file
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_estimator.organ.surface_patch import patch
from softtissue_estimator.organ.volume_mesh import VolumeMesh
from softtissue_estimator.support.yaml_file import read_yaml
from softtissue_estimator.view.rendering import vertex_normals
from softtissue_training.experiments.coherent_point_drift import spread_points
from softtissue_training.experiments.fcsv import write_fcsv
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.phantom.case_file import FILE_NAME as CASE_FILE_NAME
from softtissue_training.organs.named_surface import organ_from_file
from softtissue_training.physics.material import Material
from softtissue_training.physics.solver import solve

FloatArray = NDArray[np.float64]

MATERIAL = Material("neo_hookean", 3000.0, 0.45)
CORRESPONDENCES, MARKERS = 13, 6
_OBSERVED_SPACING_M, _OBSERVED_POINTS, _MARKER_DEPTH_M, _LEAST_MOVED_M = 0.004, 1200, 0.010, 0.005
_FIRST_FORCE_N = 0.2
_MOST_SOLUTIONS = 12
_PATCH_DISTANCE_M = 0.04  # from the middle of the pushed patch to that of the visible one
_LEAST_THICKNESS_M = 0.02  # of organ below the pushed patch


@dataclass(frozen=True)
class PushSettings:
    """What is simulated.

    Attributes
    ----------
    element_size_m
        Of the tetrahedra, m.
    radius_m
        Standard deviation of the pushed patch, m.
    largest_m
        How far the organ is pushed where it moves most, m.
    visible_share
        Share of the surface that is visible, beside the pushed patch.
    noise_m
        Standard deviation of each coordinate of the observed points, m.
    """

    element_size_m: float = 0.010
    radius_m: float = 0.026
    largest_m: float = 0.045
    visible_share: float = 0.185
    noise_m: float = 0.001


@dataclass(frozen=True, eq=False)
class Pushed:
    """A simulated deformation: tetrahedra in the organ's frame and nodal displacement (n, 3) m."""

    mesh: VolumeMesh
    displacement: FloatArray
    pushed_at: FloatArray
    force_n: float

    def at(self, points: FloatArray) -> FloatArray:
        """Displacement of preoperative points (k, 3) m."""
        return np.asarray(self.mesh.interpolation(points) @ self.displacement)


def push(folder: Path, organ: Organ, settings: PushSettings) -> Pushed:
    """Simulate an organ that is held where it is attached and pushed inwards far from there.

    Raises
    ------
    SoftTissueError
        The organ cannot be filled, is attached nowhere, or no equilibrium is found.
    """
    if not organ.attached.any():
        raise InvalidInputError(f"organ {folder}: expected an attached region to hold it by, got none")
    file = read_organ_file(folder)
    filled = organ_from_file(file.surface, file.unit_m, settings.element_size_m)
    # The tetrahedra are centred on the origin, as all simulations are.
    vertices = organ.surface.vertices
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    surface = SurfaceMesh(filled.surface.vertices + middle, filled.surface.faces)
    nodes = filled.vertices + middle
    count = len(surface.vertices)
    fixed = np.zeros(len(nodes), dtype=np.bool_)
    fixed[:count] = organ.attached[cKDTree(vertices).query(surface.vertices)[1]]
    normals = vertex_normals(surface)
    from_held = np.asarray(cKDTree(nodes[fixed]).query(surface.vertices)[0])
    thick = (
        signed_distance(surface, surface.vertices - _LEAST_THICKNESS_M * normals) < -0.75 * _LEAST_THICKNESS_M
    )
    centre = int(np.where(thick, from_held, from_held.min()).argmax())
    reach = np.linalg.norm(surface.vertices - surface.vertices[centre], axis=1)
    weight = np.exp(-0.5 * (reach / settings.radius_m) ** 2) * vertex_areas(surface)
    weight[fixed[:count]] = 0.0
    # Along the surface rather than straight in: organs are shoved aside more than they are dented.
    aside = nodes[fixed].mean(axis=0) - surface.vertices[centre]
    direction = aside / np.linalg.norm(aside) - normals[centre]
    direction /= np.linalg.norm(direction)
    load = np.zeros_like(nodes)
    load[:count] = (weight / weight.sum())[:, None] * direction
    force, moved = _force_for(settings.largest_m, nodes, filled.tets, fixed, load)
    return Pushed(VolumeMesh(nodes, filled.tets), moved, surface.vertices[centre], force)


def _force_for(
    largest_m: float, nodes: FloatArray, tets: NDArray[np.int64], fixed: NDArray[np.bool_], load: FloatArray
) -> tuple[float, FloatArray]:
    """Return the force (N) at which the organ moves about so far at most, and the displacement (n, 3) m.

    Doubled until the organ moves further, then by halving the interval in between.
    """
    low, high, force = 0.0, np.inf, _FIRST_FORCE_N
    found: tuple[float, FloatArray] | None = None
    for _ in range(_MOST_SOLUTIONS):
        moved = solve(nodes, tets, fixed, force * load, MATERIAL).displacement
        largest = float(np.linalg.norm(moved, axis=1).max())
        if largest <= 1.1 * largest_m:
            found = force, moved
        if abs(largest / largest_m - 1.0) < 0.1:
            break
        low, high = (force, high) if largest < largest_m else (low, force)
        force = 2.0 * force if np.isinf(high) else 0.5 * (low + high)
    if found is None:
        raise InvalidInputError(
            f"simulated case: expected an organ that moves {1e3 * largest_m:.0f} mm, got {1e3 * largest:.0f} mm "
            f"with {_FIRST_FORCE_N:g} N; is more of it attached than organ.yaml says?"
        )
    return found


def write_simulated_case(
    folder: Path, out: Path, settings: PushSettings, rng: np.random.Generator, pushed: Pushed | None = None
) -> str:
    """Write the case's folder; returns in a sentence what it shows.

    Parameters
    ----------
    pushed
        A deformation of one's own; by default `push` makes one.

    Raises
    ------
    SoftTissueError
        As `push`, or too few points inside the organ move.
    """
    organ = load_organ(folder)
    pushed = pushed or push(folder, organ, settings)
    out.mkdir(parents=True, exist_ok=True)
    _copy_organ(folder, out)
    chosen = patch(organ.surface, _beside(organ, pushed.pushed_at), settings.visible_share)
    faces = np.asarray(chosen[organ.surface.faces].all(axis=1))
    observed = sample_faces(organ.surface, faces, _OBSERVED_SPACING_M)[0]
    observed = observed[spread_points(observed, _OBSERVED_POINTS)]
    after = observed + pushed.at(observed) + settings.noise_m * rng.normal(size=observed.shape)
    few = spread_points(observed, CORRESPONDENCES)
    _write_table(
        out / "correspondences.csv", "x,y,z,x_after,y_after,z_after", np.hstack([observed, after])[few]
    )
    # In another order than before, so that nothing tells which point is which.
    _write_table(out / "surface_after.csv", "x,y,z", after[rng.permutation(len(after))])
    markers = _markers(organ, pushed)
    labels = tuple(f"M{number}" for number in range(1, len(markers) + 1))
    moved = pushed.at(markers)
    write_fcsv(out / "markers_before.fcsv", LabelledPoints(labels, markers), "LPS")
    write_fcsv(out / "markers_after.fcsv", LabelledPoints(labels, markers + moved), "LPS")
    content = {
        "name": f"{organ.name}, simulated",
        "unit": "mm",
        "system": "LPS",
        "sigma": 1e3 * settings.noise_m,
        "spread": {"share": settings.visible_share},
    }
    (out / CASE_FILE_NAME).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    length = 1e3 * np.linalg.norm(moved, axis=1)
    most = 1e3 * np.linalg.norm(pushed.at(organ.surface.vertices), axis=1).max()
    return (
        f"case {out}: {len(pushed.mesh.nodes)} nodes, pushed with {pushed.force_n:.2f} N; the surface moves "
        f"{most:.0f} mm at most, {len(markers)} markers {length.mean():.1f} mm on average (max {length.max():.1f})"
    )


def _beside(organ: Organ, pushed_at: FloatArray) -> FloatArray:
    """Return a point of the surface (3,) m beside the pushed patch, so that part of that is visible."""
    held = organ.surface.vertices[organ.attached].mean(axis=0)
    free = organ.surface.vertices[~organ.attached]
    gap = np.linalg.norm(free - pushed_at, axis=1)
    around = free[gap <= max(_PATCH_DISTANCE_M, float(gap.min()))]
    return np.asarray(around[int(np.linalg.norm(around - held, axis=1).argmin())])


def _markers(organ: Organ, pushed: Pushed) -> FloatArray:
    nodes = pushed.mesh.nodes
    deep = signed_distance(organ.surface, nodes) < -_MARKER_DEPTH_M
    inside = nodes[deep & (np.linalg.norm(pushed.displacement, axis=1) > _LEAST_MOVED_M)]
    if len(inside) < MARKERS:
        raise InvalidInputError(
            f"simulated case: expected {MARKERS} points inside the organ that move, got {len(inside)}; push it further"
        )
    return np.asarray(inside[spread_points(inside, MARKERS)])


def _write_table(path: Path, header: str, rows: FloatArray) -> None:
    lines = [",".join(f"{1e3 * value:.4f}" for value in row) for row in rows]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


def _copy_organ(folder: Path, out: Path) -> None:
    """Write `organ.yaml` with complete paths."""

    def complete(value: object) -> object:
        if isinstance(value, dict):
            return {key: complete(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [complete(entry) for entry in value]
        if isinstance(value, str) and (folder / value).is_file():
            return str((folder / value).resolve())
        return value

    content = read_yaml(folder / FILE_NAME, InvalidInputError)
    (out / FILE_NAME).write_text(yaml.safe_dump(complete(content), sort_keys=False), encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m softtissue_training.experiments.phantom.simulate",
        description="Make a phantom case of an organ by simulation.",
    )
    parser.add_argument("organ", type=Path, metavar="ORGAN", help="folder with organ.yaml")
    parser.add_argument("--out", type=Path, required=True, metavar="CASE", help="folder of the case")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the noise (default: 0)")
    parser.add_argument(
        "--largest", type=float, default=45.0, metavar="MM", help="largest displacement (default: 45)"
    )
    parser.add_argument(
        "--element-size", type=float, default=10.0, metavar="MM", help="of the tetrahedra (default: 10)"
    )
    options = parser.parse_args(arguments)
    settings = PushSettings(element_size_m=1e-3 * options.element_size, largest_m=1e-3 * options.largest)
    print("==> filling the organ with tetrahedra and solving", file=sys.stderr, flush=True)
    try:
        print(write_simulated_case(options.organ, options.out, settings, np.random.default_rng(options.seed)))
    except SoftTissueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
