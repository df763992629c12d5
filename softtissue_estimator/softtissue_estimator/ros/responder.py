"""Answers frames and publishes what became of them."""

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import OrganNotFoundError
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.degradation import degradation_reasons, in_one_sentence
from softtissue_estimator.ros.engine import Engine
from softtissue_estimator.ros.frames import Answer, Frame, matching_of
from softtissue_estimator.ros.inputs.counters import FrameCounters
from softtissue_estimator.ros.inputs.kinds import Kind
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.organ_search import OrganSearch
from softtissue_estimator.ros.outputs.markers import delete_all
from softtissue_estimator.ros.outputs.status import DEGRADED, INVALID, OK, Report, Setup, status_message
from softtissue_estimator.ros.publishing import Outputs
from softtissue_estimator.support.sentences import one_sentence


@dataclass(frozen=True)
class Outcome:
    """What became of a frame: an answer, or a reason to refuse it.

    Attributes
    ----------
    frame : Frame
    engine : Engine
        What made it.
    config : EstimatorConfig
        As it was then.
    made_s : float
        When it was made, monotonic clock, s.
    answer : Answer or None
    refusal : str
        One sentence; empty where there is an answer.
    lost : bool
        Whether it is refused since the organ is not where it is expected.
    """

    frame: Frame
    engine: Engine
    config: EstimatorConfig
    made_s: float
    answer: Answer | None = None
    refusal: str = ""
    lost: bool = False


