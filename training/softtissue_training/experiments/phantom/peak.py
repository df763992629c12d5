"""Single bare clouds of the bundled phantom at its peak: errors at the markers, by what is wrong with the cloud.

`python -m softtissue_training.experiments.phantom.peak` prints the table. Every cloud is answered on its own.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.organ.organ import Organ, make_organ
from softtissue_estimator.view.rendering import vertex_normals
from softtissue_training.evaluation.streams.smooth_field import smooth_field, with_rms
from softtissue_training.evaluation.streams.wrong_pose import POSES, wrong_pose
from softtissue_training.experiments.paired_points import PairedPoints
from softtissue_training.experiments.phantom.bare import bare_cloud, loaded_estimator, registration_covariance
from softtissue_training.experiments.phantom.case import PhantomCase
from softtissue_training.experiments.phantom.own_case import own_phantom_case

FloatArray = NDArray[np.float64]

POSE_DEGREES, POSE_SHIFT_M = 5.0, 0.010
BIAS_M, BIAS_LENGTH_M = 0.002, 0.025
"""Error of a sensor that sees a resting organ bent, root mean square, and over which length it is shared."""
_BIASES = 4  # that are drawn


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (n, 3) m in the organ's frame as told, covariance (6, 6) of that, and the markers' displacement (k, 3) m.

    The covariance is None where nobody says it.
    """

    points: FloatArray
    covariance: FloatArray | None
    moved: FloatArray


@dataclass(frozen=True)
class Row:
    """Figures of all clouds of one condition; lengths in mm. The largest error is the mean over the clouds."""

    name: str
    clouds: int
    mean: float
    largest: float
    worst: float
    rms_z: float
    sigma_over_error: float
    answered: int


def registered_clouds(case: PhantomCase) -> Iterator[Cloud]:
    """Return what was seen, in a frame that is known exactly."""
    yield Cloud(_seen(case).after, _exact(), case.markers.displacement)


def misregistered_clouds(case: PhantomCase) -> Iterator[Cloud]:
    """Turn and shift the cloud about six axes and along six directions; how exact its pose is, is said."""
    points = _seen(case).after
    centre = points.mean(axis=0)
    covariance = registration_covariance(POSE_SHIFT_M, np.radians(POSE_DEGREES))
    for pose in range(POSES):
        motion = wrong_pose(pose, centre, degrees=POSE_DEGREES, shift_m=POSE_SHIFT_M)
        yield Cloud(motion.apply(points), covariance, case.markers.displacement)


def cut_clouds(case: PhantomCase, share: float) -> Iterator[Cloud]:
    """Keep a share of the cloud, from each of its four ends."""
    points = _seen(case).after
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    for direction in (along[0], -along[0], along[1], -along[1]):
        kept = np.argsort(points @ direction, kind="stable")[: round(share * len(points))]
        yield Cloud(points[kept], _exact(), case.markers.displacement)


def resting_clouds(case: PhantomCase) -> Iterator[Cloud]:
    """Show the organ at rest, bent by a smooth error of the sensor; how exact the registration is, nobody says."""
    surface, before = case.organ.surface, _seen(case).before
    normals = vertex_normals(surface)[cKDTree(surface.vertices).query(before)[1]]
    for seed in range(_BIASES):
        rng = np.random.default_rng([seed, 1])
        bias = with_rms(smooth_field(before, np.zeros(1), 1, BIAS_LENGTH_M, 1.0, rng)[0], BIAS_M)
        points = before + bias * normals + case.sigma_m * rng.normal(size=before.shape)
        yield Cloud(points, None, np.zeros_like(case.markers.displacement))


_CONDITIONS: dict[str, Callable[[PhantomCase], Iterator[Cloud]]] = {
    "pose known": registered_clouds,
    "pose off by 5 degrees and 10 mm, said to be": misregistered_clouds,
    "half the patch": lambda case: cut_clouds(case, 0.5),
    "a quarter of the patch": lambda case: cut_clouds(case, 0.25),
    "at rest, sensor off by 2 mm": resting_clouds,
    "attached nowhere": registered_clouds,
}
FREE = "attached nowhere"
"""Condition in which the estimator is not told what holds the organ."""


def rows(case: PhantomCase) -> Iterator[Row]:
    """Answer all clouds of all conditions."""
    held, free = loaded_estimator(case.organ), loaded_estimator(unattached(case.organ))
    for name, clouds in _CONDITIONS.items():
        yield measure(name, free if name == FREE else held, case, list(clouds(case)))


def unattached(organ: Organ) -> Organ:
    """Return an organ of which nobody says where it is attached."""
    nowhere = np.zeros(len(organ.surface.vertices), dtype=np.bool_)
    return make_organ(
        organ.name,
        organ.frame,
        organ.surface,
        organ.structures,
        nowhere,
        organ.folder,
        organ.system,
        organ.tetrahedra,
    )


def measure(name: str, estimator: ElasticEstimator, case: PhantomCase, clouds: list[Cloud]) -> Row:
    """Answer some clouds and compare the answers with where the markers went."""
    errors, sigmas = [], []
    for cloud in clouds:
        try:
            estimate = estimator.estimate_bare(bare_cloud(cloud.points, case.sigma_m, cloud.covariance))
        except SoftTissueError:
            continue
        displacement, sigma = estimate.displacement_at(case.markers.before)
        errors.append(1e3 * np.linalg.norm(displacement - cloud.moved, axis=1))
        sigmas.append(np.full(len(errors[-1]), np.nan) if sigma is None else 1e3 * sigma)
    if not errors:
        nothing = float("nan")
        return Row(name, len(clouds), nothing, nothing, nothing, nothing, nothing, 0)
    error, sigma_mm = np.stack(errors), np.stack(sigmas)
    component = float(np.sqrt(np.square(error).mean() / 3.0))
    return Row(
        name,
        clouds=len(clouds),
        mean=float(error.mean()),
        largest=float(error.max(axis=1).mean()),
        worst=float(error.max()),
        rms_z=float(np.sqrt(np.square(error / sigma_mm).mean() / 3.0)),
        sigma_over_error=float(sigma_mm.mean()) / component,
        answered=len(errors),
    )


def _seen(case: PhantomCase) -> PairedPoints:
    if case.correspondences is None:
        raise ValueError("expected a case with correspondences, got none")
    return case.correspondences


def _exact() -> FloatArray:
    return registration_covariance(0.0, 0.0)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    argparse.ArgumentParser(
        prog="python -m softtissue_training.experiments.phantom.peak",
        description="Answer single bare clouds of the bundled phantom; prints a table.",
    ).parse_args(arguments)
    print(
        "| cloud | TRE mean (mean of largest; largest), mm | rms z | mean sigma over rms error / sqrt(3) | answered |"
    )
    print("| --- | --- | --- | --- | --- |")
    for row in rows(own_phantom_case()):
        print(
            f"| {row.name} | {row.mean:.1f} ({row.largest:.1f}; {row.worst:.1f}) | {row.rms_z:.2f} | "
            f"{row.sigma_over_error:.2f} | {row.answered} of {row.clouds} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
