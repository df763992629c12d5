"""Explain an observation without knowing anything from before."""

from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_scale import explained, likeliest, settled
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.estimators.elastic.suppositions import freed

MOST_RATIO_CHANGES = 2
"""Of Poisson's ratio: each makes a step, and one more for every ratio that is tried."""


def solve(solver: Solver) -> Posterior:
    """Return the posterior of what a solver observes, with the likeliest registration, attachment and ratio."""
    registration = solver.registration
    found = [explained(solver, registration, scale) for scale in registration.scales]
    solver, posterior = freed(solver, settled(solver, likeliest(solver, found)))
    for _ in range(MOST_RATIO_CHANGES):
        before, posterior = posterior.ratio, _improve_by_choice(solver, posterior)
        if posterior.ratio == before:
            break
    return posterior


def _improve_by_choice(solver: Solver, posterior: Posterior) -> Posterior:
    """Make one more step with every Poisson's ratio towards which the observation becomes more likely."""
    best = solver.improve(posterior, guarded=True)
    tried = {best.ratio}
    for direction in (1, -1):
        while best.ratio + direction in solver.ratios - tried:
            ratio = best.ratio + direction
            other = solver.improve(posterior, guarded=True, ratio=ratio)
            tried.add(ratio)
            if other.log_evidence <= best.log_evidence:
                break
            best = other
    return best
