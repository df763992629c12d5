"""What else may explain an observation: a registration that has moved, an organ that is not held where was told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.leading_loads import leading_loads
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.solver import Solver

DRIFT_SHARE = 0.3  # how far a registration may have moved unnoticed, over the largest error that is expected
LEAST_GAIN = 3.0
"""Which gain of the log-evidence over all that is simpler shows that the registration has moved, and more than that."""
LEAST_GAIN_OF_MOVING = 6.0
"""Which gain over an attachment that stays where it is shows that it moves. Of twelve moving organs of a training
seed exact streams and those with a registration that is 5 degrees and 10 mm off gain 4.1 at most, of eight tries
each; what is attached elsewhere gains 14 to 160, but for one organ of six that only seems to drift. Of 14 single frames
that were told right none gained more than 0.4, and 10 that are attached elsewhere gained 9 to 53."""


@dataclass(frozen=True, eq=False)
class Supposition:
    """What may be wrong.

    Attributes
    ----------
    registration : RegistrationError
        What is known of it.
    attachment_moves : bool
        Whether what holds the organ moves.
    least_gain : float
        Of the log-evidence over what was supposed until now, with which it is believed.
    """

    registration: RegistrationError
    attachment_moves: bool
    least_gain: float = 0.0


def revised(
    solver: Solver, posterior: Posterior, registration: RegistrationFilter, *, constant: bool = False
) -> Posterior:
    """Suppose that the registration has moved since it was learnt or that what holds the organ moves, if likelier.

    Or that what holds it does not move after all.

    Parameters
    ----------
    solver : Solver
    posterior : Posterior
    registration : RegistrationFilter
    constant : bool
        Whether it is too early to say that the registration has moved: what looks like that is left as it is.
    """
    known, moves = posterior.registration, posterior.attachment_moves
    wider = known.widened(registration.expected.scaled(DRIFT_SHARE))
    suppositions = [Supposition(known, moves), Supposition(wider, moves, LEAST_GAIN)]
    if moves:
        suppositions.append(Supposition(known, False, LEAST_GAIN))
    elif _held(solver, posterior):
        # The registration may have been thought to move for the same reason.
        suppositions.append(Supposition(registration.unmoved, True, LEAST_GAIN_OF_MOVING))
    shown = _likeliest(solver, posterior, suppositions)
    if constant and shown.registration is wider:
        return posterior
    return _supposing(solver, posterior, shown)


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
    suppositions = [Supposition(known, False), Supposition(known, True, LEAST_GAIN_OF_MOVING)]
    shown = _likeliest(solver, posterior, suppositions)
    return solver.supposing(shown.attachment_moves), _supposing(solver, posterior, shown)


def likeliest_scale(solver: Solver, posterior: Posterior) -> float:
    """Return how far the registration may be off, over what a posterior with all loads supposes, by the evidence."""
    known, moves = posterior.registration, posterior.attachment_moves
    if len(known.scales) == 1:
        return known.scales[0]
    suppositions = [Supposition(known.scaled(scale), moves) for scale in known.scales]
    return known.scales[int(np.argmax(_evidence(solver, posterior, suppositions)))]


def decided(evidence: list[float], least_gains: list[float]) -> int:
    """Return the number of the supposition that the log-evidence of each shows, from what was supposed until now on.

    Each needs its own gain over the first, and `LEAST_GAIN` over any other that is believed before it.
    """
    best = 0
    for number, (value, least_gain) in enumerate(zip(evidence, least_gains, strict=True)):
        if value >= evidence[0] + least_gain and (not best or value >= evidence[best] + LEAST_GAIN):
            best = number
    return best


def _likeliest(solver: Solver, posterior: Posterior, suppositions: list[Supposition]) -> Supposition:
    """Return the supposition that the observation shows; the first is the posterior's own."""
    evidence = _evidence(solver, posterior, suppositions)
    return suppositions[decided(evidence, [each.least_gain for each in suppositions])]


def _evidence(solver: Solver, posterior: Posterior, suppositions: list[Supposition]) -> list[float]:
    """Return the log-evidence of the observation with each supposition.

    Loads that have become relevant meanwhile explain much of what else may be supposed: each begins without them. Some
    dozens of loads are enough to choose.
    """
    few = _leading(solver, posterior)
    part = posterior.with_loads(few)
    return [
        solver.afresh(part, each.registration, each.attachment_moves, few).log_evidence
        for each in suppositions
    ]


def _supposing(solver: Solver, posterior: Posterior, shown: Supposition) -> Posterior:
    """Return a posterior with what was shown: itself where it supposes that already."""
    if shown.registration is posterior.registration and shown.attachment_moves == posterior.attachment_moves:
        return posterior
    return solver.afresh(posterior, shown.registration, shown.attachment_moves)


def _held(solver: Solver, posterior: Posterior) -> bool:
    return solver.prior.pushing < len(posterior.amplitudes.variances)


def _leading(solver: Solver, posterior: Posterior) -> Tensor:
    """Return the numbers of the loads that tell suppositions apart, (k,): those that matter and all behind."""
    equal = solver.prior.variances(posterior.tangent, posterior.observed.nodes)
    leading = leading_loads(posterior.amplitudes.variances, equal, posterior.amplitudes.loads_gram)
    behind = torch.arange(solver.prior.pushing, len(equal), device=leading.device)
    return torch.cat([leading[leading < solver.prior.pushing], behind])
