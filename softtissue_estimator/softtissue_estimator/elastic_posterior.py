"""A Gaussian process over displacements whose covariance is linear elasticity.

Unknown smooth forces on the surface of a coarse, linear elastic mesh make the prior: f ~ N(0, s^2 G (x) I_3),
G_ij = exp(-|x_i - x_j|^2 / (2 l^2)) sqrt(A_i A_j), A the nodes' surface areas. Displacements u = K^-1 f then have
the covariance P = s^2 K^-1 (G (x) I) K^-T. Two things make a frame cheap. P is replaced by its leading modes,
P = s^2 B B^T with B (3 n, r), found once for an organ; the unknowns are then the r amplitudes z ~ N(0, s^2 I). And
an observation enters only through H^T S^-1 H, as large as the mesh whatever the number of points. So

    (I / s^2 + B^T (H^T S^-1 H (x) I_3) B) z = B^T H^T S^-1 y,    w = B z,

takes one Cholesky factorisation of r x r.

Attached surface is held by stiff springs, which sees an attached region finer than the coarse mesh does and needs
no node exactly on its edge. The springs' rest positions follow an affine field where the frame of reference moves
(`AffineLift`).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, eigh, solve_triangular
from scipy.linalg.lapack import dtrtri
from scipy.sparse import csr_array, diags_array, kron
from scipy.sparse.linalg import splu

from softtissue_estimator.elasticity import nodal_areas, stiffness
from softtissue_estimator.errors import OrganError
from softtissue_estimator.mesh import FloatArray, IntArray
from softtissue_estimator.volume_mesh import VolumeMesh

CORRELATION_LENGTH_M = 0.015
SPRING_LENGTH_M = 0.002  # the springs are as stiff as the organ itself at this thickness
_GROUND_SHARE_HELD = 1e-5
_GROUND_SHARE_FREE = 0.03
_SCALE_ITERATIONS = 3
_SCALE_BELIEF = 3.0


@dataclass(frozen=True, eq=False)
class ElasticPrior:
    """What is known of an organ's displacement before anything is seen.

    Parameters
    ----------
    modes : (n, 3, r)
        B: nodal displacement of each mode, scaled so that z ~ N(0, I) gives a mean variance of one.
    lift : (n, 3, 12)
        Nodal displacement when the springs' rest positions are displaced by each of the twelve affine fields: the
        component a of the displacement equal to 1, x, y or z (about `centre`); column 3 k + a.
    nodes : (n, 3) m
    kept : float
        Share of the prior's variance that the modes hold.
    """

    modes: FloatArray
    lift: FloatArray
    nodes: FloatArray
    kept: float

    @cached_property
    def centre(self) -> FloatArray:
        """Mean of the nodes, (3,) m."""
        return np.asarray(self.nodes.mean(axis=0), dtype=np.float64)

    @cached_property
    def motions(self) -> FloatArray:
        """Nodal displacement of three translations and three infinitesimal rotations, (n, 3, 6)."""
        axes = np.eye(3)
        turns = np.cross(axes, (self.nodes - self.centre)[:, None])
        moves = np.broadcast_to(axes, (len(self.nodes), 3, 3))
        # About as large as the moves, so that sums of products of both are well conditioned.
        size = float(np.abs(self.nodes - self.centre).max())
        return np.concatenate([moves, np.swapaxes(turns, 1, 2) / size], axis=2)

    @cached_property
    def single(self) -> NDArray[np.float32]:
        """The modes in single precision."""
        return self.modes.astype(np.float32)

    def lifted(self, linear: FloatArray, constant: FloatArray) -> FloatArray:
        """Nodal displacement (n, 3) m when the springs rest at x + linear (x - centre) + constant."""
        coefficients = np.concatenate([constant[:, None], linear], axis=1).T.ravel()
        return np.asarray(self.lift @ coefficients)


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is known after an observation.

    Parameters
    ----------
    mean : (n, 3) m
        Nodal displacement w.
    factor : (r, r)
        Lower Cholesky factor of the amplitudes' precision.
    """

    mean: FloatArray
    factor: FloatArray