class Responder:
    """Holds the engine and the present estimate; its methods may be called from any thread.

    Parameters
    ----------
    outputs : Outputs
    counters : FrameCounters
    registration : Registration
    config : callable
        Returns the configuration as it is now.
    search : OrganSearch, optional
        Told whether the organ is where it is expected.
    """

    def __init__(
        self,
        outputs: Outputs,
        counters: FrameCounters,
        registration: Registration,
        config: Callable[[], EstimatorConfig],
        search: OrganSearch | None = None,
    ) -> None:
        self._search = search
        self._outputs, self._counters = outputs, counters
        self._registration, self._config = registration, config
        # Guards what follows and makes "still wanted, then published" one step.
        self._lock = threading.RLock()
        self._engine: Engine | None = None
        self._answer: Answer | None = None
        self._newest: Frame | None = None
        self._report = Report(OK)
        self._shown = True  # whether the markers of the present estimate were sent
        self._epoch = 0

    @property
    def configured(self) -> bool:
        """Whether an organ and an estimator are loaded."""
        return self._engine is not None

    @property
    def engine(self) -> Engine | None:
        """Organ and estimator at work."""
        return self._engine

    def elastic(self, organ: Organ) -> NDArray[np.float32] | None:
        """How an organ bends, for the search of its pose; None if it is not at work, or its estimator cannot say."""
        engine = self._engine
        return engine.elastic if engine is not None and engine.organ is organ else None

    @property
    def setup(self) -> Setup:
        """Names of what is at work."""
        engine = self._engine
        return Setup() if engine is None else engine.setup

    @property
    def answer(self) -> Answer | None:
        """The present estimate; None after a refusal, a reset or another organ."""
        with self._lock:
            return self._answer

    @property
    def report(self) -> Report:
        """What became of the newest cloud."""
        return self._report

    @property
    def epoch(self) -> int:
        """Number of resets so far."""
        return self._epoch

    def use(self, engine: Engine | None) -> None:
        """Change organ and estimator; frames in work for the old ones count as dropped."""
        with self._lock:
            self._forget()
            before, self._engine = self._engine, engine
        if before is not None and before is not engine:
            before.estimator.close()

    def rehearse(self, engine: Engine) -> None:
        """Let an engine that is not yet at work answer the newest cloud.

        In a stream a first answer takes several times as long as those that follow it.
        """
        frame = self._newest
        if frame is None:
            return
        # What is wrong with the cloud, or with the engine, is said when a cloud comes that it is to answer.
        with contextlib.suppress(Exception):
            engine.answerer.answer(frame, self._config(), self._registration)

    def exchange(self, before: Engine, engine: Engine) -> bool:
        """Change the engine between two answers if it is still the one from before; return whether it was changed."""
        with self._lock:
            if self._engine is not before:
                return False
            self._forget()
            self._engine = engine
            self._outputs.describe(engine)
        # Outside of the lock: its thread may be in the middle of something, and answers need not wait for that.
        before.estimator.close()
        return True

    def describe(self) -> None:
        """Send what the rows of the answers are."""
        with self._lock:
            if self._engine is not None:
                self._outputs.describe(self._engine)

    def reset(self) -> None:
        """Forget the present estimate and all counts; frames in work are not answered."""
        with self._lock:
            self._forget()
            self._epoch += 1
            self._counters.clear()

    def _forget(self) -> None:
        self._answer = self._newest = None
        self._report = Report(OK)
        if self._engine is not None:
            self._engine.estimator.forget()
            self._outputs.markers.publish(delete_all(self._engine.organ.frame))

    def estimate(self, frame: Frame) -> Outcome | None:
        """Make an answer of a frame, or a reason to refuse it; None where nothing is loaded any more."""
        engine, config = self._engine, self._config()
        if engine is None:
            return None
        self._newest = frame
        if self._search is not None:
            self._search.begin(engine.organ)
        try:
            answer = engine.answerer.answer(frame, config, self._registration)
        except Exception as error:  # whatever it is, the cloud's sender is told
            refusal, lost = self._outputs.explain("estimate", error), isinstance(error, OrganNotFoundError)
            if lost and self._search is not None and frame.kind is not Kind.PAIRS:
                refusal = self._search.away(frame, engine.organ, refusal)
            return Outcome(frame, engine, config, time.monotonic(), refusal=refusal, lost=lost)
        if self._search is not None:
            self._search.answered()
        return Outcome(frame, engine, config, time.monotonic(), answer)

    def deliver(self, outcome: Outcome) -> None:
        """Publish an outcome, if it is still wanted."""
        with self._lock:
            if not self._wanted(outcome):
                return
            if outcome.answer is None:
                if outcome.lost and self._answer is not None:
                    # What is shown is not there any more; other refusals may be of a single cloud.
                    self._outputs.markers.publish(delete_all(outcome.engine.organ.frame))
                self.refuse(outcome.frame.cloud, outcome.refusal, matching_of(outcome.frame, outcome.config))
                return
            try:
                report = self._publish(outcome, outcome.answer)
            except Exception as error:
                self.refuse(outcome.frame.cloud, self._outputs.explain("answer", error))
                return
            self._counters.add(answered=1)
            self._say(report)

    def show_late_comers(self) -> None:
        """Send the markers of the present estimate, with its stamp, to who begins to look after it was made."""
        with self._lock:
            if self._answer is None or self._engine is None or self._shown:
                return
            lifetime_s = self._config().no_data_timeout_s
            self._shown = self._outputs.show(self._engine, self._answer, lifetime_s)

    def supersede(self, outcome: Outcome) -> None:
        """Count an outcome that a newer one overtook before it was delivered."""
        with self._lock:
            if self._wanted(outcome):
                refused = outcome.answer is None
                self._counters.add(dropped=int(not refused), refused=int(refused))

    def _wanted(self, outcome: Outcome) -> bool:
        if outcome.frame.epoch != self._epoch:
            return False
        if outcome.engine is not self._engine:
            self._counters.add(dropped=1)
            return False
        return True

    def _publish(self, outcome: Outcome, answer: Answer) -> Report:
        began = time.monotonic()
        self._answer = answer
        lifetime_s = outcome.config.no_data_timeout_s
        parts, self._shown = self._outputs.publish(outcome.engine, answer, lifetime_s)
        total = time.monotonic() - outcome.frame.received_s
        reasons = degradation_reasons(answer, total, outcome.config)
        return Report(
            DEGRADED if reasons else OK,
            in_one_sentence(reasons),
            answer.stamp_ns,
            answer.visible_fraction,
            answer.used,
            answer.left_out,
            answer.stages | {"hand over": began - outcome.made_s} | parts,
            total,
            diagnosis=answer.estimate.diagnosis,
            structures=tuple(structure.name for structure in answer.organ.structures),
            structure_sigma=tuple(answer.structure_sigma.tolist()),
            matching=matching_of(outcome.frame, outcome.config),
        )

    def refuse(self, cloud: PointCloud2, reason: str, matching: str = "") -> None:
        """Report a cloud that cannot be used, and how it was to be matched; the estimate before it no longer holds."""
        with self._lock:
            self._answer = None
            self._counters.add(refused=1)
            self._say(
                Report(
                    INVALID,
                    one_sentence(reason),
                    left_out=int(cloud.width) * int(cloud.height),
                    stamp=cloud.header.stamp,
                    matching=matching,
                )
            )

    def note(self, level: int, reason: str) -> None:
        """Report something that is not about a cloud."""
        with self._lock:
            self._say(Report(level, reason))

    def _say(self, report: Report) -> None:
        self._report = report
        try:
            state = "" if self._search is None else self._search.state
            message = status_message(report, self.setup, self._counters.counts, state)
            self._outputs.status.publish(message)
        except Exception as error:
            self._outputs.explain("status", error)
        if report.reason:
            self._outputs.warn(report.reason)
