"""Why an answer must not be relied on, from what the posterior found out about the observation: one place for all."""

import numpy as np

from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody
from softtissue_estimator.estimators.elastic.plausibility import (
    has_implausible_elements,
    is_implausible_displacement,
)
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.solver import LOST_TRACK_MISFIT_M
from softtissue_estimator.organ.mesh import FloatArray

MOST_OUTLIERS = 0.25
"""Share of the points that may be torn off the surface: with more, the rest may be the wrong part."""
MOST_SHARED_ERROR_M = 0.0015
"""Standard deviation of the error that neighbouring points share: more than sensors and trackers that work have."""
MOST_SQUARED_ERRORS = 16.8
"""Of the registration's six errors over the variances that are expected at worst, summed: the 99th percentile."""


def doubts(
    posterior: Posterior,
    body: HyperelasticBody,
    observed: FloatArray,
    unexplained: float,
    expected: RegistrationError,
    outlier_share: float,
    lost: bool,
) -> tuple[str, ...]:
    """Return why an answer must not be relied on, a sentence each.

    Parameters
    ----------
    posterior : Posterior
    body : HyperelasticBody
    observed : (c, 3) m
        Displacement of what is seen.
    unexplained : float
        What the posterior and the noise leave of it, m.
    expected : RegistrationError
        What is supposed of a registration at worst.
    outlier_share : float
        Of the points, 0 to 1.
    lost : bool
        Whether the organ could not be followed to where it is seen.
    """
    found: list[str] = []
    if outlier_share > MOST_OUTLIERS:
        found.append(
            f"observation: expected one continuous surface, got {100.0 * outlier_share:.0f} % of the points torn off it"
        )
    if lost:
        found.append("observation: expected the organ near where it was, got one that was answered anew")
    if unexplained > LOST_TRACK_MISFIT_M:
        found.append(
            f"observation: expected an organ that bends, got {1e3 * unexplained:.1f} mm that no load explains"
        )
    shared = float(posterior.amplitudes.prior.field.sqrt())
    if shared > MOST_SHARED_ERROR_M:
        found.append(
            f"observation: expected neighbouring points to agree, got errors of {1e3 * shared:.1f} mm that they share"
        )
    found += _registration_doubts(posterior.registration_after, expected)
    if has_implausible_elements(body, posterior.mean):
        found.append("estimate: expected tissue that holds together, got elements that are torn or inverted")
    if is_implausible_displacement(posterior.mean, observed):
        found.append("estimate: expected hidden parts to move like what is seen, got some that move far more")
    return tuple(found)


def _registration_doubts(known: RegistrationError, expected: RegistrationError) -> list[str]:
    translation = known.correction.apply(known.centre[None])[0] - known.centre
    error = np.concatenate([translation, known.correction.rotation_vector])
    squared = float(np.square(np.linalg.solve(expected.root, error)).sum())
    if squared <= MOST_SQUARED_ERRORS:
        return []
    off_m, off_rad = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    return [
        f"registration: expected one that is nearly right, got one off by {1e3 * off_m:.0f} mm"
        f" and {np.degrees(off_rad):.0f} degrees"
    ]
