"""Answer a stream of observations: each about the state of the one before, which a thread improves meanwhile.

What the thread makes of an observation is taken over by the first one that is made `STEP_S` later, by the stamps of
both, and waited for where it is not ready: the same stream gives the same answers however fast the machine is.
"""

import logging
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch

from softtissue_estimator.estimators.elastic.posterior import Posterior, WarmStart, warm_start
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.registration_scale import explained, likeliest, unfettered
from softtissue_estimator.estimators.elastic.relevance import Variances
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.inference.device import one_thread

_log = logging.getLogger(__name__)
STEP_S = 0.3
"""Between an observation and the one that takes over the step that the thread made about it: half as much again as that
takes on two idle cores."""
_LEAST_FRAMES = 3  # that are answered with a step at least: on a busy machine frames wait for it
_FIRST_STEPS = 2  # of these in the first step about a rigid motion
UNSTAMPED_S = 0.1  # between two observations that do not say when they were made
_JITTER_S = 0.01  # of stamps
_LEAST_VARIANCE_SHARE = 1e-3  # of the largest: with less no load starts a step of the thread
_CATCHING_UP_STEPS = 4  # after a start, of which nothing is learned about the registration's constancy
_STEPS_PER_HIDDEN_VARIANCE = 3  # which changes slowly and takes as long as a fifth of a step
_THREADS = 3  # at most: several sizes of the registration's error are tried at once
_STEPS_PER_RATIO_TRIAL = 4  # of the thread, which tries another Poisson's ratio in one of them
_LEAST_LOG_EVIDENCE_GAIN = 1.0  # from which on another ratio is taken: a smaller one may be noise
_STILL_DISTANCE_M = 0.001  # an organ that has moved by less since it was made linear is so nearly enough
_SETTLED_STEPS = 12  # of the thread about a still organ; every ratio nearby is tried in as many
_STILL_REFRESH_S = 1.0  # after which it makes another: the observed part of a still organ may change
_START_VARIANCE_UPDATES = 2  # of all loads; the thread makes more