def build_prior(
    mesh: VolumeMesh, attached: csr_array, attached_areas: FloatArray, poisson_ratio: float, modes: int
) -> ElasticPrior:
    """Compute the modes of the prior; a second or two.

    Weak springs between the organ and its surroundings keep rigid motions finite. Where nothing is attached they
    are all that does; an organ then follows the rigid motion of what is seen, and bends as softly as it may.

    Parameters
    ----------
    mesh : VolumeMesh
    attached : (a, n) sparse
        Interpolation from the nodes to points of the attached surface; a may be 0.
    attached_areas : (a,) m^2
        Area that each of those points stands for.
    poisson_ratio : float
    modes : int
        Most modes to keep.

    Raises
    ------
    OrganError
        If the stiffness cannot be factorised.
    """
    count = len(mesh.nodes)
    centre = mesh.nodes.mean(axis=0)
    springs = csr_array(attached.T @ attached.multiply(attached_areas[:, None] / SPRING_LENGTH_M))
    ground = _GROUND_SHARE_HELD if attached.shape[0] else _GROUND_SHARE_FREE
    # Per volume, Young's modulus over the square of the organ's size is the stiffness of the organ itself.
    surroundings = _nodal_volumes(mesh) * (ground / mesh.volumes.sum() ** (2.0 / 3.0))
    held = stiffness(mesh, poisson_ratio) + kron(csr_array(springs + diags_array(surroundings)), np.eye(3))
    try:
        # Symmetric: the ordering is that of a Cholesky factorisation, and the pivots stay on the diagonal.
        factor = splu(
            held.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0
        )
    except RuntimeError as error:
        raise OrganError(
            "elastic model: expected a stiffness that can be factorised, got a singular one"
        ) from error
    response = factor.solve(np.kron(_force_modes(mesh), np.eye(3)))
    share = np.repeat(_nodal_volumes(mesh) / mesh.volumes.sum(), 3)
    variance, vectors = eigh((response * share[:, None]).T @ response)
    leading = np.argsort(variance)[::-1][:modes]
    basis = (response @ vectors[:, leading]) / np.sqrt(variance.sum() / 3.0)
    positions = np.column_stack([np.ones(count), mesh.nodes - centre])
    lift = factor.solve(np.kron(springs @ positions, np.eye(3)))
    return ElasticPrior(
        modes=np.ascontiguousarray(basis.reshape(count, 3, -1)),
        lift=lift.reshape(count, 3, 12),
        nodes=mesh.nodes,
        kept=float(variance[leading].sum() / variance.sum()),
    )


def _force_modes(mesh: VolumeMesh) -> FloatArray:
    """Square root of G, (n, k): its eigenvectors scaled by the roots of the eigenvalues that matter."""
    areas = nodal_areas(mesh)
    surface = np.flatnonzero(areas > 0.0)
    points = mesh.nodes[surface]
    squared = ((points[:, None] - points) ** 2).sum(axis=2)
    root = np.sqrt(areas[surface])
    values, vectors = eigh(np.exp(-squared / (2.0 * CORRELATION_LENGTH_M**2)) * root[:, None] * root)
    strong = values > 1e-4 * values[-1]
    modes = np.zeros((len(mesh.nodes), int(strong.sum())))
    modes[surface] = vectors[:, strong] * np.sqrt(values[strong])
    return modes


def _nodal_volumes(mesh: VolumeMesh) -> FloatArray:
    share = np.repeat(mesh.volumes / 4.0, 4)
    return np.bincount(mesh.tets.ravel(), weights=share, minlength=len(mesh.nodes)).astype(np.float64)


