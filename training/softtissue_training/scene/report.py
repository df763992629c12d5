"""What a scene holds, in lines of figures."""

import numpy as np

from softtissue_training.scene.build import FrameFigures, Scene
from softtissue_training.scene.spec import SceneSpec

_DEPTHS_M = (0.08, 0.12, 0.16, 0.20)


def describe(scene: Scene, figures: list[FrameFigures], spec: SceneSpec) -> str:
    """Report a scene's measures, a line each, in millimetres and per cent."""
    motion = scene.world.motion
    foreign = 100.0 * np.array([one.foreign / one.points for one in figures])
    visible = 100.0 * np.array([one.visible for one in figures])
    depth = 1e3 * np.array([one.depth for one in figures])
    moved = 1e3 * np.array([one.moved for one in figures])
    points = np.array([one.points for one in figures])
    bias = 1e3 * np.array([one.bias for one in figures])
    noise = 1e3 * scene.camera.noise_at(np.array(_DEPTHS_M))
    return "\n".join(
        [
            f"finite elements: {motion.displacement.shape[1]} nodes, {spec.states - 1} equilibria, "
            f"largest relative residual {motion.worst_residual:.1e}",
            f"organ: its surface moves {_span(moved)} mm on average, {_span(visible)} % of it is in the image",
            f"clouds: {len(figures)} of {points.min()} to {points.max()} points, {_span(foreign)} % not on the organ",
            f"depth of the organ: median {_span(depth)} mm; smooth error {_span(bias)} mm (rms); noise "
            + ", ".join(f"{n:.2f} mm at {1e3 * d:.0f} mm" for n, d in zip(noise, _DEPTHS_M, strict=True)),
            _tracks_line(figures),
            _marker_line(scene),
        ]
    )


def _span(values: np.ndarray) -> str:
    return f"{values.mean():.1f} ({values.min():.1f} to {values.max():.1f})"


def _tracks_line(figures: list[FrameFigures]) -> str:
    number = np.array([len(one.tracks) for one in figures])
    every, seen = np.unique(np.concatenate([one.tracks for one in figures]), return_counts=True)
    return (
        f"tracks: {_span(number)} at a time, {len(every)} in all, each in {np.median(seen):.0f} clouds (median), "
        f"the longest in {seen.max()}"
    )


def _marker_line(scene: Scene) -> str:
    motion = scene.world.motion
    weights = motion.interpolator.weights(scene.markers)
    moved = 1e3 * np.linalg.norm(motion.at(weights, motion.peak_time), axis=1)
    return (
        f"markers: at {motion.peak_time:.1f} s they have moved "
        + ", ".join(f"{m:.1f}" for m in moved)
        + " mm"
    )
