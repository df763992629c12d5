"""How far the hybrid network is off on organs that it was not trained on, beside the elastic posterior alone."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softtissue_estimator.estimators.hybrid.input import HybridSpec
from softtissue_estimator.estimators.hybrid.network import HybridNetwork
from softtissue_training.learning.batch_order import slots_of
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.hybrid.batches import HybridBatch, collate
from softtissue_training.learning.hybrid.loss import answers, weighted_mean
from softtissue_training.learning.hybrid.posterior_set import ViewOf
from softtissue_training.learning.hybrid.sample import hybrid_sample

FloatArray = NDArray[np.float64]

SHARES = (0.0, 0.08, 0.15, 0.25, 0.6, 1.01)
"""Limits of the bins of the visible share."""
GAINS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of the remainder that are tried."""
_ERROR_PER_NAT_M = 1e-4  # error that a nat of likelihood is worth, when the best weights are chosen
_EDGES = np.geomspace(0.01, 30.0, 161)  # of |error| / sigma
_NORMAL_SHARES = ((1.0, 0.6827), (2.0, 0.9545))


@dataclass(frozen=True)
class HybridResult:
    """Over held-out views, at points that are not visible; lengths in metres.

    Attributes
    ----------
    error, elastic_error
        Mean over views of the mean distance from the truth, with and without the network.
    score
        What the best weights are chosen by: the error, and how well the standard deviation fits.
    remainder_gain
        Of `GAINS`, the one with the smallest error if that is clearly smaller than without the network, else 0; all
        else is with it.
    sigma_factor
        What calibrates the standard deviation on these views; the next two are with it.
    within_one, within_two
        Share of the errors' components within one and two standard deviations.
    correlation
        Of mean standard deviation and mean error, over views.
    by_share
        For each bin of `SHARES`: views, error, elastic error.
    """

    error: float
    elastic_error: float
    score: float
    remainder_gain: float
    sigma_factor: float
    within_one: float
    within_two: float
    correlation: float
    by_share: tuple[tuple[int, float, float], ...]


class HybridValidation:
    """Held-out views that stay the same through a training run."""

    def __init__(self, views: Sequence[ViewOf], spec: HybridSpec, device: torch.device) -> None:
        self._views, self._spec, self._device = views, spec, device

    def __call__(self, network: HybridNetwork, ranks: Ranks | None = None) -> HybridResult:
        """Measure a network in float32; it is left in the mode it was in.

        Parameters
        ----------
        ranks
            Processes that share the work, each with the same network; all get the same result.
        """
        ranks = ranks or Ranks()
        was_training = network.training
        network.eval()
        table = torch.zeros((len(self._views), *TABLE), dtype=torch.float64)
        with torch.inference_mode():
            for number in slots_of(ranks.rank, ranks.size, len(self._views)):
                table[number] = self._measure(network, self._views[number])
        network.train(was_training)
        shares = np.array([view.share for view in self._views])
        return summarised(ranks.sum(table.to(self._device)).cpu().numpy(), shares)

    def _measure(self, network: HybridNetwork, view: ViewOf) -> Tensor:
        """Return a row of the table that `summarised` describes."""
        batch = collate([hybrid_sample(view.case, view.view, self._spec)], 1).to(self._device)
        found, sigma = answers(network(batch.inputs), batch, self._spec)
        sigma = sigma / self._spec.sigma_factor
        weight = _counted(batch)
        likelihood = (found - batch.target).square().sum(dim=2) / sigma.square() / 6.0 + sigma.log()
        common = [weighted_mean(values, weight) for values in (batch.target.norm(dim=2), sigma, likelihood)]
        rows = []
        for gain in GAINS:
            off = gain * found - batch.target
            ratio = (off.abs() / sigma.unsqueeze(2))[weight > 0.0].cpu().numpy()
            counts = np.bincount(np.digitize(ratio.ravel(), _EDGES), minlength=len(_EDGES) + 1)
            means = torch.stack([weighted_mean(off.norm(dim=2), weight), *common]).squeeze(1).cpu()
            rows.append(torch.cat([means.double(), torch.from_numpy(counts / max(1, ratio.size))]))
        return torch.stack(rows)


def _counted(batch: HybridBatch) -> Tensor:
    """Points that are not visible; all of them where everything is."""
    return batch.hidden if bool(batch.hidden.any()) else batch.visible


TABLE = (len(GAINS), 4 + len(_EDGES) + 1)
"""Shape of what is noted of a view."""


def summarised(table: FloatArray, shares: FloatArray) -> HybridResult:
    """Put what was noted of all views together, and choose the gain and the calibration.

    Parameters
    ----------
    table
        (views, *TABLE): for each gain the error, the elastic error, the standard deviation (metres), the negative
        logarithm of the likelihood without the gain, and the histogram of errors over standard deviation.
    shares
        (views,) visible share of the surface.
    """
    best = _trusted_gain(table[:, :, 0])
    error, elastic, sigma, likelihood = table[:, best, :4].T
    factor, within = calibration(table[:, best, 4:].mean(axis=0))
    spread = min(float(np.std(error)), float(np.std(sigma)))
    bins = []
    for low, high in itertools.pairwise(SHARES):
        inside = (shares >= low) & (shares < high)
        means = [float(values[inside].mean()) if inside.any() else 0.0 for values in (error, elastic)]
        bins.append((int(inside.sum()), means[0], means[1]))
    return HybridResult(
        error=float(error.mean()),
        elastic_error=float(elastic.mean()),
        score=float(error.mean()) + _ERROR_PER_NAT_M * float(likelihood.mean()),
        remainder_gain=GAINS[best],
        sigma_factor=factor,
        within_one=within[0],
        within_two=within[1],
        correlation=float(np.corrcoef(error, sigma)[0, 1]) if spread > 0.0 else 0.0,
        by_share=tuple(bins),
    )


def _trusted_gain(errors: FloatArray) -> int:
    """Choose among errors (views, gains): the smallest mean, if it beats the first gain by two standard errors."""
    best = int(errors.mean(axis=0).argmin())
    gained = errors[:, 0] - errors[:, best]
    return best if gained.mean() > 2.0 * gained.std() / np.sqrt(len(gained)) else 0


def calibration(histogram: FloatArray) -> tuple[float, tuple[float, float]]:
    """Find the factor of sigma with which one and two of it hold the shares of errors that they should.

    Parameters
    ----------
    histogram
        Share of the errors' components whose ratio to sigma is in each bin.

    Returns
    -------
    factor
    within
        Shares within one and two calibrated standard deviations.
    """
    cumulative = np.cumsum(histogram)[:-1] / max(float(histogram.sum()), 1e-12)
    candidates = _EDGES[(_EDGES > 0.2) & (_EDGES < 5.0)]
    held = np.array([np.interp(limit * candidates, _EDGES, cumulative) for limit, _ in _NORMAL_SHARES])
    # In units of the widths of the two intervals that are asked for, 63 to 73 and 92 to 98 %.
    off = np.abs(held[0] - _NORMAL_SHARES[0][1]) / 0.05 + np.abs(held[1] - _NORMAL_SHARES[1][1]) / 0.03
    best = int(off.argmin())
    return float(candidates[best]), (float(held[0, best]), float(held[1, best]))
