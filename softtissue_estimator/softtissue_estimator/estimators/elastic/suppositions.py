"""What else may explain an observation: a registration that has moved, an organ that is not held where was told."""

from __future__ import annotations

import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.leading_loads import leading_loads
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.solver import Solver

DRIFT_SHARE = 0.3  # how far a registration may have moved unnoticed, over the largest error that is expected
LEAST_GAIN = 3.0
"""Which gain of the log-evidence over all that is simpler shows a supposition. Chosen on three moving organs of a
training seed, where exact streams lose at least 1.3 and those that drift by 6 mm gain 5 to 140 in time, if what holds
moves at most 2.3 more; those that are attached elsewhere gain 15 to 330 by that, and 4 to 50 more than by a drift."""
LEAST_GAIN_ALONE = 6.0
"""The same for a frame alone, whose registration no frame before has shown. Of 14 organs of training seeds none that
was told right gained more than 0.4, and 10 that are attached elsewhere gained 9 to 53."""

Supposition = tuple[RegistrationError, bool]
"""What is known of the registration, and whether what holds the organ moves."""


def revised(solver: Solver, posterior: Posterior, registration: RegistrationFilter) -> Posterior:
    """Suppose that the registration has moved since it was learnt or that what holds the organ moves, if likelier."""
    known, moves = posterior.registration, posterior.attachment_moves
    suppositions = [(known, moves), (known.widened(registration.expected.scaled(DRIFT_SHARE)), moves)]
    if not moves and _held(solver, posterior):
        # The registration may have been thought to move for the same reason.
        suppositions.append((registration.unmoved, True))
    return _with_likeliest(solver, posterior, suppositions, LEAST_GAIN)


def freed(solver: Solver, posterior: Posterior) -> tuple[Solver, Posterior]:
    """Suppose, of an observation that is no part of a stream, that what holds the organ moves, if that is likelier.

    Returns
    -------
    solver : Solver
        That goes on with what is supposed.
    posterior : Posterior
    """
    if not _held(solver, posterior):
        return solver, posterior
    known = posterior.registration
    found = _with_likeliest(solver, posterior, [(known, False), (known, True)], LEAST_GAIN_ALONE)
    return solver.supposing(found.attachment_moves), found


def decided(evidence: list[float], least_gain: float) -> int:
    """Return the number of the supposition that the log-evidence of each, from the simplest on, shows."""
    best = 0
    for number, value in enumerate(evidence):
        if value >= evidence[best] + least_gain:
            best = number
    return best


def _with_likeliest(
    solver: Solver, posterior: Posterior, suppositions: list[Supposition], least_gain: float
) -> Posterior:
    """Return the posterior with the supposition that the observation shows; they begin with the posterior's own.

    Loads that have become relevant meanwhile explain much of what else may be supposed: each begins without them. Some
    dozens of loads are enough to choose.

    Parameters
    ----------
    solver : Solver
    posterior : Posterior
    suppositions : list of Supposition
        From the simplest on.
    least_gain : float
        Of the log-evidence over all that is simpler.
    """
    few = _leading(solver, posterior)
    part = posterior.with_loads(few)
    evidence = [solver.afresh(part, *supposition, few).log_evidence for supposition in suppositions]
    shown = decided(evidence, least_gain)
    return solver.afresh(posterior, *suppositions[shown]) if shown else posterior


def _held(solver: Solver, posterior: Posterior) -> bool:
    return solver.prior.pushing < len(posterior.amplitudes.variances)


def _leading(solver: Solver, posterior: Posterior) -> Tensor:
    """Return the numbers of the loads that tell suppositions apart, (k,): those that matter and all behind."""
    equal = solver.prior.variances(posterior.tangent, posterior.observed.nodes)
    leading = leading_loads(posterior.amplitudes.variances, equal, posterior.amplitudes.loads_gram)
    behind = torch.arange(solver.prior.pushing, len(equal), device=leading.device)
    return torch.cat([leading[leading < solver.prior.pushing], behind])
