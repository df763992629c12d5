"""How exact the registration was: among several sizes of its error, the one that makes the observation likeliest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError

MOST_STEPS = 4  # that wait for the correction to settle
SETTLED_M = (
    0.0005  # a correction that moves by less changes what the organ's bending explains by a tenth of that
)


class Explaining(Protocol):
    """The steps of the solver that are needed here."""

    def start(self, registration: RegistrationError) -> Posterior:
        """See `Solver.start`."""

    def improve(self, posterior: Posterior, *, guarded: bool) -> Posterior:
        """See `Solver.improve`."""

    def again(self, posterior: Posterior, registration: RegistrationError, sigma: float) -> Posterior:
        """See `Solver.again`."""


def explained(solver: Explaining, registration: RegistrationError) -> Posterior:
    """Make two steps with what is supposed of the registration."""
    # The first step is large, and what it collapses comes back in the next.
    return solver.improve(solver.start(registration), guarded=False)


def likeliest(solver: Explaining, found: Sequence[Posterior]) -> Posterior:
    """Return the posterior of the observation with the largest evidence."""
    evidence = comparable(solver, found)
    return found[max(range(len(found)), key=evidence.__getitem__)]


def comparable(solver: Explaining, found: Sequence[Posterior]) -> list[float]:
    """Return the log-evidence of each of several posteriors of an observation, with the same error of the model.

    A larger one would excuse what is left unexplained.
    """
    sigma = min(posterior.model_sigma_m for posterior in found)
    return [
        posterior.log_evidence
        if posterior.model_sigma_m == sigma
        else solver.again(posterior, posterior.registration, sigma).log_evidence
        for posterior in found
    ]


def settled(solver: Explaining, posterior: Posterior) -> Posterior:
    """Make further steps until the registration's correction moves hardly more."""
    for _ in range(MOST_STEPS):
        if np.linalg.norm(posterior.registration_step[:3]) <= SETTLED_M:
            break
        posterior = solver.improve(posterior, guarded=True)
    return posterior
