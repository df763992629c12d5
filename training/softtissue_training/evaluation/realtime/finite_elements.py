"""The classical way, timed: finite elements with the visible displacement prescribed."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.observation.bending_organ import NOISE_M, BendingOrgan
from softtissue_estimator.observation.observation import make_observation
from softtissue_estimator.organ.organ import Organ, load_organ, make_organ
from softtissue_estimator.organ.organ_file import read_organ_file
from softtissue_estimator.organ.volume_mesh import VolumeMesh
from softtissue_estimator.support.resources import bundled_organ
from softtissue_training.errors import SolverDivergedError
from softtissue_training.evaluation.case import EvaluationCase
from softtissue_training.evaluation.prescribed import finite_element_displacement
from softtissue_training.organs.named_surface import organ_from_file


def time_finite_elements(
    element_size_m: float, points: int, repeats: int, seed: int, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Time the solution for one frame of the bending bundled liver at its largest displacement.

    Filling in its tetrahedra, which an organ needs once, is not counted. Where no equilibrium is found, `problem` says
    why.

    Parameters
    ----------
    element_size_m : float
        Edge length of the tetrahedra, m; 0.010 is that of the in-silico benchmark.
    points : int
        Tracked points.
    repeats : int
        Solutions.
    seed : int
        Of points and noise.
    progress : callable
        Told what is going on.

    Raises
    ------
    SoftTissueError
        If the organ cannot be filled.
    """
    name = f"finite elements of {1e3 * element_size_m:g} mm"
    progress(f"{name}: filling the organ with tetrahedra")
    organ, volume = coarse_liver(element_size_m)
    scene = BendingOrgan(organ, points, np.random.default_rng(seed))
    config = EstimatorConfig()
    moved = scene.points(1.5)
    observation, _ = make_observation(moved, scene.reference, np.full(points, NOISE_M), organ, config)
    nodes = volume.nodes
    case = EvaluationCase(
        name="bending organ",
        organ=organ,
        observation=observation,
        points=nodes,
        truth=np.zeros_like(nodes),
        visible=np.zeros(len(nodes), dtype=np.bool_),
        depth=np.zeros(len(nodes)),
        volume=volume,
    )
    seconds: list[float] = []
    problem = ""
    for number in range(repeats):
        progress(f"{name}: solution {number + 1} of {repeats}")
        began = time.perf_counter()
        try:
            finite_element_displacement(case)
        except SolverDivergedError as error:
            problem = str(error)
            break
        seconds.append(time.perf_counter() - began)
    return {
        "element_size_mm": round(1e3 * element_size_m, 3),
        "points": points,
        "nodes": len(nodes),
        "tetrahedra": len(volume.tets),
        "seconds": [round(value, 4) for value in seconds],
        "p50_ms": round(1e3 * float(np.median(seconds)), 1) if seconds else None,
        "problem": problem,
    }


def coarse_liver(element_size_m: float) -> tuple[Organ, VolumeMesh]:
    """Return the bundled liver without structures on tetrahedra whose first nodes are its surface's."""
    fine = load_organ(bundled_organ())
    file = read_organ_file(bundled_organ())
    mesh = organ_from_file(file.surface, file.unit_m, element_size_m)
    # Its bounding box is centred on the origin.
    middle = 0.5 * (fine.surface.vertices.min(axis=0) + fine.surface.vertices.max(axis=0))
    nearest = cKDTree(fine.surface.vertices - middle).query(mesh.surface.vertices)[1]
    organ = make_organ("Liver", fine.frame, mesh.surface, (), fine.attached[nearest])
    return organ, VolumeMesh(mesh.vertices, mesh.tets)
