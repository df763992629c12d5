"""Explain an observation without knowing anything from before."""

from dataclasses import replace

import numpy as np

from softtissue_estimator.estimators.elastic.load_sets import draw_load_sets
from softtissue_estimator.estimators.elastic.posterior import Posterior, rival_variance
from softtissue_estimator.estimators.elastic.registration_scale import (
    comparable,
    explained,
    settled,
)
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.estimators.elastic.suppositions import LEAST_GAIN_OF_MOVING

MOST_RATIO_CHANGES = 2
"""Of Poisson's ratio: each makes a step, and one more for every ratio that is tried."""
LEAST_GAIN_OF_SHIFT = 2.0
"""Which gain of the log-evidence over an error with a turn shows a registration that is shifted alone: most are not."""


def solve(solver: Solver) -> Posterior:
    """Return the posterior of what a solver observes, with the likeliest registration, attachment and ratio."""
    solver, posterior = _likeliest(solver)
    posterior = settled(solver, posterior)
    for _ in range(MOST_RATIO_CHANGES):
        before, posterior = posterior.ratio, _improve_by_choice(solver, posterior)
        if posterior.ratio == before:
            break
    # Pairs say which loads act, and the wide motion of an organ that is attached nowhere is all of its doubt.
    return _weighed(solver, posterior) if solver.held and not solver.identified else posterior


def _weighed(solver: Solver, posterior: Posterior) -> Posterior:
    """Return a posterior with what is known where any set of loads may act, not only the relevant ones."""
    equal = solver.prior.variances(posterior.tangent, posterior.observed.nodes)
    acting = len(equal) if posterior.attachment_moves else solver.prior.pushing
    farthest = posterior.tangent.largest_powers()
    return replace(posterior, load_sets=draw_load_sets(posterior.amplitudes, equal, farthest, acting))


def _likeliest(solver: Solver) -> tuple[Solver, Posterior]:
    """Return the likeliest posterior with a registration of any size of error, of an organ that is held as told or not.

    Either explains what is seen of the other: only all of them together can be told apart. The others are part of its
    standard deviation. The solver goes on with what is supposed.
    """
    sizes = [(solver.registration.scaled(scale), 0.0) for scale in solver.registration.scales]
    if len(sizes) > 1:
        sizes.append((solver.registration.shifted, LEAST_GAIN_OF_SHIFT))
    candidates = [
        (solver.supposing(moves), registration, cost + LEAST_GAIN_OF_MOVING * moves)
        for moves in ((False, True) if solver.held else (False,))
        for registration, cost in sizes
    ]
    found = [explained(supposing, registration) for supposing, registration, _ in candidates]
    worth = np.subtract(comparable(solver, found), [cost for _, _, cost in candidates])
    best = int(worth.argmax())
    rivals = rival_variance(found[best].mean, [each.mean for each in found], list(worth - worth[best]))
    return candidates[best][0], replace(found[best], rival_variance=rivals)


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
