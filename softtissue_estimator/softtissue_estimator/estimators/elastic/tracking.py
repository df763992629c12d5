"""Answer a stream of observations: each about the state of the one before, which a thread improves meanwhile.

What the thread makes of an observation is taken over by the first one made `Task.given_s` later, by the stamps of both,
and waited for where it is not ready: with enough patience the same stream has the same answers on every machine. Where
that is in vain, later steps are given longer (`Pace`).
"""

import copy
import logging
import os
import sys
import threading
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import replace

import torch

from softtissue_estimator.errors import OrganNotFoundError
from softtissue_estimator.estimators.elastic.amplitudes import Variances
from softtissue_estimator.estimators.elastic.doubts import Troubles
from softtissue_estimator.estimators.elastic.improvement import Task, improve
from softtissue_estimator.estimators.elastic.innovations import Innovations
from softtissue_estimator.estimators.elastic.memory import Known, Memory, followed_from, reason_for_disbelief
from softtissue_estimator.estimators.elastic.pace import Pace
from softtissue_estimator.estimators.elastic.posterior import Posterior, WarmStart
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.estimators.elastic.suppositions import likeliest_scale

_log = logging.getLogger(__name__)
UNSTAMPED_S = 0.1  # between two observations that do not say when they were made
_LEAST_VARIANCE_SHARE = 1e-3  # of the largest: with less no load starts a step of the thread
_NICENESS = 10  # of the thread: frames come first
_STILL_DISTANCE_M = 0.001  # an organ that has moved by less since it was made linear is so nearly enough
_SETTLED_STEPS = 12  # of the thread about a still organ; every ratio nearby is tried in as many
_STILL_REFRESH_S = 1.0  # after which it makes another: the observed part of a still organ may change
_START_VARIANCE_UPDATES = 2  # of all loads; the thread makes more


