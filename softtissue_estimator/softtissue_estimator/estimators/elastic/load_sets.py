"""Which loads act, all that is possible weighed: a linear model with few relevant groups, sampled.

Relevance determination (`relevance`) takes the likeliest variances for the true ones. Where an observation leaves it
open which loads act (a surface without correspondences, whose pose may be off as well), that is one of many
explanations, and too sure of itself. Here each load acts or does not, with a variance from a grid (spike and slab,
George and McCulloch 1993), and sets of loads are drawn from the posterior one load after the other, the amplitudes
integrated out (Gibbs sampling; Smith and Kohn 1996). How far they are from the answer is its covariance. The answer
itself stays that of the relevant loads: the mean over the sets is nearer to the truth for organs of which little is
seen, and farther from it for livers.

The model J enters through J^T S^-1 J and J^T S^-1 y alone. In the coordinates z = B a + e, e ~ N(0, I), of the
eigenvectors that the observation tells anything about, C = I + B V B^T is a matrix of some hundred rows, and one load
more or less changes its inverse by three.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from softtissue_estimator.estimators.elastic.amplitudes import Amplitudes
from softtissue_estimator.organ.mesh import FloatArray

EXPECTED_LOADS = 2.0
"""How many loads act, beforehand. With more, standard deviations of livers of a training seed are less likely."""
LEVELS = 4.0 ** np.arange(6)
"""Variances of a load that acts, over that with which all together move what is seen by as much as is expected: alone
it moves that by 1 to 30 mm."""
FARTHEST_M = 0.03
"""Standard deviation of each component of what one load moves, at most: what is seen tells nothing of a thin tip behind
it, which next to nothing moves by more than the organ is long."""
SWEEPS = 100  # over all loads
_FIRST_SWEEPS = 20  # which do not count
_LEAST_TOLD = 1e-2  # variance of a coordinate before the observation, over the noise: less tells nothing
_BLOCK = 24  # loads whose odds are found together
_LEAST_LEFT = 1e-9  # of a load's variance, that its neighbours do not tell: rounding must not make it none

_IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LoadSet:
    """Loads that may act together, and what is known of the amplitudes if they do.

    Parameters
    ----------
    loads : (l,) int64
        Their numbers.
    mean : (r,)
        Of all amplitudes; zero for the other loads.
    covariance : (3 l + k, 3 l + k)
        Of these loads' amplitudes and the k nuisance parameters.
    """

    loads: _IntArray
    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class LoadSets:
    """Sets of loads drawn from their posterior.

    Parameters
    ----------
    drawn : tuple of LoadSet
    answer : (r,)
        Amplitudes that are the answer: covariances are about these.
    fields, loads : int
        How many amplitudes are values of fields of errors, and how many are components of loads.
    """

    drawn: tuple[LoadSet, ...]
    answer: FloatArray
    fields: int
    loads: int

    @cached_property
    def nuisance_covariance(self) -> FloatArray:
        """Of the nuisance parameters, (k, k)."""
        begin = self.fields + self.loads
        away = np.array([(each.mean - self.answer)[begin:] for each in self.drawn])
        count = away.shape[1]
        within = np.mean([each.covariance[-count:, -count:] for each in self.drawn], axis=0)
        return np.asarray(within + away.T @ away / len(away))

    def covariance(self, response: FloatArray, moving: FloatArray | None = None) -> FloatArray:
        """Return the covariance of the displacement of places about the answer, (s, 3, 3) m^2.

        Parameters
        ----------
        response : (s, 3, 3 p) m
            By unit loads.
        moving : (s, 3, k) m or None
            By each nuisance parameter; None where these move nothing.
        """
        begin, end = self.fields, self.fields + self.loads
        found = np.zeros((len(response), 3, 3))
        for each in self.drawn:
            columns = _components(each.loads)
            moved, away = response[:, :, columns], each.mean - self.answer
            shift, covariance = response @ away[begin:end], each.covariance[: len(columns), : len(columns)]
            if moving is not None:
                moved, covariance = np.concatenate([moved, moving], axis=2), each.covariance
                shift = shift + moving @ away[end:]
            found += (moved @ covariance) @ moved.transpose(0, 2, 1) + shift[:, :, None] * shift[:, None]
        return found / len(self.drawn)


def _components(loads: _IntArray) -> _IntArray:
    """Numbers of the components of loads (l,), (3 l,)."""
    return np.asarray((3 * loads[:, None] + np.arange(3)).reshape(-1))


def draw_load_sets(
    amplitudes: Amplitudes, equal: Tensor, farthest: Tensor, pushing: int, seed: int = 0
) -> LoadSets:
    """Draw sets of loads from their posterior, from the loads that are relevant on.

    Fields of errors keep the variances that they have.

    Parameters
    ----------
    amplitudes : Amplitudes
    equal : (p,) float64
        Variance of each load with which all together move what is seen by as much as is expected.
    farthest : (p,) m^2
        See `Tangent.largest_powers`.
    pushing : int
        So many loads may act, the first ones.
    seed : int
        The same one, the same sets.
    """
    most = 3.0 * FARTHEST_M**2 / LEVELS[-1] / farthest.double().clamp_min(1e-30)
    sampler = _Sampler(amplitudes, equal.minimum(most).cpu().numpy(), pushing)
    rng = np.random.default_rng(seed)
    drawn = tuple(sampler.sweeps(rng))
    answer = amplitudes.mean.cpu().numpy()
    return LoadSets(drawn, answer, sum(amplitudes.field_values), 3 * len(equal))


class _Sampler:
    """What is observed, in the coordinates that it tells anything about, and which loads act."""

    def __init__(self, amplitudes: Amplitudes, equal: FloatArray, pushing: int) -> None:
        count, begin = 3 * len(equal), sum(amplitudes.field_values)
        self._pushing, self._equal = pushing, equal
        root = amplitudes.prior.roots(amplitudes.field_values, len(amplitudes.mean)).cpu().numpy()
        root[begin : begin + count] = np.sqrt(equal * LEVELS[-1]).repeat(3)
        self._root = root
        values, vectors = np.linalg.eigh(root[:, None] * amplitudes.gram.cpu().numpy() * root)
        told = values > _LEAST_TOLD
        values, vectors = np.sqrt(values[told]), vectors[:, told]
        self._seen = (vectors.T @ (root * amplitudes.right.cpu().numpy())) / values
        whole = (vectors * values).T
        # A load's columns for the least variance with which it acts.
        self._loads = whole[:, begin : begin + count].reshape(len(values), -1, 3) / np.sqrt(LEVELS[-1])
        self._beside = np.delete(whole, slice(begin, begin + count), axis=1)
        self._begin, self._base = begin, np.eye(len(values)) + self._beside @ self._beside.T
        self._variances = np.concatenate([[0.0], LEVELS])  # by level
        self._levels = self._nearest_levels(amplitudes.variances.cpu().numpy())

    def _nearest_levels(self, variances: FloatArray) -> _IntArray:
        """Return which level each load has, from 1 on; 0 where it does not act."""
        share = variances[: self._pushing] / self._equal[: self._pushing]
        nearest = np.abs(np.log(np.maximum(share, LEVELS[0]))[:, None] - np.log(LEVELS)).argmin(axis=1)
        return np.asarray(np.where(share >= 0.5 * LEVELS[0], 1 + nearest, 0))

    def sweeps(self, rng: np.random.Generator) -> Iterator[LoadSet]:
        """Go through all loads again and again."""
        for number in range(SWEEPS):
            # Rounding adds up.
            inverse = self._inverse()
            order, at = rng.permutation(self._pushing), 0
            while at < len(order):
                block = order[at : at + _BLOCK]
                moved = np.tensordot(inverse, self._loads[:, block], axes=1)
                drawn = self._drawn(block, moved, rng)
                changed = np.flatnonzero(drawn != self._levels[block])
                if not len(changed):
                    at += len(block)
                    continue
                # The odds of those behind it are others now.
                first = int(changed[0])
                inverse = self._changed(inverse, block[first], moved[:, first], int(drawn[first]))
                at += first + 1
            if number >= _FIRST_SWEEPS:
                yield self._set(inverse)

    def _inverse(self) -> FloatArray:
        covariance = self._base.copy()
        for load in np.flatnonzero(self._levels):
            columns = self._loads[:, load]
            covariance += self._variances[self._levels[load]] * (columns @ columns.T)
        return np.asarray(np.linalg.inv(covariance))

    def _drawn(self, block: _IntArray, moved: FloatArray, rng: np.random.Generator) -> _IntArray:
        """Draw a level for each load of a block (b,), if all others stay as they are.

        `moved`, (c, b, 3), is C^-1 B of these.
        """
        columns = self._loads[:, block]
        told = np.einsum("cbi,cbj->bij", columns, moved)
        values, vectors = np.linalg.eigh(told)
        right = np.einsum("bij,bi->bj", vectors, np.einsum("cbi,c->bi", moved, self._seen))
        # As if the load did not act.
        own = self._variances[self._levels[block]][:, None]
        left = np.maximum(1.0 - own * values, _LEAST_LEFT)
        values, right = np.maximum(values, 0.0) / left, right / left
        scaled = LEVELS * values[..., None]
        gain = 0.5 * (LEVELS * right[..., None] ** 2 / (1.0 + scaled) - np.log1p(scaled)).sum(axis=1)
        odds = gain + np.log(EXPECTED_LOADS / self._pushing / len(LEVELS))
        odds = np.concatenate([np.zeros((len(block), 1)), odds], axis=1)
        odds = np.exp(odds - odds.max(axis=1, keepdims=True))
        reached = odds.cumsum(axis=1)
        return np.asarray((rng.random((len(block), 1)) * reached[:, -1:] > reached).sum(axis=1))

    def _changed(self, inverse: FloatArray, load: int, moved: FloatArray, level: int) -> FloatArray:
        """Give a load another level; return C^-1 then. `moved`, (c, 3), is C^-1 B of it."""
        by = self._variances[level] - self._variances[self._levels[load]]
        self._levels[load] = level
        small = np.linalg.inv(np.eye(3) / by + self._loads[:, load].T @ moved)
        return np.asarray(inverse - moved @ small @ moved.T)

    def _set(self, inverse: FloatArray) -> LoadSet:
        loads = np.flatnonzero(self._levels)
        level = self._variances[self._levels[loads]].repeat(3)
        acting = self._loads[:, loads].reshape(len(inverse), -1) * np.sqrt(level)
        unit = np.sqrt(self._equal[loads].repeat(3) * level)
        behind = len(self._root) - self._begin - 3 * len(self._equal)
        nuisance = self._beside[:, self._beside.shape[1] - behind :]
        both = np.concatenate([acting, nuisance], axis=1)
        covariance = np.eye(both.shape[1]) - both.T @ inverse @ both
        scale = np.concatenate([unit, np.ones(behind)])
        explained = inverse @ self._seen
        mean = np.zeros(len(self._root))
        others = self._beside.T @ explained
        mean[: self._begin] = self._root[: self._begin] * others[: self._begin]
        mean[len(mean) - behind :] = others[self._begin :]
        mean[self._begin + _components(loads)] = unit * (acting.T @ explained)
        return LoadSet(loads, mean, scale[:, None] * covariance * scale)
