"""Answers frames in the worker's thread and publishes what became of them."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sensor_msgs.msg import PointCloud2

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.ros.conversions import stamp_ns
from softtissue_estimator.ros.counters import FrameCounters
from softtissue_estimator.ros.engine import Engine
from softtissue_estimator.ros.frames import Answer, Frame, answer_frame, doubts
from softtissue_estimator.ros.markers import delete_all
from softtissue_estimator.ros.registration import Registration
from softtissue_estimator.ros.status import DEGRADED, INVALID, OK, Report, Setup, status_message


@dataclass(frozen=True)
class Outputs:
    """Publishers, and where sentences are logged."""

    points: Any
    markers: Any
    status: Any
    warn: Callable[[str], None]


class Responder:
    """Holds the engine and the present estimate; its methods may be called from any thread.

    Parameters
    ----------
    outputs : Outputs
    counters : FrameCounters
    registration : Registration
    config : callable
        Returns the configuration as it is now.
    """

    def __init__(
        self,
        outputs: Outputs,
        counters: FrameCounters,
        registration: Registration,
        config: Callable[[], EstimatorConfig],
    ) -> None:
        self._outputs, self._counters = outputs, counters
        self._registration, self._config = registration, config
        # Guards what follows and makes "still wanted, then published" one step.
        self._lock = threading.RLock()
        self._engine: Engine | None = None
        self._answer: Answer | None = None
        self._report = Report(OK)
        self._epoch = 0

    @property
    def configured(self) -> bool:
        """Whether an organ and an estimator are loaded."""
        return self._engine is not None

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

    def exchange(self, engine: Engine) -> bool:
        """Change the engine if there is one already; return whether it was changed."""
        with self._lock:
            if self._engine is None:
                return False
            self.use(engine)
            return True

    def reset(self) -> None:
        """Forget the present estimate and all counts; frames in work are not answered."""
        with self._lock:
            self._forget()
            self._epoch += 1
            self._counters.clear()

    def _forget(self) -> None:
        self._answer = None
        self._report = Report(OK)
        if self._engine is not None:
            self._engine.estimator.forget()
            self._outputs.markers.publish(delete_all(self._engine.organ.frame))

    def work(self, frame: Frame) -> None:
        """Answer a frame."""
        engine, config = self._engine, self._config()
        if engine is None:
            return
        try:
            answer = answer_frame(frame, engine.organ, engine.estimator, config, self._registration)
        except SoftTissueError as error:
            with self._lock:
                if self._wanted(frame, engine):
                    self.refuse(frame.cloud, str(error))
            return
        with self._lock:
            if self._wanted(frame, engine):
                self._publish(frame, answer, engine, config)

    def _wanted(self, frame: Frame, engine: Engine) -> bool:
        if frame.epoch != self._epoch:
            return False
        if engine is not self._engine:
            self._counters.add(dropped=1)
            return False
        return True

    def _publish(self, frame: Frame, answer: Answer, engine: Engine, config: EstimatorConfig) -> None:
        began = time.monotonic()
        self._answer = answer
        estimate = answer.estimate
        self._outputs.points.publish(
            engine.points.serialised(answer.positions, estimate.displacement, estimate.sigma, answer.stamp_ns)
        )
        published = time.monotonic()
        if self._outputs.markers.get_subscription_count() > 0:
            self._outputs.markers.publish(engine.markers.serialised(answer.positions, answer.stamp_ns))
        marked = time.monotonic()
        self._counters.add(answered=1)
        total = marked - frame.received_s
        reasons = doubts(answer, total, config)
        stages = answer.stages | {"publish points": published - began, "publish markers": marked - published}
        report = Report(
            DEGRADED if reasons else OK,
            "; ".join(reasons),
            answer.stamp_ns,
            answer.visible_fraction,
            answer.used,
            answer.left_out,
            stages,
            total,
        )
        self._say(report)

    def refuse(self, cloud: PointCloud2, reason: str) -> None:
        """Report a cloud that cannot be used; the estimate before it no longer holds."""
        with self._lock:
            self._answer = None
            self._counters.add(refused=1)
            self._say(
                Report(
                    INVALID, reason, stamp_ns(cloud.header.stamp), left_out=int(cloud.width * cloud.height)
                )
            )

    def note(self, level: int, reason: str) -> None:
        """Report something that is not about a cloud."""
        with self._lock:
            self._say(Report(level, reason))

    def _say(self, report: Report) -> None:
        self._report = report
        self._outputs.status.publish(status_message(report, self.setup, self._counters.counts))
        if report.reason:
            self._outputs.warn(report.reason)