class ElasticTracker:
    """Keeps what is known of an organ from frame to frame.

    An answer takes milliseconds, because the organ is linear about its latest known state and few loads are relevant.
    Between answers a thread makes the organ linear about the newest one, with all loads, and so catches up with a
    moving organ in a fraction of a second. Of an organ that stands still the thread makes some further steps where
    `Solver.solve` ends, and then leaves the processor to others.

    `answer` is called from one thread at a time, `forget` and its like from any.

    Parameters
    ----------
    patience_s : float
        How long an answer waits for the thread at most. On a machine that is too busy for the thread it goes on
        without, and later ones ask again: answers then depend on how busy it is.
    """

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._lock = threading.Lock()
        self._known = Known()
        self._innovations = Innovations()
        self._pending: tuple[Task, Future[tuple[Posterior, WarmStart]]] | None = None
        self._stamp_s = 0.0  # of the newest observation
        self._pace = Pace()
        self._frames = 0  # since the thread was given something
        self._closed = False
        # Threads of an executor are waited for when the interpreter ends: torch aborts where one is cut off.
        self._executor = ThreadPoolExecutor(1, "tracker", _step_back)

    @property
    def now_s(self) -> float:
        """When the newest observation was made, as `begin` was told."""
        with self._lock:
            return self._stamp_s

    def registration(self, expected: RegistrationError) -> RegistrationError:
        """Return what is known of the registration before the next frame."""
        with self._lock:
            filtered = self._known.registration or RegistrationFilter(expected)
            self._known = replace(self._known, registration=filtered)
            return filtered.supposed

    @property
    def lost(self) -> bool:
        """Whether an organ that was known could not be followed, and no step has been made since."""
        with self._lock:
            return self._known.memory.rigid and self._known.memory.ratio is not None

    @property
    def troubles(self) -> Troubles:
        """What the stream has shown until now."""
        lost = self.lost
        with self._lock:
            known = self._known.registration
            return Troubles(lost, self._innovations.surprising, known is not None and known.moved)

    def begin(self, stamp_s: float | None) -> None:
        """Note that an observation is to be answered next.

        Parameters
        ----------
        stamp_s : float or None
            When it was made; None for a tenth of a second after the one before.
        """
        with self._lock:
            self._stamp_s = self._stamp_s + UNSTAMPED_S if stamp_s is None else stamp_s
            self._frames += 1

    def catch_up(self) -> None:
        """Take over what the thread has made for the observation that has begun, or wait for it."""
        with self._lock:
            pending = self._pending
            if pending is None or not pending[0].is_due(self._stamp_s, self._frames, self._pace.share):
                return
        task, future = pending
        try:
            better, state = future.result(0.0 if self._pace.late else self._patience_s)
        except CancelledError:
            return
        except Exception as error:
            if not future.done():
                self._pace.waited_in_vain()
                return  # the next observation asks again
            self._forget_after(error)
            return
        with self._lock:
            if self._pending is not pending:
                return  # forgotten meanwhile
            self._pending = None
            self._pace.taken_over(task.passed(self._stamp_s))
            if self._known.registration is task.registration:
                task.registration.observe(better)
            memory = self._known.memory
            settled = memory.settled + 1 if better.ratio == memory.ratio else 0
            memory = replace(
                memory,
                state=state,
                tangent=None,
                rigid=False,
                ratio=better.ratio,
                settled=settled,
                attachment_moves=better.attachment_moves,
                stepped_s=task.stamp_s,
            )
            self._known = replace(self._known, memory=memory)

    def answer(self, solver: Solver) -> Posterior:
        """Explain the observation that has begun.

        Raises
        ------
        OrganNotFoundError
            If what the observation shows is not the organ. What was known of a lost one is kept: it may come back where
            it was.
        """
        with self._lock:
            before = self._known
        solver, posterior, known = followed_from(solver, before)
        returned = before.lost is not None and known.memory is before.lost.memory
        earlier, reason = known.memory.state, ""
        if posterior is None or earlier is None:
            posterior, known, reason = self._anew(solver, known)
            variances, still, tangent = posterior.amplitudes.prior, False, None
        else:
            if known.lost is not None:
                reason = reason_for_disbelief(solver, posterior, known.lost)
                known = known if reason else replace(known, lost=None)
            # Loads that have become irrelevant get a little back, so that a new one can be found.
            variances = earlier.all_variances.at_least(_LEAST_VARIANCE_SHARE)
            variances = replace(variances, loads=solver.prior.held(variances.loads))
            moved_m = _distance(posterior.mean, earlier.tangent.state)
            still = not known.memory.rigid and moved_m < _STILL_DISTANCE_M
            tangent = posterior.tangent
        if known.registration is not None and not reason:
            known.registration.follow(posterior)
        if not reason or known.lost is not None:
            known = known.after(posterior, still, tangent)
            lost_now = bool(reason) and (before.lost is None or before.lost.believed)
            self._keep(before, known, solver, posterior, variances, still, returned or lost_now)
        if reason:
            raise OrganNotFoundError(reason)
        self._innovations.observe(self._stamp_s, posterior.innovation)
        return posterior

    def _anew(self, solver: Solver, known: Known) -> tuple[Posterior, Known, str]:
        """Start anew; also return what is known then, and why the answer is not believed, if it is not."""
        posterior, state = self._start(solver, known)
        reason = reason_for_disbelief(solver, posterior, known.lost or known.as_lost())
        lost, registration = known.lost, known.registration
        if lost is None and known.memory.state is not None and (reason or not known.memory.rigid):
            lost = replace(known.as_lost(), believed=not reason)
            # What is supposed to be the organ from now on may not be.
            registration = copy.copy(registration) if reason else registration
        elif not reason:
            lost = None
        memory = replace(known.memory, state=state, tangent=None, rigid=True, patches=0.0)
        return posterior, Known(memory, registration, lost), reason

    def _keep(
        self,
        before: Known,
        known: Known,
        solver: Solver,
        posterior: Posterior,
        variances: Variances,
        still: bool,
        give_up: bool,
    ) -> None:
        """Remember, and give the thread something to do where it has nothing and the organ moves."""
        with self._lock:
            if self._known.registration is not before.registration:
                return  # forgotten meanwhile
            if give_up:
                self._give_up()
            memory, registration = known.memory, known.registration
            self._known = known
            rests = memory.settled >= _SETTLED_STEPS and self._stamp_s - memory.stepped_s < _STILL_REFRESH_S
            if registration is None or self._closed or self._pending is not None or (still and rests):
                return
            memory = replace(memory, steps=0 if memory.rigid else memory.steps + 1)
            self._known = replace(known, memory=memory)
            task = Task(
                solver,
                posterior,
                variances,
                memory.rigid,
                memory.ratio,
                memory.steps,
                registration,
                registration.supposed,
                self._stamp_s,
            )
            self._pending, self._frames = (task, self._executor.submit(improve, task)), 0

    def _start(self, solver: Solver, known: Known) -> tuple[Posterior, WarmStart]:
        """Explain an observation about its rigid motion; what comes next follows this answer, which takes long."""
        posterior = solver.start(solver.registration, _START_VARIANCE_UPDATES)
        registration = known.registration
        if registration is not None and known.memory.state is None:
            # Until the thread has made its first step one that is far off would pass for exact.
            scale = likeliest_scale(solver, posterior)
            if scale != 1.0:
                registration.suppose(scale)
                posterior = solver.start(registration.supposed, _START_VARIANCE_UPDATES)
        state = solver.warm_start(posterior)
        return replace(posterior, hidden_variance=state.hidden_variance), state

    def _give_up(self) -> None:
        if self._pending is not None:
            self._pending[0].given_up.set()
            self._pace.given_up()
        self._pending = None

    def _forget_after(self, error: Exception) -> None:
        """Forget what the thread could not improve: all, or what may not be the organ that is looked for."""
        with self._lock:
            lost = self._known.lost
            if lost is not None and not lost.believed:
                self._known = replace(self._known, memory=Memory(ratio=lost.memory.ratio))
                self._give_up()
                return
        _log.error("the elastic posterior was not improved between frames: %s", error)
        self.forget()

    def forget(self) -> None:
        """Forget all observations."""
        with self._lock:
            self._known = Known()
            self._innovations = Innovations()
            self._give_up()

    def forget_registration(self) -> None:
        """Forget what is known of the registration, not of the organ."""
        with self._lock:
            lost = self._known.lost
            memory = self._known.memory if lost is None else lost.memory
            self._known = Known(memory)
            self._give_up()

    def close(self) -> None:
        """Forget all observations and end the thread."""
        self.forget()
        with self._lock:
            self._closed = True
        self._executor.shutdown(wait=False, cancel_futures=True)


def _step_back() -> None:
    """Let other threads of the process come first."""
    if sys.platform == "linux":
        # There, and only there, a thread has a priority of its own.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)


def _distance(first: torch.Tensor, second: torch.Tensor) -> float:
    """Distance that any node moves from one displacement (n, 3) m to another, at most."""
    return float(torch.linalg.vector_norm(first - second, dim=1).max())
