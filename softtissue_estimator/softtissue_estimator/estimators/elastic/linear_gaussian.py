"""A Gaussian process over an organ's displacement whose covariance is elasticity, made linear where the organ is.

Unknown loads make the prior: every load of the traction basis (`loads.load_basis`) has an amplitude a ~ N(0, v I_3) of
its own variance. About a deformation u_k the organ answers linearly, u = offset + C a with C = K(u_k)^-1 B
(`hyperelastic.Tangent`), and an observation y = H u + e, e ~ N(0, S), enters only through H^T S^-1 H, as large as the
mesh however many the points:

    G = C^T (H^T S^-1 H (x) I_3) C,    (D^-2 + G) a = C^T H^T S^-1 (y - H offset),    D the roots of the variances.

The variances are re-estimated by automatic relevance determination (`relevance`). Repeated about its own mean this is
Gauss-Newton on the non-linear energy. At the start the organ is linear about a rigid motion, which makes large
rotations harmless.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from softtissue_estimator.estimators.elastic.hyperelastic import Tangent
from softtissue_estimator.estimators.elastic.relevance import (
    Amplitudes,
    Variances,
    determine_relevance,
    invert_lower,
)
from softtissue_estimator.organ.mesh import FloatArray

LEAST_FIELD_SIGMA_M = 1e-4
"""Standard deviation of the field of errors, at least: neighbours err together by as much, however good."""
_BLOCK_ROWS = 160  # of a triangular matrix: as many as are worth a product of their own


@dataclass(frozen=True, eq=False)
class ObservedNodes:
    """An observation, summed up at the nodes of the mesh that it depends on.

    Parameters
    ----------
    nodes : (s,) int64
    normal : (s, s) float64, sparse, 1/m^2
        H^T S^-1 H for one component.
    right : (s, 3) float64 1/m
        H^T S^-1 y.
    power : float
        y^T S^-1 y.
    """

    nodes: Tensor
    normal: Tensor
    right: Tensor
    power: float


@dataclass(frozen=True, eq=False)
class Errors:
    """What moves observed points without moving the organ.

    Parameters
    ----------
    columns : (n, 3, m + k) float64
        Displacement of the nodes, m, by each unit: of m values of a field, then of k nuisance parameters with the prior
        N(0, 1).
    field_values : int
        m.
    most_sigma_m : float
        Standard deviation of the field, at most.
    """

    columns: Tensor
    field_values: int
    most_sigma_m: float = math.inf

    def displacement(self, amplitudes: Amplitudes) -> Tensor:
        """Mean of what they move the nodes by, (n, 3) float64 m."""
        return self.columns @ amplitudes.errors


def sum_up(
    interpolation: csr_array, observed: FloatArray, precision: FloatArray, device: torch.device
) -> ObservedNodes:
    """Sum an observation up at the nodes.

    Parameters
    ----------
    interpolation : (c, n) sparse
        H for one component.
    observed : (c, 3) m
        y.
    precision : (c,) 1/m^2
        Inverse variance of each component of `observed`.
    """
    used = np.zeros(interpolation.shape[1], dtype=np.bool_)
    used[interpolation.indices] = True
    nodes = np.flatnonzero(used)
    entries = (np.cumsum(used) - 1)[interpolation.indices], interpolation.indptr
    shape = interpolation.shape[0], len(nodes)
    unweighted = csr_array((interpolation.data, *entries), shape=shape)
    weights = precision.repeat(np.diff(interpolation.indptr))
    weighted = csr_array((interpolation.data * weights, *entries), shape=shape)
    right = torch.from_numpy(np.asarray(weighted.T @ observed))
    normal = _sparse_tensor(csr_array(unweighted.T @ weighted))
    power = float(precision @ np.square(observed).sum(axis=1))
    return ObservedNodes(torch.from_numpy(nodes).to(device), normal.to(device), right.to(device), power)


def _sparse_tensor(matrix: csr_array) -> Tensor:
    matrix.sort_indices()
    entries = matrix.tocoo()
    place = torch.from_numpy(np.stack(entries.coords).astype(np.int64))
    values = torch.from_numpy(entries.data)
    return torch.sparse_coo_tensor(place, values, matrix.shape, check_invariants=False, is_coalesced=True)


def equal_variances(tangent: Tangent, observed: ObservedNodes, prior_sigma_m: float) -> Tensor:
    """Variance of every load's amplitude, all the same, that lets the observed nodes move by `prior_sigma_m`, (p,)."""
    rows = _rows(tangent, observed)
    power = rows.square().sum(dim=2).mean().double()
    return (prior_sigma_m**2 / power).repeat(rows.shape[2] // 3)


def condition(
    tangent: Tangent,
    observed: ObservedNodes,
    errors: Errors,
    variances: Variances,
    updates: int,
) -> tuple[Amplitudes, float]:
    """Condition the loads on an observation; also the logarithm of the evidence, with a constant of the noise alone.

    Parameters
    ----------
    errors : Errors
    variances : Variances
        To start from.
    updates : int
        How often the variances are re-estimated.
    """
    # In double precision from here on: G is as large as the square of the signal over the noise.
    rows = torch.cat(
        [_rows(tangent, observed).double(), errors.columns.index_select(0, observed.nodes)], dim=2
    )
    count, _, rank = rows.shape
    flat = rows.reshape(3 * count, rank)
    gram = flat.T @ (observed.normal @ rows.reshape(count, 3 * rank)).reshape(3 * count, rank)
    offset = tangent.offset[observed.nodes]
    shifted = observed.normal @ offset
    right = flat.T @ (observed.right - shifted).reshape(-1)
    amplitudes = determine_relevance(
        gram, right, variances, errors.field_values, updates, LEAST_FIELD_SIGMA_M**2, errors.most_sigma_m**2
    )
    power = observed.power + float((offset * (shifted - 2.0 * observed.right)).sum())
    return amplitudes, amplitudes.log_evidence(right, power)


def mean_displacement(tangent: Tangent, amplitudes: Amplitudes) -> Tensor:
    """Posterior mean at the nodes, (n, 3) float64 m."""
    moved = tangent.response @ amplitudes.loads.float()
    return tangent.offset + moved.double().reshape(-1, 3)


def standard_deviation(tangent: Tangent, amplitudes: Amplitudes) -> Tensor:
    """Root mean square of the three components' posterior standard deviations at the nodes, (n,) float64 m."""
    # Single precision is plenty for a standard deviation.
    root = amplitudes.root
    count = len(root)
    half = (invert_lower(amplitudes.factor)[:, :count] * root).float()  # L^-1 D, lower triangular like L
    variance = torch.zeros(len(tangent.state), device=half.device)
    for begin in range(0, len(half), _BLOCK_ROWS):
        end = min(begin + _BLOCK_ROWS, len(half))
        loads = min(end, count)
        part = tangent.response[:, :loads] @ half[begin:end, :loads].T
        variance += part.square().view(-1, 3 * (end - begin)).sum(dim=1)
    return (variance / 3.0).sqrt().double()


def _rows(tangent: Tangent, observed: ObservedNodes) -> Tensor:
    """Response of the observed nodes, (s, 3, 3 p)."""
    by_node = tangent.response.view(len(tangent.state), 3, -1)
    return by_node.index_select(0, observed.nodes)
