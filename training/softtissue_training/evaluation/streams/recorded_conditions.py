"""What is wrong with the input in each condition of the suite `bag`: those of moving organs, and some of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from softtissue_training.evaluation.streams.conditions import (
    FIELD_LENGTH_M,
    WANDER_S,
    Clouds,
    Condition,
    drift,
    exact,
    outliers,
    registration,
)
from softtissue_training.evaluation.streams.recording import Recording
from softtissue_training.evaluation.streams.smooth_field import draw_field, with_rms
from softtissue_training.simulation.boundary_conditions import random_direction


def patch(stream: Recording, rng: np.random.Generator, pose: int, *, share: float, shift_m: float) -> Clouds:
    """Shift the points nearest to a place of the preoperative surface by one vector, the same one in all frames."""
    place = stream.reference[0][rng.choice(np.flatnonzero(stream.seen[0]))]
    shift = shift_m * random_direction(rng)
    points = stream.points.copy()
    for cloud, reference, seen in zip(points, stream.reference, stream.seen, strict=True):
        # Points that are not there are sorted behind all others.
        order = np.argsort(((reference - place) ** 2).sum(axis=1), kind="stable")
        cloud[order[: round(share * seen.sum())]] += shift
    return replace(exact(stream, rng, pose), points=points)


def stray(stream: Recording, rng: np.random.Generator, pose: int, *, rms_m: float) -> Clouds:
    """Let matches wander: add an error in any direction that is smooth over the surface and in time."""
    field = draw_field(3, FIELD_LENGTH_M, WANDER_S, rng)
    moments = stream.times[:, None]
    off = [field.at(where, when)[0] for where, when in zip(stream.reference, moments, strict=True)]
    return replace(exact(stream, rng, pose), points=stream.points + with_rms(np.stack(off), rms_m))


def bare(stream: Recording, rng: np.random.Generator, pose: int) -> Clouds:
    """Keep the points alone, not where they were before."""
    return replace(exact(stream, rng, pose), bare=True)


def bare_registration(
    stream: Recording, rng: np.random.Generator, pose: int, *, degrees: float, shift_m: float
) -> Clouds:
    """Keep the points alone, turned and shifted; how exact the registration is, is said as a covariance."""
    off = registration(stream, rng, pose, degrees=degrees, shift_m=shift_m)
    return replace(off, bare=True, registration_sigma=(shift_m, np.radians(degrees)))


RECORDED_CONDITIONS: Mapping[str, Condition[Recording]] = {
    "exact": exact,
    "registration_2": partial(registration, degrees=2.0, shift_m=0.003),
    "registration_5": partial(registration, degrees=5.0, shift_m=0.010),
    "outliers_5": partial(outliers, share=0.05),
    "outliers_20": partial(outliers, share=0.20),
    "outliers_40": partial(outliers, share=0.40),
    "patch_20": partial(patch, share=0.20, shift_m=0.017),
    "drift_6": partial(drift, end_m=0.006),
    "stray_4": partial(stray, rms_m=0.004),
    "bare": bare,
    "bare_registration_5": partial(bare_registration, degrees=5.0, shift_m=0.010),
}
