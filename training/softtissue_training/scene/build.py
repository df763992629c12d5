"""The whole way from a seed to a bag."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.organ.mesh import face_areas
from softtissue_training.phantom.anatomy import Anatomy, build_anatomy
from softtissue_training.phantom.motion import Motion
from softtissue_training.phantom.pose import Pose
from softtissue_training.phantom.sensor import choose_markers
from softtissue_training.scene.bag import SceneWriter
from softtissue_training.scene.camera import CameraPath, StereoCamera
from softtissue_training.scene.motion import simulate_scene
from softtissue_training.scene.picture import Painter
from softtissue_training.scene.sensor import Frame, StereoSensor
from softtissue_training.scene.spec import SceneSpec
from softtissue_training.scene.surroundings import build_surroundings
from softtissue_training.scene.tracks import Tracker
from softtissue_training.scene.world import ORGAN, World

Array = NDArray[np.float64]
BAG_NAME = "laparoscope"
_ORGAN_POSE_PERIOD_S = 1.0
_FRAMES_PER_TRUTH = 20
# The organ's frame (left, back, head) in the room (head, right, up), m: a patient lies on the back on a table.
_LYING = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_TABLE_M = (0.35, -0.20, 1.05)
_TILT_RAD, _SHIFT_M = 0.15, 0.05


@dataclass(frozen=True)
class FrameFigures:
    """What is reported of a frame.

    Attributes
    ----------
    time
        s.
    points, foreign
        Of the cloud: all, and those that are not on the organ.
    depth, bias
        m, of the points on the organ: median of their depths, and root mean square of their smooth error in depth.
    visible
        Share of the organ's surface in the image.
    moved
        m, mean displacement of the organ's surface.
    tracks
        Numbers of the followed features.
    """

    time: float
    points: int
    foreign: int
    depth: float
    bias: float
    visible: float
    moved: float
    tracks: NDArray[np.uint32]


@dataclass(frozen=True)
class Scene:
    """What was made, for reports and tests.

    Attributes
    ----------
    world
        All surfaces at any time.
    room
        Pose of the organ's frame in the room.
    markers
        (k, 3) m, preoperative positions.
    """

    world: World
    camera: StereoCamera
    path: CameraPath
    room: Pose
    markers: Array


def build_scene(
    spec: SceneSpec, folder: Path, progress: Callable[[str], None] = lambda _: None
) -> tuple[Scene, list[FrameFigures]]:
    """Make a scene of the phantom with the same seed and write `bags/laparoscope` into `folder`."""
    anatomy = build_anatomy(spec.phantom, _generators(spec)[0], progress)
    motion = simulate_scene(anatomy, spec, progress)
    return record_scene(anatomy, motion, spec, folder / "bags" / BAG_NAME, progress)


def record_scene(
    anatomy: Anatomy,
    motion: Motion,
    spec: SceneSpec,
    folder: Path,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[Scene, list[FrameFigures]]:
    """Put an organ that moves into its surroundings and record what the laparoscope sees into the bag `folder`."""
    _, around, marker, sensor, track, texture, room = _generators(spec)
    progress("surroundings")
    neighbours = build_surroundings(anatomy.shape, anatomy.surface, spec.neighbour_spacing, around)
    markers = choose_markers(anatomy, motion, spec.phantom, marker)
    markers = markers.astype(np.float32).astype(np.float64)
    scene = Scene(
        World(anatomy, motion, neighbours, spec), spec.camera, CameraPath(), random_room(room), markers
    )
    eyes = StereoSensor(spec.camera, sensor)
    tracker = Tracker(eyes, spec.tracks, track)
    with SceneWriter(folder) as bag:
        recorder = _Recorder(scene, spec, bag, Painter(texture))
        return scene, list(recorder.frames(eyes, tracker, progress))


def random_room(rng: np.random.Generator) -> Pose:
    """Draw the pose of the organ's frame in the room: on a table that is tilted a little."""
    tilt = Rotation.from_rotvec(rng.uniform(-_TILT_RAD, _TILT_RAD, 3)).as_matrix()
    return Pose(tilt @ _LYING, np.array(_TABLE_M) + rng.uniform(-_SHIFT_M, _SHIFT_M, 3))


