"""What estimators are told with a cloud: the pose of the organ and how exact it is, and what is not organ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_training.evaluation.clouds.cavity import ORGAN
from softtissue_training.evaluation.clouds.views import CloudView
from softtissue_training.evaluation.streams.wrong_pose import wrong_pose

FloatArray = NDArray[np.float64]

EXACT, SEGMENTED, FOUND = "exact", "segmented", "found"
_WRONG: Mapping[str, tuple[float, float]] = {"registration_2": (2.0, 0.003), "registration_5": (5.0, 0.010)}
"""Degrees and m."""
CONDITIONS = (EXACT, SEGMENTED, *_WRONG, FOUND)
"""Names of what estimators are told, in the order of tables."""


@dataclass(frozen=True, eq=False)
class ToldPose:
    """Where the organ is said to be.

    Attributes
    ----------
    motion
        From the organ's frame to the camera's.
    covariance
        (6, 6) of its error, as of `BareCloud.registration_covariance`.
    segmented
        Whether the points that are not organ are left out of the cloud, as a segmentation would.
    """

    motion: RigidMotion
    covariance: FloatArray
    segmented: bool = False

    def shown(self, view: CloudView) -> FloatArray:
        """Points (n, 3) m of a view that estimators are shown, camera's frame."""
        return view.points[view.label == ORGAN] if self.segmented else view.points

    def error_m(self, view: CloudView, points: FloatArray) -> float:
        """Mean distance by which it misplaces points (n, 3) m of the organ's frame."""
        apart = self.motion.apply(points) - exact_pose(view).apply(points)
        return float(np.linalg.norm(apart, axis=1).mean())


def exact_pose(view: CloudView) -> RigidMotion:
    """Return the motion from the organ's frame, in which what holds it has not moved, to the camera's."""
    camera = view.camera
    return RigidMotion(camera.rotation.T, -camera.position @ camera.rotation)


def told_poses(
    view: CloudView, centre: FloatArray, number: int, found: ToldPose | None
) -> dict[str, ToldPose]:
    """Return the poses that estimators are told with a view, by condition.

    Parameters
    ----------
    centre
        (3,) m, of the organ, about which poses are off.
    number
        Of the view among all: chooses the axis and the direction of an error.
    found
        By the search in this cloud; None where that is not to be told.
    """
    exact = exact_pose(view)
    told = {
        EXACT: ToldPose(exact, np.zeros((6, 6))),
        SEGMENTED: ToldPose(exact, np.zeros((6, 6)), segmented=True),
    }
    for name, (degrees, shift_m) in _WRONG.items():
        off = wrong_pose(number, centre, degrees=degrees, shift_m=shift_m)
        rotation = exact.rotation @ off.rotation.T
        motion = RigidMotion(rotation, exact.translation - rotation @ off.translation)
        told[name] = ToldPose(motion, np.diag(np.square([shift_m] * 3 + [np.radians(degrees)] * 3)))
    return told if found is None else told | {FOUND: found}
