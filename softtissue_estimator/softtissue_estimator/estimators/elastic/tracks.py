"""Where on an organ the points are that a tracker follows: learnt from the first answer that shows them.

A track's place is wrong by as much as that answer was, which its neighbours learn too; and what follows a point slides
along the surface as it gets older. So a track tells how an organ has moved since it was first seen, less and less.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from softtissue_estimator.observation.bare_cloud import NO_TRACK, BareCloud
from softtissue_estimator.observation.consensus import continuous
from softtissue_estimator.observation.patch_average import ObservedPatches, average_groups
from softtissue_estimator.organ.mesh import FloatArray, IntArray
from softtissue_estimator.organ.surface_lookup import SurfaceLookup

MEMORY_S = 5.0
"""After which a track that is not seen on the organ any more is forgotten."""
MOST_TRACKS = 100_000
"""That are remembered: those that were seen last."""
GATE_DEVIATIONS = 4.0
"""A track that is farther from its place follows something else now, and is learnt anew."""
SHARED_DEVIATIONS = 12.0
"""By which each patch's place is uncertain, over the uncertainty of the answer that it was learnt from: an answer is
wrong in the same way over 60 mm and more, where a hundred and fifty patches of 5 mm then tell no more than one."""


@dataclass(frozen=True, eq=False)
class _Known:
    """Tracks whose place on the organ is known, in the order of their numbers.

    Attributes
    ----------
    track : (t,) int64
    reference : (t, 3) m
        On the preoperative surface.
    sigma : (t,) m
        Standard deviation of each component when it was learnt.
    since_s, seen_s : (t,)
        When it was learnt, and when it was seen there last.
    """

    track: IntArray
    reference: FloatArray
    sigma: FloatArray
    since_s: FloatArray
    seen_s: FloatArray

    def part(self, kept: np.ndarray) -> _Known:
        """Return some of them."""
        return _Known(*(getattr(self, one.name)[kept] for one in fields(self)))

    def with_(self, others: _Known) -> _Known:
        """Return these and others, in the order of their numbers."""
        pairs = ((getattr(self, one.name), getattr(others, one.name)) for one in fields(self))
        both = _Known(*(np.concatenate(pair) for pair in pairs))
        if len(both.track) > MOST_TRACKS:
            both = both.part(np.argsort(-both.seen_s, kind="stable")[:MOST_TRACKS])
        return both.part(np.argsort(both.track))


class Tracks:
    """Remembers where tracks are on an organ.

    Parameters
    ----------
    slide_m_s : float
        How fast they slide along its surface: growth of the standard deviation of each component.
    """

    def __init__(self, slide_m_s: float) -> None:
        self._slide_m_s = slide_m_s
        none = np.zeros(0)
        self._known = _Known(np.zeros(0, np.int64), np.zeros((0, 3)), none, none, none)

    def observed(self, cloud: BareCloud, now_s: float, lookup: SurfaceLookup) -> ObservedPatches | None:
        """Average the points of a cloud whose place on the organ is known, by small patches of surface.

        What is torn off its neighbours is left out. Of the averages only the part along the surface means something.

        Parameters
        ----------
        cloud : BareCloud
        now_s : float
            When it was made.
        lookup : SurfaceLookup
            Of the organ.
        """
        row, place = self._found(cloud)
        recent = np.abs(now_s - self._known.seen_s[place]) <= MEMORY_S
        row, known = row[recent], self._known.part(place[recent])
        if not len(row):
            return None
        displacement = cloud.points[row] - known.reference
        kept = continuous(known.reference, displacement)
        known, row, displacement = known.part(kept), row[kept], displacement[kept]
        patch = lookup.patch[lookup.nearest_sample(known.reference)]
        # However many tracks a patch has, they share the error of what they were learnt from.
        learnt = SHARED_DEVIATIONS * known.sigma * np.sqrt(np.bincount(patch)[patch])
        sigma = np.sqrt(learnt**2 + self._slide_m(known, now_s) ** 2 + cloud.sigma[row] ** 2)
        return average_groups(patch, len(lookup.patch_areas), known.reference, displacement, sigma)

    def learn(self, cloud: BareCloud, now_s: float, reference: FloatArray, sigma: FloatArray) -> None:
        """Take from an answer where the points of its cloud are on the organ.

        Parameters
        ----------
        cloud : BareCloud
        now_s : float
            When it was made.
        reference : (n, 3) m
            Where each is on the preoperative surface; NaN for one that is not on the organ.
        sigma : (n,) m
            Standard deviation of each component.
        """
        row, place = self._found(cloud)
        known = self._known.part(place)
        off = np.linalg.norm(reference[row] - known.reference, axis=1)
        allowed = np.square([known.sigma, self._slide_m(known, now_s), sigma[row], cloud.sigma[row]])
        limit = GATE_DEVIATIONS * np.sqrt(allowed.sum(axis=0))
        seen_s = self._known.seen_s.copy()
        seen_s[place[off <= limit]] = now_s  # false for NaN, as the next
        kept = np.abs(now_s - seen_s) <= MEMORY_S
        kept[place[off > limit]] = False
        old = replace(self._known, seen_s=seen_s).part(kept)
        track, first = _single(cloud)
        new = first[np.isfinite(reference[first]).all(axis=1) & ~np.isin(track, old.track)]
        now = np.full(len(new), now_s)
        self._known = old.with_(_Known(_numbers(cloud)[new], reference[new], sigma[new], now, now))

    def _slide_m(self, known: _Known, now_s: float) -> FloatArray:
        return np.asarray(self._slide_m_s * np.abs(now_s - known.since_s))

    def _found(self, cloud: BareCloud) -> tuple[IntArray, IntArray]:
        """Return the points of a cloud that are of known tracks, (k,), and which of these each is of, (k,)."""
        track, row = _single(cloud)
        _, of_cloud, of_known = np.intersect1d(
            track, self._known.track, assume_unique=True, return_indices=True
        )
        return row[of_cloud], of_known


def _single(cloud: BareCloud) -> tuple[IntArray, IntArray]:
    """Return the tracks of a cloud and the point of each, (t,) both; a number that two points have says nothing."""
    track, row, count = np.unique(_numbers(cloud), return_index=True, return_counts=True)
    single = (count == 1) & (track != NO_TRACK)
    return track[single], row[single]


def _numbers(cloud: BareCloud) -> IntArray:
    return np.zeros(0, np.int64) if cloud.track is None else cloud.track
