"""Publishers, and the way of an answer through them."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from softtissue_estimator.ros.engine import Engine
from softtissue_estimator.ros.frames import Answer
from softtissue_estimator.ros.outputs.broadcast import RegistrationBroadcast
from softtissue_estimator.ros.outputs.observed_points import observed_points_message
from softtissue_estimator.ros.outputs.pose_buffer import PoseBuffer, fitted_pose
from softtissue_estimator.ros.outputs.structures import structures_message


@dataclass(frozen=True)
class Outputs:
    """Publishers, where sentences are logged, and what makes a sentence of an exception."""

    points: Any
    markers: Any
    registration: Any
    status: Any
    warn: Callable[[str], None]
    explain: Callable[[str, BaseException], str]
    transforms: RegistrationBroadcast | None = None
    structures: Any = None
    surface: Any = None
    observed: Any = None
    _poses: PoseBuffer = field(default_factory=PoseBuffer, init=False)

    def publish(self, engine: Engine, answer: Answer, lifetime_s: float) -> tuple[dict[str, float], bool]:
        """Send an answer, whose markers a viewer shows for a time; one thread at a time may do so.

        Returns the seconds that each part took, in order, and whether somebody looks at the markers.
        """
        began, estimate = time.monotonic(), answer.estimate
        # First, so that whoever draws an answer in the cloud's frame has the pose of its stamp already.
        motion, covariance = fitted_pose(answer.pose, estimate.diagnosis.registration)
        self.registration.publish(
            self._poses.serialised(motion, covariance, answer.pose.cloud_frame, answer.stamp_ns)
        )
        if self.transforms is not None:
            self.transforms.send(answer.pose, motion, answer.stamp_ns)
        posed = time.monotonic()
        self.points.publish(
            engine.points.serialised(answer.positions, estimate.displacement, estimate.sigma, answer.stamp_ns)
        )
        if self.surface is not None and self.surface.get_subscription_count() > 0:
            self.surface.publish(
                engine.surface.serialised(
                    answer.positions, estimate.displacement, estimate.sigma, answer.stamp_ns
                )
            )
        if self.observed is not None and self.observed.get_subscription_count() > 0:
            cloud = answer.cloud
            self.observed.publish(
                observed_points_message(cloud.points, answer.relied_on(), cloud.frame, cloud.stamp_ns)
            )
        published = time.monotonic()
        shown = self.show(engine, answer, lifetime_s)
        stages = {
            "publish registration": posed - began,
            "publish points": published - posed,
            "publish markers": time.monotonic() - published,
        }
        return stages, shown

    def describe(self, engine: Engine) -> None:
        """Send what the rows of the answers of an engine are."""
        if self.structures is not None:
            self.structures.publish(structures_message(engine.organ))

    def show(self, engine: Engine, answer: Answer, lifetime_s: float) -> bool:
        """Send the markers of an answer if somebody looks; return whether somebody does."""
        if self.markers.get_subscription_count() == 0:
            return False
        self.markers.publish(engine.markers.serialised(answer.positions, answer.stamp_ns, lifetime_s))
        return True