@dataclass(frozen=True, eq=False)
class _Task:
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
    stamp_s : float
    """

    solver: Solver
    posterior: Posterior
    variances: Variances
    rigid: bool
    ratio: int | None
    number: int
    registration: RegistrationFilter
    stamp_s: float


@dataclass(frozen=True, eq=False)
class _Memory:
    """What is known of an organ between two frames.

    Attributes
    ----------
    state : WarmStart or None
        About which the next observation is explained.
    rigid : bool
        Whether that is about a rigid motion, for want of a step of the thread.
    before_loss : WarmStart or None
        State from which the newest observation could not be followed.
    ratio : int or None
        Poisson's ratio, which survives a loss of track: the organ stays the same.
    settled : int
        Steps since the organ last moved.
    stepped_s : float
        Stamp of the newest observation that a step was made about.
    steps : int
        That the thread was given since it was about a rigid motion.
    """

    state: WarmStart | None = None
    rigid: bool = False
    before_loss: WarmStart | None = None
    ratio: int | None = None
    settled: int = 0
    stepped_s: float = 0.0
    steps: int = 0


class ElasticTracker:
    """Keeps what is known of an organ from frame to frame.

    An answer takes milliseconds, because the organ is linear about its latest known state and few loads are relevant.
    Between answers a thread makes the organ linear about the newest one, with all loads, and so catches up with a
    moving organ in a fraction of a second. Of an organ that stands still the thread makes some further steps where
    `Solver.solve` ends, and then leaves the processor to others.

    `answer` is called from one thread at a time, `forget` and its like from any.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._memory = _Memory()
        self._registration: RegistrationFilter | None = None
        self._pending: tuple[_Task, Future[tuple[Posterior, WarmStart]]] | None = None
        self._stamp_s, self._frames = (
            0.0,
            0,
        )  # of the newest observation; since the thread was given something
        self._closed = False
        # Threads of an executor are waited for when the interpreter ends: torch aborts where one is cut off.
        self._executor = ThreadPoolExecutor(_THREADS, "tracker")

    def registration(self, expected: RegistrationError) -> RegistrationError:
        """Return what is known of the registration before the next frame."""
        with self._lock:
            if self._registration is None:
                self._registration = RegistrationFilter(expected)
            return self._registration.supposed

    def catch_up(self, stamp_s: float | None) -> None:
        """Take over what the thread has made, as of an observation that is to be answered next.

        Parameters
        ----------
        stamp_s : float or None
            When it was made; None for a tenth of a second after the one before.
        """
        with self._lock:
            self._stamp_s = self._stamp_s + UNSTAMPED_S if stamp_s is None else stamp_s
            self._frames += 1
            pending = self._pending
            if pending is None or not _is_due(pending[0], self._stamp_s, self._frames):
                return
        task, future = pending
        try:
            better, state = future.result()
        except Exception as error:
            _log.error("the elastic posterior was not improved between frames: %s", error)
            self.forget()
            return
        with self._lock:
            if self._pending is not pending:
                return  # forgotten meanwhile
            self._pending = None
            if self._registration is task.registration:
                task.registration.observe(better)
            settled = self._memory.settled + 1 if better.ratio == self._memory.ratio else 0
            self._memory = replace(
                self._memory,
                state=state,
                rigid=False,
                ratio=better.ratio,
                settled=settled,
                stepped_s=task.stamp_s,
            )

    def answer(self, solver: Solver) -> Posterior:
        """Explain the observation that `catch_up` was called for."""
        with self._lock:
            memory, registration = self._memory, self._registration
        # One cloud that nothing before suggests may have been wrong: the next one says whether the organ did move so.
        if memory.before_loss is not None and solver.follow(memory.before_loss) is not None:
            memory = self._return_to(memory)
        memory = replace(memory, before_loss=None)
        earlier = memory.state
        posterior = None if earlier is None else solver.follow(earlier)
        if posterior is None or earlier is None:
            before_loss = memory.before_loss if memory.rigid else earlier
            posterior, state = self._start(solver)
            variances = posterior.amplitudes.prior
            memory = replace(memory, state=state, rigid=True, before_loss=before_loss)
            still = False
        else:
            # Loads that have become irrelevant get a little back, so that a new one can be found.
            variances = earlier.all_variances.at_least(_LEAST_VARIANCE_SHARE)
            still = not memory.rigid and _distance(posterior.mean, earlier.tangent.state) < _STILL_DISTANCE_M
        if not still:
            memory = replace(memory, settled=0)
        self._keep(memory, registration, solver, posterior, variances, still)
        return posterior

    def _keep(
        self,
        memory: _Memory,
        registration: RegistrationFilter | None,
        solver: Solver,
        posterior: Posterior,
        variances: Variances,
        still: bool,
    ) -> None:
        """Remember, and give the thread something to do where it has nothing and the organ moves."""
        with self._lock:
            if registration is None or self._registration is not registration:
                return  # forgotten meanwhile
            self._memory = memory
            rests = memory.settled >= _SETTLED_STEPS and self._stamp_s - memory.stepped_s < _STILL_REFRESH_S
            if self._closed or self._pending is not None or (still and rests):
                return
            self._memory = replace(memory, steps=0 if memory.rigid else memory.steps + 1)
            task = _Task(
                solver,
                posterior,
                variances,
                memory.rigid,
                memory.ratio,
                self._memory.steps,
                registration,
                self._stamp_s,
            )
            self._pending, self._frames = (task, self._executor.submit(self._improve, task)), 0

    def _start(self, solver: Solver) -> tuple[Posterior, WarmStart]:
        """Explain an observation about its rigid motion; what comes next follows this answer, which takes long."""
        posterior = solver.start(solver.registration, _START_VARIANCE_UPDATES)
        hidden = solver.hidden_variance(posterior)
        posterior = replace(posterior, hidden_variance=hidden)
        return posterior, warm_start(posterior, hidden)

    def _return_to(self, memory: _Memory) -> _Memory:
        """Go on from before a loss; what the thread makes of observations since is not taken."""
        with self._lock:
            self._pending = None
        return replace(memory, state=memory.before_loss, rigid=False)

    def forget(self) -> None:
        """Forget all observations."""
        with self._lock:
            self._memory, self._registration, self._pending = _Memory(), None, None

    def forget_registration(self) -> None:
        """Forget what is known of the registration, not of the organ."""
        with self._lock:
            self._registration, self._pending = None, None

    def close(self) -> None:
        """Forget all observations and end the thread."""
        self.forget()
        with self._lock:
            self._closed = True
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _improve(self, task: _Task) -> tuple[Posterior, WarmStart]:
        with one_thread():
            better = self._improved(task)
            hidden = task.posterior.hidden_variance
            if hidden is None or task.number % _STEPS_PER_HIDDEN_VARIANCE == 0:
                hidden = task.solver.hidden_variance(better)
            return better, warm_start(better, hidden)

    def _improved(self, task: _Task) -> Posterior:
        known, solver = task.registration, task.solver
        if task.rigid:
            # The first step about a rigid motion: how exact the registration is must be found out, too.
            others = [
                self._executor.submit(_explained_alone, solver, known.supposed, scale)
                for scale in known.scales[1:]
            ]
            found = [explained(solver, known.supposed, known.scales[0])]
            return likeliest(solver, found + [other.result() for other in others])
        better = self._step(task, task.ratio)
        if task.number > _CATCHING_UP_STEPS:
            better = unfettered(solver, better)
        ratio_step = _ratio_step(task.number)
        if ratio_step and better.ratio + ratio_step in solver.ratios:
            other = self._step(task, better.ratio + ratio_step)
            if other.log_evidence > better.log_evidence + _LEAST_LOG_EVIDENCE_GAIN:
                better = other
        return better

    def _step(self, task: _Task, ratio: int | None) -> Posterior:
        return task.solver.improve(
            task.posterior,
            task.variances,
            guarded=True,
            ratio=ratio,
            registration=task.registration.supposed,
        )


def _explained_alone(solver: Solver, registration: RegistrationError, scale: float) -> Posterior:
    with one_thread():
        return explained(solver, registration, scale)


def _ratio_step(number: int) -> int:
    """Return towards which other Poisson's ratio a step of the thread looks, 1 or -1; most look at none, 0."""
    trial, remainder = divmod(number, _STEPS_PER_RATIO_TRIAL)
    return 0 if remainder or not trial else (1, -1)[(trial - 1) % 2]


def _is_due(task: _Task, stamp_s: float, frames: int) -> bool:
    """Tell whether an observation, so many frames after another one, takes over what the thread makes of that."""
    steps = _FIRST_STEPS if task.rigid else 1 + abs(_ratio_step(task.number))
    passed_s = stamp_s - task.stamp_s
    # Where few frames are answered, each step serves some of them; stamps may stand still or go back.
    enough = frames >= _LEAST_FRAMES
    return enough and not 0.0 < passed_s < steps * STEP_S - _JITTER_S


def _distance(first: torch.Tensor, second: torch.Tensor) -> float:
    """Distance that any node moves from one displacement (n, 3) m to another, at most."""
    return float(torch.linalg.vector_norm(first - second, dim=1).max())
