"""What is wrong with the input in each condition of the suite: pure functions of the clean stream and a generator.

Nothing about the condition is told to estimators, but for the attached region, which is what the condition is about.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from softtissue_estimator.organ.mesh import vertex_areas
from softtissue_training.evaluation.streams.recording import AnyStream
from softtissue_training.evaluation.streams.smooth_field import smooth_field, with_rms
from softtissue_training.evaluation.streams.stream import Stream
from softtissue_training.evaluation.streams.wrong_pose import wrong_pose
from softtissue_training.organs.surface_patch import random_vertex, resized, surface_distance
from softtissue_training.simulation.boundary_conditions import random_direction

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

OUTLIER_M = 0.030
"""Standard deviation of each component of an outlier's error."""
INSTRUMENT_M = (0.010, 0.030)
"""How far an instrument is from the surface that it is taken for."""
FIELD_LENGTH_M, WANDER_S = 0.025, 2.0
"""Correlation of matches that wander and of the sensor's error, along the surface and in time."""
OCCLUDED_S = (4.0, 6.0)
JUMP_S = 3.0
"""How much of the motion happens between the two frames of a jump."""
JUMP_RANGE_S = (2.0, 4.5)
_INSTRUMENT_STAY_S, _INSTRUMENT_PERIOD_S = 2.5, 4.0
_REGION_DRAWS = 30


@dataclass(frozen=True, eq=False)
class Clouds:
    """The clouds of a stream as they arrive.

    Attributes
    ----------
    reference
        Preoperative positions that the points are said to have had, m: (k, 3) of all clouds, or (f, k, 3).
    points
        (f, k, 3) m.
    seen
        (f, k) false for points that are not in a cloud.
    frames
        (f,) the frame of the stream that each cloud shows.
    attached
        (v,) the region that estimators are told.
    event
        Index of the first cloud after what the condition is about has happened; None where it never ends.
    bare
        Whether the points come without their preoperative positions.
    registration_sigma
        Standard deviations (m, rad) of the registration's error that estimators are told; None where they are not.
    """

    reference: FloatArray
    points: FloatArray
    seen: BoolArray
    frames: IntArray
    attached: BoolArray
    event: int | None = None
    bare: bool = False
    registration_sigma: tuple[float, float] | None = None

    def said(self, number: int) -> FloatArray:
        """Return the preoperative positions of the points of a cloud, (k, 3) m."""
        return self.reference if self.reference.ndim == 2 else self.reference[number]


StreamT = TypeVar("StreamT", bound=AnyStream)
Condition = Callable[[StreamT, np.random.Generator, int], Clouds]
"""Of a stream, a generator and the number of a pose, which only some conditions need."""


def exact(stream: AnyStream, rng: np.random.Generator, pose: int) -> Clouds:
    """Change nothing: the stream with its noise."""
    return Clouds(
        stream.reference,
        stream.points,
        stream.seen,
        np.arange(len(stream.times)),
        stream.organ.attached,
    )


def registration(
    stream: AnyStream, rng: np.random.Generator, pose: int, *, degrees: float, shift_m: float
) -> Clouds:
    """Turn all clouds about the stream's centre and shift them, the same way in every frame."""
    motion = wrong_pose(pose, stream.centre, degrees=degrees, shift_m=shift_m)
    return replace(exact(stream, rng, pose), points=motion.apply(stream.points))


def outliers(stream: AnyStream, rng: np.random.Generator, pose: int, *, share: float) -> Clouds:
    """Put a share of the points, others in every frame, anywhere around where they are."""
    points = stream.points.copy()
    count = round(share * points.shape[1])
    for cloud in points:
        wrong = rng.choice(len(cloud), size=count, replace=False)
        cloud[wrong] += rng.normal(scale=OUTLIER_M, size=(count, 3))
    return replace(exact(stream, rng, pose), points=points)


def instrument(stream: Stream, rng: np.random.Generator, pose: int, *, share: float) -> Clouds:
    """Shift the points nearest to a place that moves over the surface, all by one vector, as an instrument would.

    The vector points towards the camera or sideways, never into the organ; its length swings between the ends of
    `INSTRUMENT_M`.
    """
    times = stream.times
    count = round(share * len(stream.reference))
    visits = rng.choice(len(stream.reference), size=2 + int(times[-1] / _INSTRUMENT_STAY_S))
    knots = _INSTRUMENT_STAY_S * np.arange(len(visits))
    path = CubicSpline(knots, stream.reference[visits])(times)
    towards = -stream.viewing_direction
    direction = random_direction(rng)
    direction = direction + max(0.0, -2.0 * float(direction @ towards)) * towards
    middle, swing = np.mean(INSTRUMENT_M), 0.5 * np.ptp(INSTRUMENT_M)
    phase = 2.0 * np.pi * times / _INSTRUMENT_PERIOD_S + rng.uniform(0.0, 2.0 * np.pi)
    length = middle + swing * np.sin(phase)
    points = stream.points.copy()
    for cloud, place, distance in zip(points, path, length, strict=True):
        # Around a point of the surface, so that the patch is one piece.
        nearest = stream.reference[np.argmin(((stream.reference - place) ** 2).sum(axis=1))]
        patch = np.argsort(((stream.reference - nearest) ** 2).sum(axis=1), kind="stable")[:count]
        cloud[patch] += distance * direction
    return replace(exact(stream, rng, pose), points=points)


