"""Covariance of where points of the organ are, with the error of the registration that the same observation tells.

A material point x is, in the frame that the registration gives, at x + u(x) + J d (`registration_error`): what is seen
tells of the sum, so that displacement and error are correlated, and the sum is better known than both suggest.
"""

import numpy as np
import torch
from scipy.sparse import csr_array

from softtissue_estimator.estimators.elastic.own_motion import OwnMotion
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.organ.mesh import FloatArray


def joint_covariance(
    posterior: Posterior, interpolation: csr_array, positions: FloatArray, sigma: FloatArray
) -> FloatArray:
    """Return the covariance of where points are in the frame of the registration, (k, 3, 3) m^2, organ's axes.

    Parameters
    ----------
    posterior : Posterior
    interpolation : (k, n) sparse
        From the nodes to the points.
    positions : (k, 3) float64 m
        Where these are now.
    sigma : (k,) float64 m
        Standard deviation of each component of their displacement, as answered: also of the model's error and the like,
        which have no direction. Of an organ that is attached nowhere it holds the registration's error already.
    """
    if isinstance(posterior.registration, OwnMotion):
        return np.asarray(np.square(sigma)[:, None, None] * np.eye(3))
    both, alone = _of_loads(posterior, interpolation, positions)
    rest = np.square(sigma) - np.trace(alone, axis1=1, axis2=2) / 3.0
    return np.asarray(both + np.maximum(rest, 0.0)[:, None, None] * np.eye(3))


def _of_loads(
    posterior: Posterior, interpolation: csr_array, positions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return covariances by the loads and the registration's error, and by the loads alone, both (k, 3, 3) m^2."""
    amplitudes, tangent = posterior.amplitudes, posterior.tangent
    device = tangent.response.device
    weights = interpolation.tocsr()
    nodes, column = np.unique(weights.indices, return_inverse=True)
    dense = np.zeros((len(positions), len(nodes)))
    np.add.at(dense, (np.repeat(np.arange(len(positions)), np.diff(weights.indptr)), column), weights.data)
    by_node = tangent.response.view(len(tangent.state), 3, -1)
    chosen = by_node.index_select(0, torch.from_numpy(nodes.astype(np.int64)).to(device)).double()
    response = torch.einsum("kn,nap->kap", torch.from_numpy(dense).to(device), chosen)
    error = posterior.registration.columns(torch.from_numpy(positions).to(device))
    if posterior.load_sets is not None:
        sets, moved = posterior.load_sets, response.cpu().numpy()
        return sets.covariance(moved, error.cpu().numpy()), sets.covariance(moved)
    loads = response * amplitudes.root
    half = torch.linalg.solve_triangular(
        amplitudes.loads_factor,
        torch.cat(
            [
                torch.cat([loads, error], dim=2).reshape(3 * len(positions), -1),
                torch.cat([loads, torch.zeros_like(error)], dim=2).reshape(3 * len(positions), -1),
            ]
        ).T,
        upper=False,
    )
    columns = half.T.reshape(2, len(positions), 3, -1)
    both, alone = torch.einsum("skar,skbr->skab", columns, columns).cpu().numpy()
    return both, alone
