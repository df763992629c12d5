"""A Gaussian process over an organ's displacement whose covariance is elasticity, made linear where the organ is.

Unknown loads make the prior: every load of the traction basis (`loads.load_basis`) has an amplitude a ~ N(0, v I_3) of
its own variance. About a deformation u_k the organ answers linearly, u = offset + C a with C = K(u_k)^-1 B
(`hyperelastic.Tangent`), and an observation y = H u + e, e ~ N(0, S), enters only through H^T S^-1 H, as large as the
observed part of the mesh however many the points (`observed_nodes`):

    G = C^T (H^T S^-1 H (x) I_3) C,    (D^-2 + G) a = C^T H^T S^-1 (y - H offset),    D the roots of the variances.

The variances are re-estimated by automatic relevance determination (`relevance`). Repeated about its own mean this is
Gauss-Newton on the non-linear energy. At the start the organ is linear about a rigid motion, which makes large
rotations harmless.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.amplitudes import (
    Amplitudes,
    FieldValues,
    Variances,
    invert_lower,
)
from softtissue_estimator.estimators.elastic.observed_nodes import ObservedNodes
from softtissue_estimator.estimators.elastic.relevance import determine_relevance
from softtissue_estimator.estimators.elastic.tangent import Tangent

LEAST_FIELD_SIGMA_M = 5e-5
"""Standard deviation of the field of errors, at least: neighbours err together by as much, however good."""
_ALL = slice(None)
_BLOCK_ROWS = 160  # of a triangular matrix: as many as are worth a product of their own
_BLOCK_COLUMNS = 240  # the same, of a symmetric one


@dataclass(frozen=True, eq=False)
class Errors:
    """What moves observed nodes without moving the organ: fields of errors, and nuisance parameters.

    Parameters
    ----------
    columns : (s, m) float64
        Displacement of the nodes along an axis by each independent part of a smooth field.
    nuisance : (s, 3, k) float64 m
        Displacement by each of k parameters with the prior N(0, 1).
    ray : (3,) float64 or None
        Along which a field of m values acts.
    slide : (s, 3, q) float64 or None
        Displacement by each value of a further field.
    most_fields : (f,) float64 m^2 or None
        Variance of each field, at most: of that along the ray, of the one along any axis (3 m values, of one part
        after the other), of the further one.
    """

    columns: Tensor
    nuisance: Tensor
    ray: Tensor | None = None
    slide: Tensor | None = None
    most_fields: Tensor | None = None

    @property
    def field_values(self) -> FieldValues:
        """Count of the values of each field."""
        count = self.columns.shape[1]
        along_ray = () if self.ray is None else (count,)
        further = () if self.slide is None else (self.slide.shape[2],)
        return *along_ray, 3 * count, *further

    def displacement(self, amplitudes: Amplitudes) -> Tensor:
        """Mean of what they move the observed nodes by, (s, 3) float64 m."""
        values = list(amplitudes.field.split(self.field_values))
        along_ray = 0.0 if self.ray is None else values.pop(0)[:, None] * self.ray
        found: Tensor = (
            self.columns @ (values[0].view(-1, 3) + along_ray) + self.nuisance @ amplitudes.nuisance
        )
        return found if self.slide is None else found + self.slide @ values[1]


def equal_variances(
    tangent: Tangent, nodes: Tensor, prior_sigma_m: float, pushing: slice | Tensor = _ALL
) -> Tensor:
    """Variance of every load, all the same, (p,), with which those that push move the nodes (s,) by `prior_sigma_m`."""
    powers = tangent.powers(nodes)
    power = powers[pushing].sum().double() / 3.0
    return (prior_sigma_m**2 / power).repeat(len(powers))


def condition(
    tangent: Tangent, observed: ObservedNodes, errors: Errors, variances: Variances, updates: int
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
    offset = tangent.offset.index_select(0, observed.nodes)
    shifted = observed.normal @ offset
    # The products are in double precision: G is as large as the square of the signal over the noise.
    response = _response(tangent, observed.nodes)
    gram, right = _normal_equations(response, errors, observed.normal, observed.right - shifted)
    power = observed.power + float((offset * (shifted - 2.0 * observed.right)).sum())
    limits = LEAST_FIELD_SIGMA_M**2, errors.most_fields
    amplitudes = determine_relevance(gram, right, variances, errors.field_values, updates, *limits, power)
    return amplitudes, amplitudes.log_evidence(power)


def _normal_equations(
    response: Tensor, errors: Errors, normal: Tensor, right: Tensor
) -> tuple[Tensor, Tensor]:
    """Return J^T S^-1 J, (r, r), and J^T S^-1 y, (r,), of the fields, the loads and the nuisance parameters.

    Parameters
    ----------
    response : (s, 3, 3 p) float32
        J of the loads.
    normal : (s, s)
    right : (s, 3)
    """
    columns, further = errors.columns, [] if errors.slide is None else [errors.slide]
    direct = torch.cat([*further, response, errors.nuisance], dim=2)
    count, _, width = direct.shape
    flat = direct.reshape(3 * count, width)
    weighted = normal @ direct.reshape(count, 3 * width)
    begin = sum(errors.field_values) - (0 if errors.slide is None else errors.slide.shape[2])
    gram = right.new_empty(begin + width, begin + width)
    symmetric_product(flat, weighted.reshape(3 * count, width), gram[begin:, begin:])
    if not columns.shape[1]:
        return gram, flat.T @ right.reshape(-1)
    # What a field moves along one axis tells nothing of another one.
    axes = torch.eye(3, dtype=columns.dtype, device=columns.device)
    alone = torch.kron(columns.T @ (normal @ columns), axes)
    mixed = (columns.T @ weighted).reshape(len(alone), width)
    told = (columns.T @ right).reshape(-1)
    if errors.ray is not None:
        # Its part of each axis' field: nothing new is to be summed up.
        ray = torch.kron(torch.eye(columns.shape[1], dtype=columns.dtype, device=columns.device), errors.ray)
        whole = torch.cat([ray, torch.eye(len(alone), dtype=columns.dtype, device=columns.device)])
        alone, mixed, told = whole @ alone @ whole.T, whole @ mixed, whole @ told
    gram[:begin, :begin], gram[:begin, begin:], gram[begin:, :begin] = alone, mixed, mixed.T
    return gram, torch.cat([told, flat.T @ right.reshape(-1)])


def symmetric_product(left: Tensor, right: Tensor, out: Tensor | None = None) -> Tensor:
    """Return left^T right, (w, w), which is known to be symmetric: half of it is mirrored."""
    width = left.shape[1]
    found = left.new_empty(width, width) if out is None else out
    for begin in range(0, width, _BLOCK_COLUMNS):
        block = slice(begin, begin + _BLOCK_COLUMNS)
        part = left[:, begin:].T @ right[:, block]
        found[begin:, block] = part
        found[block, begin:] = part.T
    return found


def mean_displacement(tangent: Tangent, amplitudes: Amplitudes) -> Tensor:
    """Posterior mean at the nodes, (n, 3) float64 m."""
    moved = tangent.response @ amplitudes.loads.float()
    return tangent.offset + moved.double().reshape(-1, 3)


def standard_deviation(tangent: Tangent, amplitudes: Amplitudes, moving: Tensor | None = None) -> Tensor:
    """Root mean square of the three components' posterior standard deviations at the nodes, (n,) float64 m.

    Parameters
    ----------
    tangent : Tangent
    amplitudes : Amplitudes
    moving : (n, 3, k) float64 m or None
        Displacement of the nodes by each nuisance parameter; None where these do not move the organ.
    """
    # Single precision is plenty for a standard deviation.
    root, response = amplitudes.root, tangent.response
    if moving is not None:
        root = torch.cat([root, root.new_ones(moving.shape[2])])
        response = torch.cat([response, moving.flatten(0, 1).float()], dim=1)
    count = len(root)
    inverse = invert_lower(amplitudes.loads_factor)[:, :count]
    half = inverse.float() * root.float()  # L^-1 D, as triangular as L
    variance = torch.zeros(len(tangent.state), device=half.device)
    for begin in range(0, len(half), _BLOCK_ROWS):
        end = min(begin + _BLOCK_ROWS, len(half))
        loads = min(end, count)
        part = response[:, :loads] @ half[begin:end, :loads].T
        variance += part.square().view(-1, 3 * (end - begin)).sum(dim=1)
    return (variance / 3.0).sqrt().double()


def _response(tangent: Tangent, nodes: Tensor) -> Tensor:
    """Displacement of nodes (s,) by unit loads, (s, 3, 3 p) float32."""
    by_node = tangent.response.view(len(tangent.state), 3, -1)
    return by_node.index_select(0, nodes)
