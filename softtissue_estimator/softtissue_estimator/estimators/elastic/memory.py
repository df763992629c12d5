"""What is known of an organ between two frames of a stream, and of one that was lost."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic.doubts import (
    LEAST_SHOWN_OF_BEFORE,
    LEAST_SHOWN_WHERE_IT_WAS,
    Shown,
    disbelief,
)
from softtissue_estimator.estimators.elastic.posterior import Posterior, WarmStart
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.estimators.elastic.tangent import Tangent

_NEW_SHARE = 0.1  # of a frame, in how much is expected to be seen
_CANDIDATE_STEPS = 8  # of the thread, after which what was not the organ until then is not followed any more


@dataclass(frozen=True, eq=False)
class Memory:
    """What is known of an organ between two frames.

    Attributes
    ----------
    state : WarmStart or None
        About which the next observation is explained.
    rigid : bool
        Whether that is about a rigid motion, for want of a step of the thread.
    ratio : int or None
        Poisson's ratio, which survives a loss of track: the organ stays the same.
    settled : int
        Steps since the organ last moved.
    stepped_s : float
        Stamp of the newest observation that a step was made about.
    steps : int
        That the thread was given since it was about a rigid motion.
    mean : (n, 3) float64 m or None
        Displacement of the nodes in the newest answer.
    tangent : Tangent or None
        About which that answer was linear, by the loads of `state`; None where `state` is newer.
    patches : float
        Of the surface that were on the organ in the answers before.
    attachment_moves : bool
        Whether what holds the organ was seen to move.
    """

    state: WarmStart | None = None
    rigid: bool = False
    ratio: int | None = None
    settled: int = 0
    stepped_s: float = 0.0
    steps: int = 0
    mean: torch.Tensor | None = None
    tangent: Tangent | None = None
    patches: float = 0.0
    attachment_moves: bool = False


@dataclass(frozen=True, eq=False)
class Lost:
    """What was known of an organ when it could not be followed.

    Attributes
    ----------
    memory : Memory
    registration : RegistrationFilter
    believed : bool
        Whether an answer was given nevertheless, since it explained the observation from scratch.
    """

    memory: Memory
    registration: RegistrationFilter | None
    believed: bool = False


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of an organ and of its registration, and of one that was lost."""

    memory: Memory = Memory()
    registration: RegistrationFilter | None = None
    lost: Lost | None = None

    def as_lost(self) -> Lost:
        """Return what was known where the organ is lost now."""
        return Lost(self.memory, self.registration)

    def after(self, posterior: Posterior, still: bool, tangent: Tangent | None) -> Known:
        """Return what is known after an answer, in which the organ moved or stood still; `tangent` as in `Memory`."""
        patches = patches_of(posterior)
        memory = replace(
            self.memory,
            mean=posterior.mean,
            tangent=tangent,
            # The view may narrow as fast as this.
            patches=max(patches, (1.0 - _NEW_SHARE) * self.memory.patches + _NEW_SHARE * patches),
            settled=self.memory.settled if still else 0,
        )
        return replace(self, memory=memory)


def followed(solver: Solver, memory: Memory) -> Posterior | None:
    """Return `Solver.follow`; None too where next to nothing that was seen is near the organ where it was."""
    start = memory.state
    if start is None:
        return None
    try:
        tangent = start.tangent if memory.tangent is None else memory.tangent
        posterior = solver.follow(start, tangent, tangent.state if memory.mean is None else memory.mean)
    except InvalidInputError:
        return None
    if posterior is None or solver.identified:
        return posterior
    enough = patches_of(posterior) >= LEAST_SHOWN_OF_BEFORE * memory.patches
    return posterior if enough else None


def found_where_it_was(solver: Solver, lost: Lost) -> tuple[Solver, Posterior] | None:
    """Follow an organ from where it was lost; None where it is not there."""
    before = copy.copy(solver)
    if lost.registration is not None:
        before.registration = lost.registration.supposed
    posterior = followed(before, lost.memory)
    # Where only a part of it fits, the rest may have moved out of reach meanwhile.
    if posterior is None or patches_of(posterior) < LEAST_SHOWN_WHERE_IT_WAS * lost.memory.patches:
        return None
    return before, posterior


def followed_from(solver: Solver, known: Known) -> tuple[Solver, Posterior | None, Known]:
    """Follow an organ from what is known of it; also return with what solver, and what was right of what is known."""
    solver = solver.supposing(known.memory.attachment_moves)
    if known.lost is not None:
        # What nothing before suggests may have been wrong, or not the organ: it may be where it was.
        found = found_where_it_was(solver, known.lost)
        if found is not None:
            return *found, Known(known.lost.memory, known.lost.registration)
        if known.lost.believed:
            known = replace(known, lost=None)
        elif known.memory.steps > _CANDIDATE_STEPS:
            return solver, None, known
    return solver, followed(solver, known.memory), known


def reason_for_disbelief(solver: Solver, posterior: Posterior, lost: Lost) -> str:
    """Return why an answer that starts anew is not about the organ, a sentence; empty where it may be."""
    if solver.identified:
        return ""
    patches = patches_of(posterior)
    shown = Shown(patches, patches * solver.patch_share, lost.memory.patches)
    return disbelief(posterior, solver.unexplained(posterior), shown)


def patches_of(posterior: Posterior) -> int:
    """Return how many patches are on the organ."""
    return int(posterior.observed.counts.sum())
