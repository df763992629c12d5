"""Which tracked points belong to one surface that tears nowhere: outliers are found before anything is averaged.

Tissue is continuous: neighbouring points move alike, or the organ would be torn between them. A lost point, a
reflection or an instrument that was tracked with the organ moves otherwise than all around it. What hangs together, in
the largest part, is the organ; up to two of five points may be wrong alone, or fewer than half as one piece.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from softtissue_estimator.observation.rigid import RigidMotion, fit_rigid
from softtissue_estimator.organ.mesh import BoolArray, FloatArray, IntArray

MOST_STRAIN = 0.6
"""Neighbours that move differently by more than this share of their distance, and noise, are torn apart."""
_LEAST_TOLERANCE_M = 0.002
_NEAREST_QUANTILE = 0.2  # of the differences between neighbours: those of good points, even if 40 % are wrong
_TOLERANCE_OVER_QUANTILE = 4.0  # normal noise exceeds it in one pair of a thousand
_NEIGHBOURS = 8
_REACH_M = 0.012  # neighbours farther apart say nothing about each other
_MOST_JUDGES = (
    1500  # points that are compared with each other, spread over all; others are compared with these
)
_MOST_SAMPLED = 100  # points that a rigid motion is judged by
_DRAWS = 48  # of three points; with 40 % outliers one of five draws is free of them


def continuous(reference: FloatArray, displacement: FloatArray) -> BoolArray:
    """Tell which points move as parts of one continuous surface, (n,).

    Points without neighbours cannot be judged and are kept.

    Parameters
    ----------
    reference, displacement : (n, 3) m
        Places and displacements of tracked points.
    """
    kept = np.ones(len(reference), dtype=np.bool_)
    if len(reference) <= _NEIGHBOURS:
        return kept
    judges = np.arange(0, len(reference), -(-len(reference) // _MOST_JUDGES))
    motion = _consensus_motion(reference[judges], reference[judges] + displacement[judges])
    rest = displacement - (motion.apply(reference) - reference)
    tree = cKDTree(reference[judges])
    near = tree.query(reference[judges], k=_NEIGHBOURS + 1, distance_upper_bound=_REACH_M)
    first, second, apart = _edges(np.asarray(near[0])[:, 1:], np.asarray(near[1])[:, 1:])
    if len(first) == 0:
        return kept
    differing = np.linalg.norm(rest[judges[first]] - rest[judges[second]], axis=1)
    place = int(_NEAREST_QUANTILE * len(differing))
    usual = float(np.partition(differing, place)[place])
    noise = max(_LEAST_TOLERANCE_M, _TOLERANCE_OVER_QUANTILE * usual)
    torn = differing > MOST_STRAIN * apart + noise
    if not torn.any():
        return kept
    good = _hanging_together(len(judges), first, second, torn)
    if len(judges) == len(reference):
        return good
    if good.all():
        return kept  # what the judges have met none of is rare, and averages withstand it
    # The others are compared with the nearest good judge.
    to_good, nearest = cKDTree(reference[judges[good]]).query(reference, distance_upper_bound=_REACH_M)
    beside = np.isfinite(to_good)
    judge = judges[good][np.minimum(nearest, int(good.sum()) - 1)]
    like = np.linalg.norm(rest - rest[judge], axis=1) <= MOST_STRAIN * to_good + noise
    # In the middle of a wrong piece there are wrong judges alone.
    alone = ~beside
    alone[alone] = ~np.isfinite(tree.query(reference[alone], distance_upper_bound=_REACH_M)[0])
    return np.asarray(alone | (beside & like))


def _edges(distance: FloatArray, other: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return pairs of neighbours and their distances, (e,) each, from a table of each point's neighbours."""
    near = np.isfinite(distance)
    first = np.broadcast_to(np.arange(len(other))[:, None], other.shape)[near]
    return first, other[near], distance[near]


def _hanging_together(count: int, first: IntArray, second: IntArray, torn: BoolArray) -> BoolArray:
    """Tell which points hang together in the largest part, or in one that is torn from none that is kept, (count,)."""
    whole = coo_array((np.ones(int((~torn).sum())), (first[~torn], second[~torn])), shape=(count, count))
    parts, part = connected_components(whole, directed=False)
    size = np.bincount(part, minlength=parts)
    ends = np.sort(np.stack([part[first[torn]], part[second[torn]]]), axis=0).astype(np.int64)
    ends = ends[:, ends[0] != ends[1]]
    ends = np.stack(np.divmod(np.unique(ends[0] * parts + ends[1]), parts))  # much faster than of pairs
    # Of two parts that are torn apart the larger is kept, unless it was dropped itself.
    kept = np.ones(parts, dtype=np.bool_)
    smaller = np.where(size[ends[0]] < size[ends[1]], ends[0], ends[1])
    larger = np.where(size[ends[0]] < size[ends[1]], ends[1], ends[0])
    for index in np.argsort(-size[larger], kind="stable"):
        if kept[larger[index]]:
            kept[smaller[index]] = False
    return np.asarray(kept[part])


def _consensus_motion(source: FloatArray, target: FloatArray) -> RigidMotion:
    """Rigid motion with the least median distance among those of random triples, fitted to the nearer half.

    Random sampling after Fischler and Bolles (1981); the draws are the same every time.
    """
    step = -(-len(source) // _MOST_SAMPLED)
    start, end = source[::step], target[::step]
    triples = np.random.default_rng(0).integers(len(start), size=(_DRAWS, 3))
    before, after = start[triples], end[triples]  # (d, 3, 3)
    centre_before, centre_after = before.mean(axis=1), after.mean(axis=1)
    covariance = (after - centre_after[:, None]).transpose(0, 2, 1) @ (before - centre_before[:, None])
    left, _, right = np.linalg.svd(covariance)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    rotation = left @ right
    turned = start @ rotation.transpose(0, 2, 1)  # (d, n, 3)
    shift = centre_after - (rotation @ centre_before[:, :, None])[:, :, 0]
    squared = np.square(turned + shift[:, None] - end).sum(axis=2)
    best = squared[int(np.median(squared, axis=1).argmin())]
    near = best <= np.median(best)
    return fit_rigid(start[near], end[near])
