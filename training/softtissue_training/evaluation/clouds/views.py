"""A deformed organ as a stereo laparoscope sees it from somewhere: a bare cloud in its frame, and the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas
from softtissue_training.evaluation.clouds.cavity import ORGAN, surround
from softtissue_training.phantom.pose import Pose
from softtissue_training.scene.camera import StereoCamera
from softtissue_training.scene.sensor import StereoSensor
from softtissue_training.scene.view import see
from softtissue_training.scene.world import Moment
from softtissue_training.simulation.sample import Sample

FloatArray = NDArray[np.float64]

CAMERA = StereoCamera(columns=320, rows=240, focal=280.0, disparity_noise=0.10, disparity_bias=0.125)
"""Half the pixels of the default and the same errors in space."""
_GLANCE = replace(CAMERA, columns=80, rows=60, focal=70.0)
_GLANCE_ERROR = 0.05  # of shares
_DISTANCE_M = (0.080, 0.190)
_AIM_ASIDE_M = 0.030
_TRIES = 200


@dataclass(frozen=True)
class ViewLimits:
    """Which views are taken.

    Attributes
    ----------
    visible_share
        Of the organ's surface.
    least_organ_share
        Of the cloud's points.
    points
        At most, of a cloud.
    """

    visible_share: tuple[float, float] = (0.20, 0.40)
    least_organ_share: float = 0.5
    points: int = 4000


@dataclass(frozen=True, eq=False)
class CloudView:
    """A bare cloud and what it shows.

    Attributes
    ----------
    points
        (n, 3) m, camera's optical frame.
    label
        (n,) of each point: `cavity.ORGAN` and so on.
    camera
        Pose in the organ's frame.
    visible
        (m,) true for the faces of the organ's surface that are seen.
    visible_share
        Of the organ's surface.
    """

    points: FloatArray
    label: NDArray[np.uint8]
    camera: Pose
    visible: NDArray[np.bool_]
    visible_share: float

    @property
    def foreign_share(self) -> float:
        """Share of the points that are not organ."""
        return float((self.label != ORGAN).mean())


def view_of(sample: Sample, rng: np.random.Generator, limits: ViewLimits | None = None) -> CloudView:
    """Look at a simulated organ from a random side.

    Raises
    ------
    InvalidInputError
        No view within the limits was found.
    """
    limits = limits or ViewLimits()
    rest = sample.surface
    organ = SurfaceMesh(rest.vertices + sample.displacement[: len(rest.vertices)], rest.faces)
    for _ in range(_TRIES):
        pose = _random_pose(organ, rng)
        scene = surround(organ, pose, rng)
        if not _is_promising(scene, pose, organ, limits):
            continue
        sensor = StereoSensor(CAMERA, rng, dropped=rng.uniform(0.02, 0.15))
        frame = sensor.look(scene, pose, 0.0)
        points, label = sensor.cloud(frame, limits.points)
        if len(points) < 500 or (label == ORGAN).mean() < limits.least_organ_share:
            continue
        visible = _visible(frame.view.triangle[frame.matched], organ)
        share = _share(visible, organ)
        if limits.visible_share[0] <= share <= limits.visible_share[1]:
            return CloudView(points, label, pose, visible, share)
    raise InvalidInputError(f"simulated organ {sample.seed}: expected a view within {limits}, got none")


def _random_pose(organ: SurfaceMesh, rng: np.random.Generator) -> Pose:
    """Draw a camera that looks at the organ from outside, turned anyhow."""
    axes = Rotation.random(random_state=rng).as_matrix()
    forward = axes[:, 2]
    aim = organ.vertices.mean(axis=0) + axes[:, :2] @ rng.normal(0.0, _AIM_ASIDE_M, 2)
    nearest = float(((organ.vertices - aim) @ -forward).max())
    return Pose(axes, aim - (nearest + rng.uniform(*_DISTANCE_M)) * forward)


def _is_promising(scene: Moment, pose: Pose, organ: SurfaceMesh, limits: ViewLimits) -> bool:
    """Look with few pixels whether a view may be within the limits."""
    seen = see(scene, pose, _GLANCE).triangle
    seen = seen[seen >= 0]
    if len(seen) == 0 or (scene.label[seen] == ORGAN).mean() < limits.least_organ_share - _GLANCE_ERROR:
        return False
    low, high = limits.visible_share
    return low - _GLANCE_ERROR <= _share(_visible(seen, organ), organ) <= high + _GLANCE_ERROR


def _visible(seen: NDArray[np.int64], organ: SurfaceMesh) -> NDArray[np.bool_]:
    """Which faces of the organ, (m,), are among the triangles (n,) of the scene, of which its own come first."""
    visible = np.zeros(len(organ.faces), dtype=bool)
    visible[seen[seen < len(organ.faces)]] = True
    return visible


def _share(visible: NDArray[np.bool_], organ: SurfaceMesh) -> float:
    """Share of the organ's area whose faces (m,) are visible."""
    area = face_areas(organ)
    return float(area[visible].sum() / area.sum())
