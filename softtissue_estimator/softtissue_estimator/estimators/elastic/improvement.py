"""One more step about an answered observation, with all loads: what the tracker's thread does between frames."""

from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from threading import Event

from softtissue_estimator.estimators.elastic.amplitudes import Variances
from softtissue_estimator.estimators.elastic.posterior import Posterior, WarmStart
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.registration_scale import explained, likeliest
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.estimators.elastic.suppositions import STEPS_BEFORE_BELIEF, revised
from softtissue_estimator.inference.device import one_thread

STEPS_PER_HIDDEN_VARIANCE = 3
"""Which changes slowly and takes as long as a fifth of a step."""
STEPS_PER_TRIAL = 2
"""One of so many asks what else may be wrong, which takes as long as a quarter of a step."""
STEPS_PER_RATIO_TRIAL = 4
"""One of so many looks at another Poisson's ratio, too."""
LEAST_LOG_EVIDENCE_GAIN = 1.0
"""From which on another ratio is taken: a smaller one may be noise."""
STEP_S = 0.3
"""What a step with nothing beside it is given: half as much again as it takes on two idle cores."""
EXTRA_S = 0.1
"""What the variance of what is hidden is given, and what else may be wrong."""
FIRST_STEPS = 4
"""Of these in the first step about a rigid motion."""
_LEAST_FRAMES = 3  # that are answered with a step at least: on a busy machine frames wait for it
_JITTER_S = 0.01  # of stamps


@dataclass(frozen=True, eq=False)
class Task:
    """An answered observation, to be explained better.

    Attributes
    ----------
    solver : Solver
    posterior : Posterior
        From which to go on.
    variances : Variances
        Of all loads.
    rigid : bool
        Whether that is about a rigid motion.
    ratio : int or None
        Poisson's ratio to suppose; that of `posterior` where it is not known.
    number : int
        Of steps since the organ was linear about a rigid motion.
    registration : RegistrationFilter
    supposed : RegistrationError
        What it knew when the observation was answered: frames go on with it meanwhile.
    stamp_s : float
        Of the observation.
    given_up : Event
        Set when nobody wants the step any more: what is not yet begun of it is left.
    """

    solver: Solver
    posterior: Posterior
    variances: Variances
    rigid: bool
    ratio: int | None
    number: int
    registration: RegistrationFilter
    supposed: RegistrationError
    stamp_s: float
    given_up: Event = field(default_factory=Event)

    def go_on(self) -> None:
        """Raise CancelledError where the step is given up."""
        if self.given_up.is_set():
            raise CancelledError

    def passed(self, stamp_s: float) -> float:
        """Return the time from this observation to a later one, over `given_s`."""
        return (stamp_s - self.stamp_s) / self.given_s

    def is_due(self, stamp_s: float, frames: int, share: float = 1.0) -> bool:
        """Tell whether an observation, so many frames after this one, takes over what is made of it.

        `share` is what the step is given on this machine over `given_s`.
        """
        # Where few frames are answered, each step serves some of them; stamps may stand still or go back.
        early = 0.0 < self.passed(stamp_s) < share - _JITTER_S / self.given_s
        return frames >= _LEAST_FRAMES and not early

    @property
    def given_s(self) -> float:
        """After how much time the step is taken over, however long it took."""
        if self.rigid:
            return FIRST_STEPS * STEP_S
        # The first trial believes nothing, and is over in what a step is given.
        believes = self.doubts and self.number > STEPS_BEFORE_BELIEF
        return (1 + abs(self.ratio_step)) * STEP_S + (self.sees_hidden + believes) * EXTRA_S

    @property
    def sees_hidden(self) -> bool:
        """Whether it finds the variance of what is hidden."""
        return self.number % STEPS_PER_HIDDEN_VARIANCE == 0

    @property
    def doubts(self) -> bool:
        """Whether it asks what else may be wrong."""
        return self.number % STEPS_PER_TRIAL == 1

    @property
    def ratio_step(self) -> int:
        """Towards which other Poisson's ratio it looks, 1 or -1; most look at none, 0."""
        trial, remainder = divmod(self.number, STEPS_PER_RATIO_TRIAL)
        return 0 if self.rigid or remainder or not trial else (1, -1)[(trial - 1) % 2]


def improve(task: Task) -> tuple[Posterior, WarmStart]:
    """Make a step.

    Parameters
    ----------
    task : Task

    Returns
    -------
    posterior : Posterior
        With all loads.
    state : WarmStart
        For the next observation.

    Raises
    ------
    CancelledError
        If it was given up.
    """
    with one_thread():
        better = _start(task) if task.rigid else _step(task)
        hidden = None if task.sees_hidden else task.posterior.hidden_variance
        return better, task.solver.warm_start(better, hidden)


def _start(task: Task) -> Posterior:
    """Explain an observation from its rigid motion on; how exact the registration is must be found out, too."""
    return likeliest(task.solver, [_explained(task, scale) for scale in task.supposed.scales])


def _explained(task: Task, scale: float) -> Posterior:
    task.go_on()
    return explained(task.solver, task.supposed.scaled(scale))


def _step(task: Task) -> Posterior:
    task.go_on()
    better = _improved(task, task.ratio)
    if task.doubts:
        better = revised(task.solver, better, task.registration, task.number)
    if task.ratio_step and better.ratio + task.ratio_step in task.solver.ratios:
        other = _improved(task, better.ratio + task.ratio_step)
        if other.log_evidence > better.log_evidence + LEAST_LOG_EVIDENCE_GAIN:
            better = other
    return better


def _improved(task: Task, ratio: int | None) -> Posterior:
    return task.solver.improve(
        task.posterior,
        task.variances,
        guarded=True,
        ratio=ratio,
        registration=task.supposed,
    )
