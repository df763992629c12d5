"""From one cloud to one answer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Correspondences

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_estimator.estimators.structure_sigma import largest_sigmas
from softtissue_estimator.inference.stopwatch import Stopwatch
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.inputs.conversions import Cloud, read_cloud
from softtissue_estimator.ros.inputs.kinds import Kind
from softtissue_estimator.ros.inputs.registration import OrganPose, Registration
from softtissue_estimator.ros.questions import Bare, Pairs, ask_about_bare, ask_about_pairs

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """A cloud to answer.

    Attributes
    ----------
    cloud : PointCloud2
    correspondences : Correspondences or None
        None if the cloud carries its own.
    received_s : float
        When the cloud was received, monotonic clock, s.
    epoch : int
        Counts resets; an answer to a frame of an earlier epoch is not wanted any more.
    kind : Kind
        What the cloud is.
    """

    cloud: PointCloud2
    correspondences: Correspondences | None
    received_s: float
    epoch: int
    kind: Kind = Kind.PAIRS


@dataclass(frozen=True)
class Answer:
    """What an estimator made of a frame.

    Attributes
    ----------
    organ : Organ
        The organ it speaks of.
    stamp_ns : int
        Stamp of the cloud, nanoseconds.
    estimate : Estimate
    positions : (q, 3) float64
        Intraoperative positions of `Organ.query_points`, m, organ frame.
    pose : OrganPose
        Of the organ in the cloud's frame, as it was given.
    used, left_out : int
        Points of the cloud that entered the estimate, and those that did not.
    rejected_fraction : float
        Share of the correspondences that could not be used.
    visible_fraction : float
        Visible share of the organ's surface area.
    structure_sigma : (s,) float64
        Largest standard deviation of each structure, m; NaN where the estimator gives none.
    stages : dict
        Seconds of each stage, in order.
    cloud : Cloud
        That is answered.
    asked : Pairs or Bare
        What of it entered the estimate.
    """

    organ: Organ
    stamp_ns: int
    estimate: Estimate
    positions: FloatArray
    pose: OrganPose
    used: int
    left_out: int
    rejected_fraction: float
    visible_fraction: float
    structure_sigma: FloatArray
    stages: dict[str, float]
    cloud: Cloud
    asked: Pairs | Bare

    def relied_on(self) -> NDArray[np.bool_]:
        """Say which points of the cloud it relies on, (n,): they entered the estimate and were not left out in it."""
        rows, among = self.asked.rows, self.estimate.relied_on()
        used = np.zeros(len(self.cloud.points), dtype=np.bool_)
        used[rows if among is None else rows[among]] = True
        return used


class FrameAnswerer:
    """Answers frames, one at a time, and tells the estimator when they come with another registration.

    Parameters
    ----------
    organ : Organ
    estimator : Estimator
        Has loaded it.
    """

    def __init__(self, organ: Organ, estimator: Estimator) -> None:
        self._organ, self._estimator = organ, estimator
        self._pose_before: OrganPose | None = None

    def answer(self, frame: Frame, config: EstimatorConfig, registration: Registration) -> Answer:
        """Estimate where everything in the organ is, from one frame.

        Raises
        ------
        InvalidInputError
            If the frame cannot be used.
        """
        organ = self._organ
        watch = Stopwatch(frame.received_s)
        watch.lap("wait")
        pairs = frame.kind is Kind.PAIRS
        cloud = read_cloud(frame.cloud, with_reference=pairs)
        pose = registration.pose(cloud.frame, organ.frame, cloud.stamp_ns)
        asked: Pairs | Bare
        if pairs:
            asked = ask_about_pairs(cloud, frame.correspondences, pose, organ, config, watch)
        else:
            tracked = frame.kind is Kind.TRACKS
            asked = ask_about_bare(cloud, frame.cloud, pose, organ, config, watch, tracked=tracked)
        self._notice(pose)
        estimate = asked.answered_by(self._estimator)
        watch.lap("estimate")
        watch.stages.update({f"estimate/{name}": seconds for name, seconds in estimate.stages.items()})
        visible = asked.visible_fraction(organ, estimate)
        watch.lap("visibility")
        return Answer(
            organ=organ,
            stamp_ns=cloud.stamp_ns,
            estimate=estimate,
            positions=organ.query_points + estimate.displacement,
            pose=pose,
            used=asked.used,
            left_out=len(cloud.points) - asked.used,
            rejected_fraction=asked.rejected_fraction,
            visible_fraction=visible,
            structure_sigma=largest_sigmas(organ, estimate.sigma),
            stages=watch.stages,
            cloud=cloud,
            asked=asked,
        )

    def _notice(self, pose: OrganPose) -> None:
        # Here and not where registrations arrive: the frame in work has been explained with the one before.
        before, self._pose_before = self._pose_before, pose
        if before is not None and pose.given.motion is not before.given.motion and (pose.told or before.told):
            self._estimator.forget_registration()


def matching_of(frame: Frame, config: EstimatorConfig) -> str:
    """Say what the points of a frame are matched by, as `EstimatorStatus.matching` has it."""
    # Frames that are answered on their own know nothing of tracks.
    bare = frame.kind is Kind.TRACKS and not config.tracking
    return str((Kind.BARE if bare else frame.kind).value)


def unmoved(organ: Organ, config: EstimatorConfig) -> Observation:
    """Return an observation of the whole surface at its preoperative place."""
    vertices = organ.surface.vertices
    return Observation(vertices, np.zeros_like(vertices), np.full(len(vertices), config.default_sigma_m))
