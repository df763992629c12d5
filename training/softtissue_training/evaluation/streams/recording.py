"""A recorded stream with markers whose true positions are known, as the suite `bag` shows it to estimators."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.organ import Organ
from softtissue_training.evaluation.streams.stream import Stream
from softtissue_training.phantom.bag import MARKERS_TOPIC, POINTS_TOPIC
from softtissue_training.phantom.message_writer import folder_digest
from softtissue_training.phantom.recorded import read_recorded

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_SAME_PLACE_M = 1e-6
_LEAST_FRAMES = 4  # so that each quarter has one


@dataclass(frozen=True, eq=False)
class Recording:
    """Everything about a recorded stream, in metres and the organ's frame.

    Attributes
    ----------
    name
        Of the organ.
    organ
        With the attached region that its folder names.
    times
        (f,) s, stamps of the clouds from the first one on.
    reference
        (f, k, 3) preoperative positions of the points of each cloud; NaN beyond a cloud's last point.
    points
        (f, k, 3) where they are observed.
    inner
        (p, 3) preoperative positions of the markers.
    truth
        (f, p, 3) their displacement.
    """

    name: str
    organ: Organ
    times: FloatArray
    reference: FloatArray
    points: FloatArray
    inner: FloatArray
    truth: FloatArray
    number: int = 0
    volume: None = None
    told_noise_m: None = None

    @property
    def seen(self) -> BoolArray:
        """Which points are in each cloud, (f, k)."""
        return np.asarray(np.isfinite(self.points).all(axis=2))

    @property
    def interval_s(self) -> float:
        """Between two clouds."""
        return float(np.median(np.diff(self.times)))

    @property
    def centre(self) -> FloatArray:
        """Middle of the points of the first cloud, (3,) m."""
        return np.asarray(np.nanmean(self.points[0], axis=0))

    @property
    def depth(self) -> FloatArray:
        """Distance of the markers to the nearest point that is ever observed, before anything moved, (p,) m."""
        return np.asarray(cKDTree(self.reference[self.seen]).query(self.inner)[0])


AnyStream: TypeAlias = Stream | Recording


def read_recording(bag: Path, organ: Organ, step: int = 1) -> Recording:
    """Read the clouds of a bag that have true markers.

    Parameters
    ----------
    bag
        Of the layout of the bundled one.
    organ
        What it shows.
    step
        Take every so many clouds.

    Raises
    ------
    InvalidInputError
        It cannot be read, has too few clouds with markers, or its markers are not the same ones in all of them.
    """
    found = read_recorded(bag)
    clouds, markers = found.clouds[POINTS_TOPIC], found.clouds[MARKERS_TOPIC]
    stamps = sorted(clouds.keys() & markers.keys())[::step]
    if len(stamps) < _LEAST_FRAMES:
        raise InvalidInputError(
            f"bag {bag}: expected at least {_LEAST_FRAMES} clouds on {POINTS_TOPIC} with markers of the same stamp on "
            f"{MARKERS_TOPIC}, got {len(stamps)}"
        )
    known = [markers[stamp] for stamp in stamps]
    before = known[0][:, 3:]
    if any(one.shape != known[0].shape or np.abs(one[:, 3:] - before).max() > _SAME_PLACE_M for one in known):
        raise InvalidInputError(f"bag {bag}: expected the same markers in every message on {MARKERS_TOPIC}")
    return Recording(
        organ.name,
        organ,
        1e-9 * (np.array(stamps) - stamps[0]),
        _padded([clouds[stamp][:, 3:] for stamp in stamps]),
        _padded([found.registration(stamp).undo(clouds[stamp][:, :3]) for stamp in stamps]),
        before,
        np.stack([one[:, :3] - one[:, 3:] for one in known]),
    )


def bag_digest(bag: Path) -> str:
    """Return the SHA-256 of a bag, a folder or a file.

    Raises
    ------
    InvalidInputError
        There is none.
    """
    if bag.is_dir():
        return folder_digest(bag)
    if not bag.is_file():
        raise InvalidInputError(f"bag {bag}: expected a bag folder, .mcap or .db3 file, got nothing there")
    return hashlib.sha256(bag.read_bytes()).hexdigest()


def _padded(clouds: Sequence[FloatArray]) -> FloatArray:
    """Stack clouds (n, 3) of different sizes, (f, k, 3), with NaN behind the smaller ones."""
    stacked = np.full((len(clouds), max(map(len, clouds)), 3), np.nan)
    for row, cloud in zip(stacked, clouds, strict=True):
        row[: len(cloud)] = cloud
    return stacked
