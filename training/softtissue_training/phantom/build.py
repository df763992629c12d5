"""The whole way from a seed to an organ folder and a bag."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume, face_areas
from softtissue_training.phantom.anatomy import Anatomy, build_anatomy, write_organ
from softtissue_training.phantom.bag import BagWriter
from softtissue_training.phantom.motion import Motion, simulate
from softtissue_training.phantom.sensor import choose_markers, endoscope_pose, record, visible_faces
from softtissue_training.phantom.spec import PhantomSpec

Array = NDArray[np.float64]
ORGAN_NAME = "phantom_liver"
BAG_NAME = "phantom"
_REGISTRATION_PERIOD_S = 1.0
_FRAMES_PER_TRUTH = 20


@dataclass(frozen=True)
class Phantom:
    """What was made, for reports and tests: anatomy, motion, and the markers' preoperative positions ``(k, 3)`` m."""

    anatomy: Anatomy
    motion: Motion
    markers: Array


def build_phantom(
    spec: PhantomSpec, folder: Path, progress: Callable[[str], None] = lambda _: None
) -> Phantom:
    """Make a phantom and write `organs/phantom_liver` and `bags/phantom` into `folder`.

    Each step has a random generator of its own, all from `spec.seed`, so that a change in one leaves the others'
    choices alone.
    """
    shape_rng, marker_rng, sensor_rng = np.random.default_rng(spec.seed).spawn(3)
    anatomy = build_anatomy(spec, shape_rng, progress)
    write_organ(anatomy, folder / "organs" / ORGAN_NAME, "Phantom liver")
    motion = simulate(anatomy, spec, progress)
    markers = choose_markers(anatomy, motion, spec, marker_rng)
    markers = markers.astype(np.float32).astype(np.float64)
    progress(f"recording {spec.frames} frames")
    _write_bag(Phantom(anatomy, motion, markers), spec, folder / "bags" / BAG_NAME, sensor_rng)
    return Phantom(anatomy, motion, markers)


def _write_bag(phantom: Phantom, spec: PhantomSpec, folder: Path, rng: np.random.Generator) -> None:
    anatomy, motion = phantom.anatomy, phantom.motion
    pose = endoscope_pose(anatomy.surface.vertices[anatomy.visible].mean(axis=0))
    points = anatomy.query_points
    weights = motion.interpolator.weights(points)
    peak = round((motion.peak_time - spec.first_frame) * spec.rate_hz)
    next_registration = 0.0
    with BagWriter(folder) as bag:
        for number, frame in enumerate(record(anatomy, motion, phantom.markers, pose, spec, rng)):
            while next_registration <= frame.time + 1e-9:
                bag.registration(pose, next_registration)
                next_registration += _REGISTRATION_PERIOD_S
            bag.frame(frame, phantom.markers)
            if number % _FRAMES_PER_TRUTH == 0 or number == peak:
                bag.organ(points + motion.at(weights, frame.time), frame.time)


def describe(phantom: Phantom, spec: PhantomSpec) -> str:
    """Report a phantom's measures, a line each, in millimetres, millilitres and per cent."""
    anatomy, motion = phantom.anatomy, phantom.motion
    surface = anatomy.surface
    areas = face_areas(surface)
    size = 1e3 * np.ptp(surface.vertices, axis=0)
    attached = anatomy.attached[surface.faces].all(axis=1)
    visible = areas[visible_faces(anatomy)].sum() / areas.sum()
    lines = [
        f"organ: {len(surface.faces)} triangles, {1e6 * enclosed_volume(surface):.0f} ml, "
        f"{size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm, {1e4 * areas.sum():.0f} cm^2",
        f"attached: {100 * areas[attached].sum() / areas.sum():.1f} % of the surface, visible: {100 * visible:.1f} %",
    ]
    lines += [_part_line(part.name, part.mesh) for part in anatomy.parts]
    moved = np.linalg.norm(motion.at(motion.interpolator.weights(surface.vertices), motion.peak_time), axis=1)
    lines.append(
        f"finite elements: {motion.displacement.shape[1]} nodes, {spec.states - 1} equilibria, "
        f"largest relative residual {motion.worst_residual:.1e}, largest imbalance of reaction and load "
        f"{motion.worst_imbalance:.1e} N of {np.linalg.norm(motion.forces, axis=1).max():.2f} N"
    )
    lines.append(
        f"peak at {motion.peak_time:.1f} s: surface moves {1e3 * moved.mean():.1f} mm on average, "
        f"{1e3 * moved.max():.1f} mm at most"
    )
    return "\n".join(lines + _marker_lines(phantom))


def _part_line(name: str, mesh: SurfaceMesh) -> str:
    return f"{name}: {len(mesh.vertices)} vertices, {1e6 * enclosed_volume(mesh):.1f} ml"


def _marker_lines(phantom: Phantom) -> list[str]:
    """One line a marker: motion at the peak, depth below the surface, distance from the visible patch."""
    anatomy, motion, markers = phantom.anatomy, phantom.motion, phantom.markers
    moved = np.linalg.norm(motion.at(motion.interpolator.weights(markers), motion.peak_time), axis=1)
    depth = np.asarray(cKDTree(anatomy.surface.vertices).query(markers)[0])
    hidden = np.asarray(cKDTree(anatomy.surface.vertices[anatomy.visible]).query(markers)[0])
    return [
        f"marker {i}: moves {1e3 * moved[i]:.1f} mm, {1e3 * depth[i]:.0f} mm below the surface, "
        f"{1e3 * hidden[i]:.0f} mm from the visible patch"
        for i in range(len(markers))
    ]
