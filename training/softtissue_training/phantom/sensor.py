"""What a tracking endoscope observes of the moving organ, and what is true at the same moments."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.phantom.anatomy import Anatomy
from softtissue_training.phantom.motion import Motion
from softtissue_training.phantom.pose import Pose
from softtissue_training.phantom.spec import PhantomSpec
from softtissue_training.phantom.vessels import interior_points

Array = NDArray[np.float64]
CLOUD_FRAME = "endoscope"
_CAMERA_POSITION_M = (0.02, -0.19, -0.09)  # organ frame
_MARKER_DEPTH_M = 0.010  # below the surface
_DEEP_MARKER_DEPTH_M = 0.022  # below the surface


@dataclass(frozen=True)
class Frame:
    """One moment of the recording.

    Attributes
    ----------
    time
        s since the start.
    points
        (n, 3) m, endoscope's frame, with noise.
    reference
        (n, 3) m, organ's frame: where each point was before the operation, exactly.
    markers
        (k, 3) m, organ's frame: true positions.
    """

    time: float
    points: Array
    reference: Array
    markers: Array


def endoscope_pose(target: Array) -> Pose:
    """Pose of the organ seen from the endoscope, whose z axis looks at `target` (3,) m and whose y axis points down."""
    position = np.array(_CAMERA_POSITION_M)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, np.array([0.0, 0.0, 1.0]))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ position)


def choose_markers(anatomy: Anatomy, motion: Motion, spec: PhantomSpec, rng: np.random.Generator) -> Array:
    """Pick material points ``(k, 3)`` m inside the organ, far from one another, that move as far as required.

    The range is `spec.marker_motion` at the peak; all lie at least 10 mm below the surface. The first is the one
    farthest from the visible patch; every second one lies at least 22 mm deep.

    Raises
    ------
    InvalidInputError
        If fewer such points are found than markers are required.
    """
    points = interior_points(anatomy.shape, anatomy.shape.box, _MARKER_DEPTH_M, 4000, rng)
    moved = np.linalg.norm(motion.at(motion.interpolator.weights(points), motion.peak_time), axis=1)
    lowest, highest = spec.marker_motion
    points = points[(moved >= lowest) & (moved <= highest)]
    deep = anatomy.shape(points) < -_DEEP_MARKER_DEPTH_M
    if len(points) < spec.markers or np.count_nonzero(deep) < spec.markers // 2:
        raise InvalidInputError(
            f"expected {spec.markers} inner points that move {1e3 * lowest:g} to {1e3 * highest:g} mm at the peak, "
            f"got {len(points)}, {np.count_nonzero(deep)} of them deep; change the push "
            f"(motions reach {1e3 * moved.max():.1f} mm)"
        )
    hidden = cKDTree(anatomy.surface.vertices[anatomy.visible]).query(points)[0]
    chosen = [int(np.argmax(hidden))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < spec.markers:
        allowed = deep if len(chosen) % 2 == 1 else np.ones(len(points), dtype=bool)
        chosen.append(int(np.argmax(np.where(allowed, distance, -np.inf))))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    markers: Array = points[chosen]
    return markers


def visible_faces(anatomy: Anatomy) -> NDArray[np.int64]:
    """Numbers of the surface triangles whose three corners are visible."""
    return np.flatnonzero(anatomy.visible[anatomy.surface.faces].all(axis=1))


def record(
    anatomy: Anatomy, motion: Motion, markers: Array, pose: Pose, spec: PhantomSpec, rng: np.random.Generator
) -> Iterator[Frame]:
    """Yield the frames: points drawn anew in each, evenly over the deformed visible surface."""
    surface_weights = motion.interpolator.weights(anatomy.surface.vertices)
    marker_weights = motion.interpolator.weights(markers)
    faces = anatomy.surface.faces[visible_faces(anatomy)]
    for number in range(spec.frames):
        time = spec.first_frame + number / spec.rate_hz
        deformed = anatomy.surface.vertices + motion.at(surface_weights, time)
        reference = _draw(SurfaceMesh(deformed, faces), anatomy.surface.vertices, spec.points_per_frame, rng)
        # The bag holds single precision; the truth is the position of exactly the stored reference point.
        reference = reference.astype(np.float32).astype(np.float64)
        now = reference + motion.at(motion.interpolator.weights(reference), time)
        noise = rng.normal(0.0, spec.noise, reference.shape)
        yield Frame(time, pose.outer(now) + noise, reference, markers + motion.at(marker_weights, time))


def _draw(deformed: SurfaceMesh, rest: Array, count: int, rng: np.random.Generator) -> Array:
    """Undeformed positions ``(count, 3)`` m of points spread evenly over the deformed triangles."""
    corners = deformed.triangles
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = rng.choice(len(area), size=count, p=area / area.sum())
    first, second = rng.random(count), rng.random(count)
    fold = first + second > 1.0
    first, second = np.where(fold, 1.0 - first, first), np.where(fold, 1.0 - second, second)
    weights = np.stack([1.0 - first - second, first, second], axis=1)
    return np.asarray(np.einsum("kc,kcd->kd", weights, rest[deformed.faces[face]]))