def drift(stream: AnyStream, rng: np.random.Generator, pose: int, *, end_m: float) -> Clouds:
    """Shift all points by one translation that grows evenly with time."""
    grown = end_m * (stream.times - stream.times[0]) / np.ptp(stream.times)
    shift = grown[:, None] * random_direction(rng)
    return replace(exact(stream, rng, pose), points=stream.points + shift[:, None])


def wander(stream: Stream, rng: np.random.Generator, pose: int, *, rms_m: float) -> Clouds:
    """Let matches slide along the surface: what is seen is another point of the tissue than the reference says.

    The reference stays; the material point that is observed slides over the preoperative surface along a smooth
    tangential field, and is observed where it really is.
    """
    field = smooth_field(stream.reference, stream.times, 3, FIELD_LENGTH_M, WANDER_S, rng)
    field -= (field * stream.normals).sum(axis=-1, keepdims=True) * stream.normals
    field = with_rms(field, rms_m)
    points = stream.present_by_frame(stream.reference + field)
    return replace(exact(stream, rng, pose), points=points + stream.noise)


def sensor(stream: Stream, rng: np.random.Generator, pose: int, *, rms_m: float) -> Clouds:
    """Add an error along the viewing direction that is smooth over the surface and constant in time."""
    field = with_rms(smooth_field(stream.reference, np.zeros(1), 1, FIELD_LENGTH_M, np.inf, rng), rms_m)
    return replace(exact(stream, rng, pose), points=stream.points + field * stream.viewing_direction)


def attached_resized(stream: Stream, rng: np.random.Generator, pose: int, *, share: float) -> Clouds:
    """Tell an attached region of another area, shrunk or grown along the surface."""
    told = resized(stream.organ.surface, stream.organ.attached, share)
    return replace(exact(stream, rng, pose), attached=told)


def attached_elsewhere(stream: Stream, rng: np.random.Generator, pose: int) -> Clouds:
    """Tell another region of the same area: of some drawn at random the one that overlaps the true one least."""
    surface, attached = stream.organ.surface, stream.organ.attached
    areas = vertex_areas(surface)
    best, least = attached, np.inf
    for _ in range(_REGION_DRAWS):
        order = np.argsort(surface_distance(surface, random_vertex(surface, rng)), kind="stable")
        count = 1 + int(np.argmin(np.abs(np.cumsum(areas[order]) - areas[attached].sum())))
        told = np.zeros_like(attached)
        told[order[:count]] = True
        overlap = float(areas[told & attached].sum())
        if overlap < least:
            best, least = told, overlap
        if least == 0.0:
            break
    return replace(exact(stream, rng, pose), attached=best)


def attached_unknown(stream: Stream, rng: np.random.Generator, pose: int) -> Clouds:
    """Tell no attached region."""
    return replace(exact(stream, rng, pose), attached=np.zeros_like(stream.organ.attached))


def occluded(stream: Stream, rng: np.random.Generator, pose: int) -> Clouds:
    """Hide the points on one side of a plane, half of them, for some time."""
    along = stream.reference @ random_direction(rng)
    hidden = np.zeros(len(along), dtype=bool)
    hidden[np.argsort(along, kind="stable")[: len(along) // 2]] = True
    start, end = OCCLUDED_S
    during = (stream.times >= start) & (stream.times < end)
    seen = ~(during[:, None] & hidden)
    return replace(exact(stream, rng, pose), seen=seen, event=int(np.searchsorted(stream.times, end)))


def jump(stream: Stream, rng: np.random.Generator, pose: int) -> Clouds:
    """Leave out `JUMP_S` of the motion where the points that are asked for change most by that."""
    skipped = round(JUMP_S / stream.settings.interval_s)
    first, last = np.searchsorted(stream.times, JUMP_RANGE_S)
    last = min(int(last), len(stream.times) - skipped - 1)
    first = min(int(first), last)
    change = np.array(
        [np.linalg.norm(stream.truth[i + skipped] - stream.truth[i - 1]) for i in range(first, last + 1)]
    )
    cut = first + int(change.argmax())
    kept = np.r_[0:cut, cut + skipped : len(stream.times)]
    whole = exact(stream, rng, pose)
    return replace(whole, points=whole.points[kept], seen=whole.seen[kept], frames=kept, event=cut)


CONDITIONS: Mapping[str, Condition[Stream]] = {
    "exact": exact,
    "registration_1": partial(registration, degrees=1.0, shift_m=0.001),
    "registration_2": partial(registration, degrees=2.0, shift_m=0.003),
    "registration_5": partial(registration, degrees=5.0, shift_m=0.010),
    "registration_10": partial(registration, degrees=10.0, shift_m=0.020),
    "outliers_5": partial(outliers, share=0.05),
    "outliers_20": partial(outliers, share=0.20),
    "outliers_40": partial(outliers, share=0.40),
    "instrument_10": partial(instrument, share=0.10),
    "instrument_20": partial(instrument, share=0.20),
    "drift_6": partial(drift, end_m=0.006),
    "wander_2": partial(wander, rms_m=0.002),
    "wander_4": partial(wander, rms_m=0.004),
    "sensor_2": partial(sensor, rms_m=0.002),
    "attached_30_less": partial(attached_resized, share=0.7),
    "attached_30_more": partial(attached_resized, share=1.3),
    "attached_elsewhere": attached_elsewhere,
    "attached_unknown": attached_unknown,
    "occluded": occluded,
    "jump": jump,
}
