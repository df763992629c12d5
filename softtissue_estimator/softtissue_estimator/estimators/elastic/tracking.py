"""Answer a stream of observations: each about the state of the one before, which a thread improves meanwhile."""

import atexit
import itertools
import logging
import threading
import time
from dataclasses import dataclass, replace

import torch

from softtissue_estimator.estimators.elastic.posterior import Posterior, WarmStart, warm_start
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.registration_scale import explained, likeliest
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.inference.device import one_thread
from softtissue_estimator.support.latest_worker import LatestWorker

_log = logging.getLogger(__name__)
_LEAST_VARIANCE_SHARE = 1e-3  # of the largest: with less no load starts a step of the thread
_STEPS_PER_RATIO_TRIAL = 4  # of the thread, which tries another Poisson's ratio in one of them
_LEAST_LOG_EVIDENCE_GAIN = 1.0  # from which on another ratio is taken: a smaller one may be noise
_STILL_DISTANCE_M = 0.001  # an organ that has moved by less since it was made linear is so nearly enough
_SETTLED_STEPS = 12  # of the thread about a still organ; every ratio nearby is tried in as many
_STILL_REFRESH_S = 1.0  # after which it makes another: the observed part of a still organ may change
_START_VARIANCE_UPDATES = 2  # of all loads; the thread makes more
_STOP_TIMEOUT_S = 3.0  # several times what a step takes


@dataclass(frozen=True, eq=False)
class _Task:
    """An answered observation, to be explained better."""

    solver: Solver
    posterior: Posterior
    variances: torch.Tensor
    epoch: int
    guarded: bool
    ratio: int | None


class ElasticTracker:
    """Keeps what is known of an organ from frame to frame.

    An answer takes milliseconds, because the organ is linear about its latest known state and few loads are relevant.
    Between answers a thread makes the organ linear about the newest one, with all loads, and so catches up with a
    moving organ in a fraction of a second. Of an organ that stands still the thread makes some further steps where
    `Solver.solve` ends, and then leaves the processor to others.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._warm_start: WarmStart | None = None
        self._rigid = False  # whether it is about a rigid motion
        self._before_loss: WarmStart | None = (
            None  # state from which the newest observation could not be followed
        )
        self._ratio: int | None = None  # survives a loss of track: the organ stays the same
        self._epoch = 0
        self._settled = 0  # steps since the organ last moved
        self._stepped_s = 0.0
        none = [0] * (_STEPS_PER_RATIO_TRIAL - 1)
        self._ratio_trials = itertools.cycle([*none, 1, *none, -1])
        self._closed = False
        self._worker: LatestWorker[_Task] | None = None
        self._registration: RegistrationFilter | None = None

    def registration(self, expected: RegistrationError) -> RegistrationError:
        """Return what is known of the registration before the next frame."""
        if self._registration is None:
            self._registration = RegistrationFilter(expected)
        return self._registration.supposed

    def answer(self, solver: Solver) -> Posterior:
        """Explain the newest observation."""
        with self._lock:
            before_loss, self._before_loss = self._before_loss, None
        # One cloud that nothing before suggests may have been wrong: the next one says whether the organ did move so.
        if before_loss is not None and solver.follow(before_loss) is not None:
            self._return_to(before_loss)
        with self._lock:
            earlier, rigid, epoch, ratio = self._warm_start, self._rigid, self._epoch, self._ratio
        posterior = None if earlier is None else solver.follow(earlier)
        started = None
        if posterior is None or earlier is None:
            if not rigid:
                self._before_loss = earlier
            posterior = solver.start(solver.registration, _START_VARIANCE_UPDATES)
            variances, rigid = posterior.amplitudes.variances, True
            # What comes before the thread has made a step follows this answer, which takes long.
            hidden = solver.hidden_variance(posterior)
            posterior = replace(posterior, hidden_variance=hidden)
            started = warm_start(posterior, hidden)
        else:
            # Loads that have become irrelevant get a little back, so that a new one can be found.
            floor = _LEAST_VARIANCE_SHARE * float(earlier.all_variances.max())
            variances = earlier.all_variances.clamp_min(floor)
        task = _Task(solver, posterior, variances, epoch, not rigid, ratio)
        still = (
            earlier is not None
            and not rigid
            and _distance(posterior.mean, earlier.tangent.state) < _STILL_DISTANCE_M
        )
        with self._lock:
            if not still:
                self._settled = 0
            elif self._settled >= _SETTLED_STEPS and time.monotonic() - self._stepped_s < _STILL_REFRESH_S:
                return posterior
            if started is not None and epoch == self._epoch:
                self._warm_start, self._rigid = started, True
            if self._worker is None and not self._closed:
                self._worker = LatestWorker(self._improve, self._on_crash, "tracker", background=True)
                # An interpreter that ends while torch works in a thread aborts.
                atexit.register(self.close)
            if self._worker is not None:
                self._worker.put(task)
        return posterior

    def _return_to(self, state: WarmStart) -> None:
        """Go on from an earlier state; what the thread makes of observations since is not taken."""
        with self._lock:
            self._warm_start, self._rigid = state, False
            self._epoch += 1

    def forget(self) -> None:
        """Forget all observations."""
        with self._lock:
            self._warm_start = self._before_loss = self._ratio = self._registration = None
            self._epoch += 1

    def forget_registration(self) -> None:
        """Forget what is known of the registration, not of the organ."""
        with self._lock:
            self._registration = None

    def close(self) -> None:
        """Forget all observations and end the thread."""
        self.forget()
        with self._lock:
            self._closed = True
            worker, self._worker = self._worker, None
        if worker is not None:
            atexit.unregister(self.close)
            worker.stop(_STOP_TIMEOUT_S)

    def _improve(self, task: _Task) -> None:
        registration = self._registration
        if registration is None or task.epoch != self._epoch:
            return
        with one_thread():
            better = self._improved(task, registration)
            warm = warm_start(better, task.solver.hidden_variance(better))
        with self._lock:
            if task.epoch == self._epoch:
                registration.observe(better)
                self._settled = self._settled + 1 if better.ratio == self._ratio else 0
                self._warm_start, self._rigid, self._ratio = warm, False, better.ratio
                self._stepped_s = time.monotonic()

    def _improved(self, task: _Task, known: RegistrationFilter) -> Posterior:
        if not task.guarded:
            # The first step about a rigid motion: how exact the registration is must be found out, too.
            found: list[Posterior] = []
            for scale in known.scales:
                if found and self._closed:
                    break
                found.append(explained(task.solver, known.supposed, scale))
            return likeliest(task.solver, found)
        better = self._step(task, task.ratio, known)
        direction = next(self._ratio_trials)
        if direction and better.ratio + direction in task.solver.ratios:
            other = self._step(task, better.ratio + direction, known)
            if other.log_evidence > better.log_evidence + _LEAST_LOG_EVIDENCE_GAIN:
                better = other
        return better

    def _step(self, task: _Task, ratio: int | None, known: RegistrationFilter) -> Posterior:
        # What is known of the registration now: since the task was put more may have been learned.
        return task.solver.improve(
            task.posterior, task.variances, guarded=True, ratio=ratio, registration=known.supposed
        )

    def _on_crash(self, error: BaseException) -> None:
        _log.error("the elastic posterior was not improved between frames: %s", error)
        self.forget()


def _distance(first: torch.Tensor, second: torch.Tensor) -> float:
    """Distance that any node moves from one displacement (n, 3) m to another, at most."""
    return float(torch.linalg.vector_norm(first - second, dim=1).max())
