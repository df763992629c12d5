"""A phantom case as a bag that the node can replay: the same observation in every frame, and the true markers."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np

from softtissue_training.experiments.phantom.experiment import PhantomRun
from softtissue_training.phantom.bag import BagWriter

FRAMES, RATE_HZ = 50, 5.0
_NOISE_SEED = 0


def write_case_bag(folder: Path, run: PhantomRun, frames: int = FRAMES) -> str:
    """Write the first variant of a case as a bag; returns how to replay it.

    Every frame shows the whole observation at the same state of the organ: exactly the one that the offline estimators
    were shown, or, where the case states a tracking noise, with fresh noise in every frame. Where all points have the
    same standard deviation they carry their correspondences themselves, else these come on a topic of their own.

    Raises
    ------
    InvalidInputError
        The folder exists and is not a bag, which would be lost.
    """
    case, observation = run.case, run.variants[0].observation
    noise = np.random.default_rng(_NOISE_SEED)
    alike = bool(np.ptp(observation.sigma) <= 1e-9)
    frame = case.organ.frame
    with BagWriter(folder, frame, frame) as writer:
        for number in range(frames):
            time = (number + 1) / RATE_HZ
            points = observation.reference + observation.displacement
            if case.tracking_noise_m > 0.0:
                points = points + noise.normal(0.0, case.tracking_noise_m, points.shape)
            if not alike:
                writer.correspondences(observation.reference, observation.sigma, time)
            writer.cloud(points, observation.reference if alike else None, time)
            writer.markers(case.markers.after, case.markers.before, time)
            if case.truth is not None and number == 0:
                writer.organ(case.truth.positions, time)
    sigma = float(observation.sigma[0])
    arguments = ["--bag", str(folder.resolve()), "--organ", str((case.organ.folder or Path()).resolve())]
    arguments += ["--estimator", "elastic", "--parameter", "tracking:=false"]
    arguments += ["--parameter", f"default_sigma_m:={sigma:.6g}"] if alike else []
    return (
        f"bag {folder} ({frames} frames of {run.variants[0].title}); replay it through the node:\n"
        f"make demo DEMO_ARGS={shlex.quote(shlex.join(arguments))}"
    )