def condition(
    prior: ElasticPrior,
    interpolation: csr_array,
    observed: FloatArray,
    precision: FloatArray,
    prior_sigma_m: float,
) -> Posterior:
    """Condition the prior on observed displacements.

    The scale s of the forces is not known beforehand. It starts where the observed points are expected to move
    `prior_sigma_m` beyond a rigid motion, and is then re-estimated from the data (MacKay's evidence iteration,
    s^2 = |z|^2 / gamma, gamma the number of well-determined amplitudes); the start counts as `_SCALE_BELIEF` further
    amplitudes.

    Parameters
    ----------
    prior : ElasticPrior
    interpolation : (c, n) sparse
        H for one component.
    observed : (c, 3) m
    precision : (c,) 1/m^2
        Inverse variance of each component of `observed`.
    prior_sigma_m : float
    """
    weighted = csr_array(interpolation.multiply(precision[:, None]))
    seen = np.unique(interpolation.indices).astype(np.int64)
    count, _, rank = prior.modes.shape
    part = prior.modes[seen]
    normal = csr_array(interpolation.T @ weighted)[seen][:, seen]
    spread = (normal @ part.reshape(len(seen), 3 * rank)).reshape(-1, rank)
    flat = part.reshape(-1, rank)
    information = flat.T @ spread
    right = flat.T @ np.asarray((weighted.T @ observed)[seen]).ravel()
    start = prior_sigma_m**2 / _variance_beyond_rigid(prior, seen, normal, spread, information)
    scale = start
    for _ in range(_SCALE_ITERATIONS):
        factor, amplitudes = _solve(information, right, scale)
        inverse, _ = dtrtri(factor, lower=1)
        determined = rank - float(np.einsum("ij,ij->", inverse, inverse)) / scale
        scale = (float(amplitudes @ amplitudes) + _SCALE_BELIEF * start) / (determined + _SCALE_BELIEF)
    factor, amplitudes = _solve(information, right, scale)
    mean = np.asarray(prior.modes.reshape(-1, rank) @ amplitudes).reshape(count, 3)
    return Posterior(mean, factor)


def _variance_beyond_rigid(
    prior: ElasticPrior, seen: IntArray, normal: csr_array, spread: FloatArray, information: FloatArray
) -> float:
    """Mean prior variance at s = 1 of the observed points, each with its weight, their best rigid motion taken out.

    tr(B^T M B) / 3 tr(M) without the part in the span of R, M = H^T S^-1 H and R the six infinitesimal rigid
    motions of the nodes, which H interpolates exactly.
    """
    motions = prior.motions[seen].reshape(-1, 6)
    weighted = np.asarray(normal @ prior.motions[seen].reshape(len(seen), 18)).reshape(-1, 6)
    shared = motions.T @ spread
    gram = motions.T @ weighted
    gram[np.diag_indices(6)] += 1e-9 * np.trace(gram)
    rigid = float(np.einsum("ir,ir->", shared, np.linalg.solve(gram, shared)))
    total = float(np.trace(information))
    # Three points and fewer can leave nothing beyond a rigid motion.
    return max(total - rigid, 1e-6 * total) / (3.0 * float(normal.sum()))


def _solve(information: FloatArray, right: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Factorise `information + I / scale` and solve, (r, r) lower triangle and (r,)."""
    precision = information.copy()
    precision[np.diag_indices(len(right))] += 1.0 / scale
    factor = cholesky(precision, lower=True, overwrite_a=True, check_finite=False)
    half = solve_triangular(factor, right, lower=True, check_finite=False)
    return factor, solve_triangular(factor, half, lower=True, trans=1, check_finite=False)


def standard_deviation(prior: ElasticPrior, posterior: Posterior) -> FloatArray:
    """Root mean square of the three components' posterior standard deviations at the nodes, (n,) m."""
    count, _, rank = prior.modes.shape
    # Single precision is plenty for a standard deviation, and half the time.
    factor = posterior.factor.astype(np.float32)
    half = solve_triangular(factor, prior.single.reshape(-1, rank).T, lower=True, check_finite=False)
    variance = np.einsum("rk,rk->k", half, half).reshape(count, 3)
    return np.asarray(np.sqrt(variance.mean(axis=1)), dtype=np.float64)
