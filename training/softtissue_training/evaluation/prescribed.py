"""Finite elements driven by the observation: the classical estimator, in seconds instead of milliseconds."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.evaluation.case import EvaluationCase
from softtissue_training.physics.material import Material
from softtissue_training.physics.solver import solve

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_RIDGE_WEIGHT = 1e-6  # of a mean point: keeps what the points leave open near the mean around it
_LEAST_VERTEX_WEIGHT = 1e-3  # of all points together, below which they say nothing about a vertex


def finite_element_displacement(case: EvaluationCase) -> FloatArray:
    """Solve for the organ at rest with the visible displacement prescribed, (n, 3) m at the case's points.

    Neo-Hookean on the case's own tetrahedra, attached vertices fixed, no force. Young's modulus drops out; Poisson's
    ratio is the product's default, whatever the truth's.

    Raises
    ------
    InvalidInputError
        The case has no tetrahedra.
    SolverDivergedError
        No equilibrium was found.
    """
    volume = case.volume
    if volume is None:
        raise InvalidInputError(f"fem: expected a case with tetrahedra, {case.name} has none")
    surface = case.organ.surface
    vertices, moved = vertex_displacement(case.observation, surface)
    fixed = np.zeros(len(volume.nodes), dtype=bool)
    prescribed = np.zeros_like(volume.nodes)
    fixed[vertices] = True
    prescribed[vertices] = moved
    attached = np.flatnonzero(case.organ.attached)
    fixed[attached] = True
    prescribed[attached] = 0.0
    material = Material("neo_hookean", poisson_ratio=EstimatorConfig().poisson_ratio)
    solution = solve(
        volume.nodes, volume.tets, fixed, np.zeros_like(volume.nodes), material, prescribed=prescribed
    )
    if case.points is volume.nodes:
        return solution.displacement
    return np.asarray(volume.interpolation(case.points) @ solution.displacement)


def vertex_displacement(observation: Observation, surface: SurfaceMesh) -> tuple[IntArray, FloatArray]:
    """Find the displacement of the surface's vertices that explains the observed points best.

    Least squares with linear interpolation within faces; vertices that the observed points leave open stay near the
    weighted mean of the points around them.

    Returns
    -------
    vertices
        (k,) the vertices of faces with observed points.
    displacement
        (k, 3) m.
    """
    weights = _interpolation(observation.reference, surface)
    sums = np.asarray(weights.sum(axis=0))
    vertices = np.flatnonzero(sums > _LEAST_VERTEX_WEIGHT)
    precision = observation.sigma**-2.0 / float(np.mean(observation.sigma**-2.0))
    observed = csr_array(weights[:, vertices])
    weighted = csr_array(observed.multiply(precision[:, None]))
    around = np.asarray(weighted.T @ observation.displacement) / np.asarray(weighted.sum(axis=0))[:, None]
    normal = (observed.T @ weighted).toarray()
    normal[np.diag_indices(len(vertices))] += _RIDGE_WEIGHT
    correction = np.linalg.solve(normal, weighted.T @ (observation.displacement - observed @ around))
    return vertices, around + correction


def _interpolation(points: FloatArray, surface: SurfaceMesh) -> csr_array:
    """Sparse matrix (points, vertices) that interpolates vertex values at the surface points nearest to points."""
    _, face, closest = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces)
    corners = surface.faces[np.asarray(face)]
    first, second, third = (np.ascontiguousarray(surface.vertices[corners[:, i]]) for i in range(3))
    weights = igl.barycentric_coordinates(np.ascontiguousarray(closest), first, second, third)
    rows = np.repeat(np.arange(len(points)), 3)
    entries = (np.asarray(weights, dtype=np.float64).clip(0.0, 1.0).ravel(), (rows, corners.ravel()))
    return csr_array(coo_array(entries, shape=(len(points), len(surface.vertices))))
