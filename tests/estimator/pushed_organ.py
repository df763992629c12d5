"""Organs in equilibrium under a load, on the estimator's own mesh."""

import numpy as np
import torch

from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody
from softtissue_estimator.estimators.elastic.loads import load_basis
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.volume_mesh import VolumeMesh


def pushed(mesh: VolumeMesh, ratio: float, share: float = 1.0) -> FloatArray:
    """Nodal displacement (n, 3) m of an organ that is held at x < -0.055 m and pushed above, by a share of a force."""
    nodes = mesh.nodes
    loads = load_basis(mesh)
    upper = np.where(nodes[:, 0] > 0.03, nodes[:, 2], -1.0)
    force = loads[:, [loads[upper.argmax(), :-1].argmax()]] * np.multiply(share, [0.0, 0.3e-4, -0.4e-4])
    held = nodes[:, 0] < -0.055
    body = HyperelasticBody(mesh, np.diag(0.05 * held), np.eye(len(nodes)), torch.device("cpu"))
    state = rest = torch.zeros((len(nodes), 3), dtype=torch.float64)
    for _ in range(8):
        tangent = body.linearise(state, rest, ratio)
        moved = tangent.response @ torch.from_numpy(force).float().reshape(-1)
        state = tangent.offset + moved.double().reshape(-1, 3)
    return state.numpy()
