"""Spread a few correspondences over the surface around them (paper, phantom experiment: 13 points, 18.5 % of it).

The displacement along the surface is a rigid motion, fitted to the points, plus a Gaussian random field of the Matérn
family on the surface itself: the solution of (kappa^2 - Laplacian) u = white noise (Lindgren, Rue and Lindström 2011),
made discrete with the cotangent Laplacian. In contrast to a function of geodesic distance its covariance is valid on
any surface, its limit for long ranges is the biharmonic interpolant, and its posterior tells how much less is known
further away from the points. Range and amplitude are those of the highest marginal likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import SuperLU, splu

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import fit_rigid
from softtissue_estimator.organ.mesh import SurfaceMesh, vertex_areas
from softtissue_training.experiments.coherent_point_drift import spread_points
from softtissue_training.organs.surface_patch import edge_graph

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RANGES_M = (0.02, 0.03, 0.045, 0.07, 0.1, 0.15, 0.25)
"""Distances along the surface over which displacement is correlated (to 0.14), one of which is chosen."""
AMPLITUDES_M = tuple(np.geomspace(0.0005, 0.03, 16))
"""Standard deviations of the field, one of which is chosen."""
FEWEST_POINTS = 4
MOST_POINTS = 1000
_MARGIN_M = 0.03  # of surface around the patch that the field is computed on, so that its rim does not matter


@dataclass(frozen=True, eq=False)
class Spread:
    """Correspondences at vertices of a patch of surface.

    Attributes
    ----------
    vertices
        (k,) int64, of the surface; ascending.
    displacement
        (k, 3) m.
    sigma
        (k,) m, posterior standard deviation of each component; grows with the distance from the nearest point.
    distance
        (k,) m along the surface to the nearest point.
    share
        Share of the surface's area that the patch covers.
    range_m, amplitude_m
        Of the field.
    """

    vertices: IntArray
    displacement: FloatArray
    sigma: FloatArray
    distance: FloatArray
    share: float
    range_m: float
    amplitude_m: float


def spread_correspondences(
    surface: SurfaceMesh,
    reference: FloatArray,
    displacement: FloatArray,
    sigma_m: float,
    share: float | None = None,
) -> Spread:
    """Interpolate displacements smoothly along the surface around the points where they are known.

    Parameters
    ----------
    reference
        (m, 3) m, preoperative, near the surface; m at least 4.
    displacement
        (m, 3) m.
    sigma_m
        Standard deviation of each component of these, m.
    share
        Share of the surface to cover, the nearest to the points; None for all that is no further from a point than
        the points are from their nearest neighbours (the largest of these distances).

    Returns
    -------
    Spread
        At the patch's vertices, or at 1000 of them that are spread evenly.

    Raises
    ------
    InvalidInputError
        Too few points, a share out of range, or points on parts of the surface that do not hang together.
    """
    if len(reference) < FEWEST_POINTS:
        raise InvalidInputError(
            f"correspondences to spread: expected at least {FEWEST_POINTS}, got {len(reference)}"
        )
    if share is not None and not 0.0 < share <= 1.0:
        raise InvalidInputError(f"share of the surface: expected above 0 and up to 1, got {share:g}")
    face, corner_weights = _places(surface, reference)
    distance = _distances(surface, reference, face)
    nearest = distance.min(axis=0)
    chosen = _patch(surface, nearest, share, _reach(distance, surface, face))
    limit = float(nearest[chosen].max()) + _MARGIN_M
    field = _Field(surface, nearest <= limit)
    motion = fit_rigid(reference, reference + displacement)
    rest = displacement - (motion.apply(reference) - reference)
    rows = _rows(surface, face, corner_weights)
    range_m, amplitude = _most_likely(field, rows, rest, sigma_m)
    vertices = np.flatnonzero(chosen)
    vertices = vertices[spread_points(surface.vertices[vertices], MOST_POINTS)]
    mean, deviation = field.posterior(rows, rest, sigma_m, range_m, amplitude, vertices)
    at = surface.vertices[vertices]
    areas = vertex_areas(surface)
    return Spread(
        vertices=vertices,
        displacement=motion.apply(at) - at + mean,
        sigma=np.sqrt(deviation**2 + sigma_m**2 / len(reference)),
        distance=nearest[vertices],
        share=float(areas[chosen].sum() / areas.sum()),
        range_m=range_m,
        amplitude_m=amplitude,
    )


class _Field:
    """The random field on a part of a surface, (n,) true for its vertices."""

    def __init__(self, surface: SurfaceMesh, part: NDArray[np.bool_]) -> None:
        faces = surface.faces[part[surface.faces].all(axis=1)]
        used = np.unique(faces)
        self._local = np.full(len(surface.vertices), -1, dtype=np.int64)
        self._local[used] = np.arange(len(used))
        vertices, faces = surface.vertices[used], self._local[faces]
        self._laplacian = sparse.csc_matrix(-igl.cotmatrix(vertices, faces))
        areas = vertex_areas(SurfaceMesh(vertices, faces))
        self._mass = sparse.diags(areas).tocsc()
        self._inverse_mass = sparse.diags(1.0 / np.maximum(areas, 1e-14)).tocsc()
        self._factor: tuple[float, SuperLU] | None = None

    def covariance(self, range_m: float, columns: sparse.csc_matrix) -> FloatArray:
        """Return the covariance of unit amplitude of all vertices with combinations of vertices, (k, c)."""
        if self._factor is None or self._factor[0] != range_m:
            kappa = np.sqrt(8.0) / range_m
            inner = (kappa**2 * self._mass + self._laplacian).tocsc()
            # The variance of the field on the plane is 1 / (4 pi kappa^2).
            precision = (inner @ self._inverse_mass @ inner) / (4.0 * np.pi * kappa**2)
            self._factor = range_m, splu(precision.tocsc())
        return np.asarray(self._factor[1].solve(columns.toarray()))

    def local(self, rows: sparse.csr_matrix) -> sparse.csr_matrix:
        """Express rows over the surface's vertices over those of this part.

        Raises
        ------
        InvalidInputError
            A row needs a vertex outside.
        """
        columns = self._local[rows.indices]
        if (columns < 0).any():
            raise InvalidInputError(
                "correspondences to spread: expected points on the patch, got some beside it"
            )
        shape = (rows.shape[0], self._laplacian.shape[0])
        return sparse.csr_matrix((rows.data, columns, rows.indptr), shape=shape)

    def posterior(
        self,
        rows: sparse.csr_matrix,
        observed: FloatArray,
        sigma_m: float,
        range_m: float,
        amplitude_m: float,
        vertices: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean (k, 3) m and standard deviation (k,) m at vertices of the surface."""
        at = self.local(rows)
        count = self._laplacian.shape[0]
        wanted = self._local[vertices]
        ones = np.ones(len(wanted))
        pick = sparse.csc_matrix((ones, (wanted, np.arange(len(wanted)))), shape=(count, len(wanted)))
        prior = amplitude_m**2 * np.einsum("ik,ik->k", pick.toarray(), self.covariance(range_m, pick))
        cross = amplitude_m**2 * self.covariance(range_m, at.T.tocsc())
        inner = at @ cross + sigma_m**2 * np.eye(len(observed))
        gain = np.linalg.solve(inner, cross[wanted].T).T
        variance = prior - np.einsum("km,km->k", gain, cross[wanted])
        return gain @ observed, np.sqrt(np.maximum(variance, 0.0))