def _generators(spec: SceneSpec) -> list[np.random.Generator]:
    """One for each step, so that a change in one leaves the others' choices alone; the first makes the phantom."""
    shape, _, _, *others = np.random.default_rng(spec.phantom.seed).spawn(9)
    return [shape, *others]


def _bias_of(points: Array, eyes: StereoSensor, time: float) -> float:
    """Root mean square (m) of the smooth error of points ``(n, 3)`` m in depth."""
    camera = eyes.camera
    error = eyes.bias(camera.project(points)[:, :2], time)
    return float(np.sqrt(np.mean((points[:, 2] ** 2 * error / (camera.focal * camera.baseline)) ** 2)))


class _Recorder:
    """Writes the scene's frames, each with all that belongs to its time."""

    def __init__(self, scene: Scene, spec: SceneSpec, bag: SceneWriter, painter: Painter) -> None:
        self._scene, self._spec, self._bag, self._painter = scene, spec, bag, painter
        motion, anatomy = scene.world.motion, scene.world.anatomy
        self._points = anatomy.query_points
        self._weights = motion.interpolator.weights(self._points)
        self._marker_weights = motion.interpolator.weights(scene.markers)
        self._poses, self._organ_poses = 0, 0

    def frames(
        self, eyes: StereoSensor, tracker: Tracker, progress: Callable[[str], None]
    ) -> Iterator[FrameFigures]:
        """Record frame after frame and say what is in each."""
        spec, scene = self._spec, self._scene
        images = round(spec.rate_hz / spec.image_rate_hz)
        peak = round((scene.world.motion.peak_time - spec.first_frame) * spec.rate_hz)
        for number in range(spec.frames):
            time = spec.first_frame + number / spec.rate_hz
            frame = eyes.look(scene.world.at(time), scene.path.at(time), time)
            self._write_poses(time)
            if number % images == 0:
                self._bag.image(
                    self._painter.jpeg(frame.moment, frame.pose, scene.camera), scene.camera, time
                )
            points, labels = eyes.cloud(frame, spec.points)
            tracked = tracker.follow(frame)
            self._bag.cloud(points, labels, time)
            self._bag.tracks(tracked, time)
            self._write_truth(time, number % _FRAMES_PER_TRUTH == 0 or number == peak)
            if number % 10 == 0:
                progress(f"frame {number + 1} of {spec.frames}")
            yield FrameFigures(
                time,
                len(points),
                int(np.count_nonzero(labels != ORGAN)),
                float(np.median(points[labels == ORGAN, 2])),
                _bias_of(points[labels == ORGAN], eyes, time),
                *self._organ_figures(frame),
                tracked.id,
            )

    def _write_poses(self, time: float) -> None:
        """Write the poses that are due up to a time (s)."""
        while self._organ_poses * _ORGAN_POSE_PERIOD_S <= time + 1e-9:
            self._bag.organ_pose(self._scene.room, self._organ_poses * _ORGAN_POSE_PERIOD_S)
            self._organ_poses += 1
        while self._poses / self._spec.pose_rate_hz <= time + 1e-9:
            due = self._poses / self._spec.pose_rate_hz
            self._bag.camera_pose(self._scene.path.at(due).within(self._scene.room), due)
            self._poses += 1

    def _write_truth(self, time: float, whole: bool) -> None:
        motion, markers = self._scene.world.motion, self._scene.markers
        self._bag.markers(markers + motion.at(self._marker_weights, time), markers, time)
        if whole:
            self._bag.organ(self._points + motion.at(self._weights, time), time)

    def _organ_figures(self, frame: Frame) -> tuple[float, float]:
        """Share of the organ's surface that is seen, and its mean displacement (m)."""
        surface = self._scene.world.anatomy.surface
        seen = np.unique(frame.view.triangle[frame.view.seen])
        seen = seen[frame.moment.label[seen] == ORGAN]
        areas = face_areas(surface)
        moved = frame.moment.part(ORGAN).vertices - surface.vertices
        return float(areas[seen].sum() / areas.sum()), float(np.linalg.norm(moved, axis=1).mean())
