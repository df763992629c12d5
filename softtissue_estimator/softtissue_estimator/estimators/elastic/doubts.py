"""Why an answer must not be relied on, or not be given at all, from what the posterior found out: one place for all."""

from dataclasses import dataclass

import numpy as np

from softtissue_estimator.estimators.diagnosis import RegistrationEstimate
from softtissue_estimator.estimators.elastic.plausibility import (
    MOST_DISPLACEMENT_RATIO,
    is_implausible_displacement,
)
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.solver import LOST_TRACK_MISFIT_M
from softtissue_estimator.organ.mesh import FloatArray

MOST_OUTLIERS = 0.25
"""Share of the points that may be torn off the surface: with more, the rest may be the wrong part."""
MOST_SHARED_ERROR_M = 0.0012
"""Root mean square of an error that neighbouring points share, of the sensor or of matches that slid: more than those
that work have."""
MOST_SQUARED_ERRORS = 16.8
"""Of the registration's six errors over the variances that are expected at worst, summed: the 99th percentile."""

LEAST_SHOWN = 0.05
"""Share of the organ's surface. A cloud that shows less fits anything, unless it fits an organ that bends closely."""
LEAST_SHOWN_OF_BEFORE = 0.15
"""Share of what earlier clouds showed, below which an organ is no longer followed."""
LEAST_SHOWN_AGAIN = 0.25
"""The same of an organ that was lost: what is around it may look a little like it."""
LEAST_SHOWN_WHERE_IT_WAS = 0.75
"""The same of an organ that was lost and is found without having moved."""


@dataclass(frozen=True)
class Shown:
    """How much of an organ a cloud shows, of which nobody says what each of its points is.

    Attributes
    ----------
    patches : int
        On the organ.
    share : float
        Of its surface, 0 to 1.
    before : float
        Patches of the clouds before, while the organ was followed; 0 where it was not.
    """

    patches: int
    share: float
    before: float


def disbelief(posterior: Posterior, unexplained: float, shown: Shown) -> str:
    """Return why an answer that starts anew is not about the organ, a sentence; empty where it may be.

    A bare cloud may show anything, and an organ that is allowed to bend fits a little of everything.

    Parameters
    ----------
    posterior : Posterior
    unexplained : float
        What the posterior and the noise leave of what is seen, m.
    shown : Shown
    """
    if shown.patches < LEAST_SHOWN_AGAIN * shown.before:
        return (
            f"cloud: expected the organ, got {shown.patches} cells of 5 mm that may be on it where"
            f" {shown.before:.0f} were; it is looked for"
        )
    if shown.before == 0.0 and shown.share >= LEAST_SHOWN:
        return ""
    said = "cloud: expected the organ, got a surface that"
    if unexplained > LOST_TRACK_MISFIT_M:
        return f"{said} does not fit it, by {1e3 * unexplained:.1f} mm; it is looked for"
    if not posterior.plausible or is_implausible_displacement(
        posterior.mean, posterior.observed.displacement
    ):
        return f"{said} it fits only where it is torn or moves far more than what is seen; it is looked for"
    return ""


@dataclass(frozen=True)
class Troubles:
    """What a stream of observations has shown until now.

    Attributes
    ----------
    lost : bool
        Whether the organ could not be followed to where it is seen.
    surprised : bool
        Whether what is seen has not been as expected for some time.
    registration_moved : bool
        Whether the registration has moved since it was learnt.
    """

    lost: bool = False
    surprised: bool = False
    registration_moved: bool = False


def doubts(
    posterior: Posterior,
    observed: FloatArray,
    unexplained: float,
    registration: RegistrationEstimate,
    expected: RegistrationError,
    outlier_share: float,
    troubles: Troubles,
) -> tuple[str, ...]:
    """Return why an answer must not be relied on, a sentence each.

    Parameters
    ----------
    posterior : Posterior
    observed : (c, 3) m
        Displacement of what is seen.
    unexplained : float
        What the posterior and the noise leave of it, m.
    registration : RegistrationEstimate
    expected : RegistrationError
        What is supposed of a registration at worst.
    outlier_share : float
        Of the points, 0 to 1.
    troubles : Troubles
    """
    found: list[str] = []
    if outlier_share > MOST_OUTLIERS:
        found.append(
            f"observation: expected one continuous surface, got {100.0 * outlier_share:.0f} % of the points torn off it"
        )
    if troubles.lost:
        found.append("observation: expected the organ near where it was, got one that was answered anew")
    if troubles.surprised:
        found.append(
            "observation: expected about what the answers before let expect, got"
            f" {posterior.innovation:.1f} times its standard deviation, and that for a second"
        )
    if unexplained > LOST_TRACK_MISFIT_M:
        found.append(
            f"observation: expected an organ that bends, got {1e3 * unexplained:.1f} mm that no load explains"
        )
    fields = posterior.amplitudes.prior.fields
    shared = float((fields * fields.new_tensor(posterior.observed.field_components)).sum().sqrt())
    if shared > MOST_SHARED_ERROR_M:
        found.append(
            f"observation: expected neighbouring points to agree, got errors of {1e3 * shared:.1f} mm that they share"
        )
    found += _registration_doubts(registration, expected, troubles.registration_moved)
    if posterior.contested:
        found.append(
            "observation: expected what fits an organ held and registered as told, got what fits another better"
        )
    if posterior.attachment_moves:
        found.append("organ: expected what holds it to stay where it is, got an attachment that moves")
    if not posterior.plausible:
        found.append("estimate: expected tissue that holds together, got elements that are torn or inverted")
    if is_implausible_displacement(posterior.mean, observed, MOST_DISPLACEMENT_RATIO):
        found.append("estimate: expected hidden parts to move like what is seen, got some that move far more")
    return tuple(found)


def _registration_doubts(found: RegistrationEstimate, expected: RegistrationError, moved: bool) -> list[str]:
    wrong = float(np.square(np.linalg.solve(expected.root, found.step)).sum()) > MOST_SQUARED_ERRORS
    if not (wrong or moved):
        return []
    return [
        f"registration: expected one that {'is nearly right' if wrong else 'stays what it is'}, got one off by"
        f" {1e3 * found.translation_m:.0f} mm and {np.degrees(found.rotation_rad):.0f} degrees"
        f"{'' if wrong else ' by now'}"
    ]
