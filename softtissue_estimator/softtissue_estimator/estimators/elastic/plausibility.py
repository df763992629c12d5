"""Whether an answer can be believed: what no tissue endures, and what nothing observed suggests."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody
from softtissue_estimator.estimators.elastic.neo_hookean import determinant
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.organ.mesh import FloatArray

_MOST_STRETCH = 2.5  # several times what tears a liver
_IMPLAUSIBLE_VOLUME_SHARE = 0.002  # of the organ's; single small elements turn for a step and come back
LARGE_DISPLACEMENT_RATIO = 2.0
"""Over the largest observed displacement: hidden parts may move farther than visible ones, but a fit that moves them so
much farther must not be preferred for its closeness."""
MOST_DISPLACEMENT_RATIO = 5.0
"""The same, where an answer is not believed: hidden parts of one in a hundred simulated organs of a training seed, seen
to 10 to 40 %, move farther; those of one in eight move twice as far as anything seen."""
_RIGID_MODEL_SIGMA_M = 0.1
"""With so large an error of the model, hardly more than the rigid motion is left of the answer."""
_LARGE_MODEL_SIGMA_M = 0.01
"""Elements that are still implausible beyond this error may be so for another reason than too close a fit."""


def has_implausible_elements(body: HyperelasticBody, displacement: Tensor) -> bool:
    """Tell whether a displacement (n, 3) m does to more than a few elements what no tissue endures.

    They are inverted, or as long as an incompressible element that is stretched `_MOST_STRETCH` times.
    """
    gradient = body.deformation_gradient(displacement)
    inverted = determinant(gradient) < 0.0
    length = gradient.square().sum(dim=(1, 2))  # of the principal stretches, squared
    implausible = inverted | (length > _MOST_STRETCH**2 + 2.0 / _MOST_STRETCH)
    return bool(body.volumes[implausible].sum() > _IMPLAUSIBLE_VOLUME_SHARE * body.volumes.sum())


def is_implausible_displacement(
    displacement: Tensor, observed: FloatArray, most_ratio: float = LARGE_DISPLACEMENT_RATIO
) -> bool:
    """Tell whether a displacement (n, 3) m moves anything much farther than all that is observed, (c, 3) m."""
    farthest = float(torch.linalg.vector_norm(displacement, dim=1).max())
    return farthest > most_ratio * float(np.linalg.norm(observed, axis=1).max())


def plausible_fit(
    fit: Callable[[float], Posterior], model_sigma_m: float, body: HyperelasticBody, observed: FloatArray
) -> tuple[Posterior, bool]:
    """Fit with the least error of the model, from a given one on, that leaves the elements plausible.

    Where none does and the maximum-likelihood fit, that with the given error, moves nothing much farther than is
    observed, the organ is deformed so much that elements seem inverted: a larger error would only leave more
    unexplained.

    Parameters
    ----------
    fit : callable
        Takes the model's error, m, and returns the posterior with it.
    model_sigma_m : float
        The error to begin with, m.
    body : HyperelasticBody
    observed : (c, 3) m
        Observed displacement.

    Returns
    -------
    posterior : Posterior
    plausible : bool
        Whether the elements are.
    """
    sigma = model_sigma_m
    likeliest = posterior = fit(sigma)
    # Only loads that invert elements explain the observation so closely: the model is further off than it seems.
    while has_implausible_elements(body, posterior.mean):
        if sigma > _LARGE_MODEL_SIGMA_M and not is_implausible_displacement(likeliest.mean, observed):
            return likeliest, False
        if sigma >= _RIGID_MODEL_SIGMA_M:
            return posterior, False
        sigma *= 2.0
        posterior = fit(sigma)
    return posterior, True
