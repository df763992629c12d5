"""Let an estimator answer single bare clouds as the node would, in the frames of the camera and of the organ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.estimator import Estimator, create_estimator, estimator_names
from softtissue_estimator.observation.bare_cloud import make_bare_cloud
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.registration.rigid_icp import IDENTITY, rigid_icp
from softtissue_training.evaluation.clouds.told_poses import ToldPose
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.streams.frames import Frame, checked, reason, timed

FloatArray = NDArray[np.float64]

_REST, _ICP = "zero", "rigid"
COUNTED_SHARE = 0.5
"""Of a cloud's points, the nearest: those that `rigid` moves onto the organ. At least so many are organ."""


def answers_bare_clouds(spec: MethodSpec) -> bool:
    """Whether an estimator needs no correspondences.

    Raises
    ------
    SoftTissueError
        It cannot be made.
    """
    if spec.kind not in estimator_names():
        return spec.kind in (_REST, _ICP)
    estimator = create_estimator(_config(spec))
    estimator.close()
    return type(estimator).estimate_bare is not Estimator.estimate_bare


class CloudMethod:
    """An estimator that is shown bare clouds of one organ, each on its own.

    `zero` leaves the organ at rest in the pose that is told; `rigid` moves it, undeformed, from there onto the cloud by
    trimmed iterated closest points (`COUNTED_SHARE`). Others are estimators of the product.

    Parameters
    ----------
    spec
        Which one.
    organ
        With the attached region that it really has.
    """

    def __init__(self, spec: MethodSpec, organ: Organ) -> None:
        self._spec, self._organ, self._config = spec, organ, _config(spec)
        self._estimator: Estimator | None = None
        if spec.kind in estimator_names():
            self._estimator = create_estimator(self._config)
            self._estimator.load_organ(organ)

    def close(self) -> None:
        """End what the estimator has running."""
        if self._estimator is not None:
            self._estimator.close()

    def answer(self, points: FloatArray, told: ToldPose, inner: FloatArray) -> tuple[Frame, Frame]:
        """Show a cloud; whatever goes wrong inside the estimator counts as refused.

        Parameters
        ----------
        points
            (n, 3) m, camera's frame.
        told
            Where the organ is said to be.
        inner
            (p, 3) m, preoperative points that are asked for, organ's frame.

        Returns
        -------
        tuple of Frame
            Where the points are in the camera's frame, as `displacement`, with the standard deviation that pose and
            deformation leave; and their displacement in the organ's frame with its own.
        """
        try:
            if self._estimator is None:
                return self._undeformed(points, told, inner)
            return self._deformed(self._estimator, points, told, inner)
        except Exception as error:
            return Frame(failure=reason(error)), Frame(failure=reason(error))

    def _undeformed(self, points: FloatArray, told: ToldPose, inner: FloatArray) -> tuple[Frame, Frame]:
        motion, seconds, processor_s = IDENTITY, 0.0, 0.0
        if self._spec.kind == _ICP:
            brought = told.motion.undo(points)
            fit, seconds, processor_s = timed(
                lambda: rigid_icp(brought, self._organ.surface, overlap=COUNTED_SHARE)
            )
            motion = fit.motion
        where = told.motion.apply(motion.undo(inner))
        return (
            Frame(where, seconds=seconds, processor_s=processor_s),
            Frame(np.zeros_like(inner), seconds=seconds, processor_s=processor_s),
        )

    def _deformed(
        self, estimator: Estimator, points: FloatArray, told: ToldPose, inner: FloatArray
    ) -> tuple[Frame, Frame]:
        cloud, _ = make_bare_cloud(told.motion.undo(points), None, self._config)
        # The camera is the origin of the cloud's frame.
        camera = told.motion.undo(np.zeros((1, 3)))[0]
        cloud = replace(cloud, viewpoint=camera, registration_covariance=told.covariance)
        estimate, seconds, processor_s = timed(lambda: estimator.estimate_bare(cloud))
        displacement, sigma = estimate.displacement_at(inner)
        covariance, found = estimate.covariance_at(inner), estimate.diagnosis.registration
        where = inner + displacement
        if found is not None:
            where = found.correction.undo(where)
        spread = None if covariance is None else np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)
        degraded = int(bool(estimate.diagnosis.doubts))
        return (
            checked(Frame(told.motion.apply(where), spread, seconds, degraded, processor_s)),
            checked(Frame(displacement, sigma, seconds, degraded, processor_s)),
        )


def _config(spec: MethodSpec) -> EstimatorConfig:
    return EstimatorConfig(
        estimator=spec.kind if spec.kind in estimator_names() else EstimatorConfig().estimator,
        checkpoint=str(spec.checkpoint or ""),
        device=spec.device,
        tracking=False,
    )