def _most_likely(
    field: _Field, rows: sparse.csr_matrix, observed: FloatArray, sigma_m: float
) -> tuple[float, float]:
    """Choose range and amplitude (m) by the marginal likelihood of the observation, (m, 3) m."""
    at = field.local(rows)
    best, chosen = -np.inf, (RANGES_M[0], AMPLITUDES_M[0])
    for range_m in RANGES_M:
        unit = at @ field.covariance(range_m, at.T.tocsc())
        eigenvalues, vectors = np.linalg.eigh(0.5 * (unit + unit.T))
        power = ((vectors.T @ observed) ** 2).sum(axis=1)
        for amplitude in AMPLITUDES_M:
            variance = amplitude**2 * np.maximum(eigenvalues, 0.0) + sigma_m**2
            likelihood = -0.5 * float((power / variance + 3.0 * np.log(variance)).sum())
            if likelihood > best:
                best, chosen = likelihood, (range_m, float(amplitude))
    return chosen


def _places(surface: SurfaceMesh, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return face (m,) and weights of its corners (m, 3) of the surface's points nearest to others."""
    _, face, closest = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces)
    corners = np.ascontiguousarray(surface.triangles[face])
    weights = igl.barycentric_coordinates(
        np.ascontiguousarray(closest), *(np.ascontiguousarray(corners[:, i]) for i in range(3))
    )
    return np.asarray(face, dtype=np.int64), np.asarray(weights, dtype=np.float64).clip(0.0, 1.0)


def _rows(surface: SurfaceMesh, face: IntArray, weights: FloatArray) -> sparse.csr_matrix:
    """Interpolation from the surface's vertices to points in its faces, (m, n)."""
    columns = surface.faces[face].ravel()
    start = np.arange(0, 3 * len(face) + 1, 3)
    return sparse.csr_matrix((weights.ravel(), columns, start), shape=(len(face), len(surface.vertices)))


def _distances(surface: SurfaceMesh, points: FloatArray, face: IntArray) -> FloatArray:
    """Distance along the surface from every point to every vertex, (m, n) m; infinite on another body."""
    start = surface.faces[face]
    near = np.linalg.norm(surface.vertices[start] - points[:, None], axis=2)
    first = start[np.arange(len(face)), near.argmin(axis=1)]
    along: FloatArray = dijkstra(edge_graph(surface), directed=False, indices=first)
    return along


def _reach(distance: FloatArray, surface: SurfaceMesh, face: IntArray) -> float:
    """Return the largest distance from a point to the point nearest to it, m."""
    between = distance[:, surface.faces[face][:, 0]]
    np.fill_diagonal(between, np.inf)
    nearest = between.min(axis=1)
    if not np.isfinite(nearest).all():
        raise InvalidInputError(
            "correspondences to spread: expected points on one connected surface, got one alone on its body"
        )
    return float(nearest.max())


def _patch(surface: SurfaceMesh, nearest: FloatArray, share: float | None, reach: float) -> NDArray[np.bool_]:
    """Return the vertices of the patch, (n,)."""
    if share is None:
        return nearest <= reach
    areas = vertex_areas(surface)
    order = np.argsort(nearest, kind="stable")
    covered = np.cumsum(areas[order]) / areas.sum()
    chosen = np.zeros(len(order), dtype=np.bool_)
    chosen[order[: int(np.searchsorted(covered, share)) + 1]] = True
    return chosen
