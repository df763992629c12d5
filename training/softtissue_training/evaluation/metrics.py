"""Numbers of what was measured, in millimetres.

Two means are kept apart everywhere. *Over samples*: each sample counts once, with the mean error over its points; the
mean over samples is the figure to quote. *Over points*: the points of all samples are pooled, so that median, 95 %
and maximum are those of points. Unless said otherwise, points are those that are not visible.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from softtissue_training.evaluation.measured import Answer, CaseResult, Truth

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]

HIDDEN_LOAD_BELOW = 0.10
"""A load counts as hidden if less than this share of it acts on visible surface."""
WITHIN_ONE_SIGMA, WITHIN_TWO_SIGMA = 0.6827, 0.9545
SHARE_EDGES = np.linspace(0.0, 1.0, 11)
DEPTH_EDGES_M = np.arange(0.0, 0.201, 0.01)
DISPLACEMENT_EDGES_M = np.arange(0.0, 0.101, 0.01)
PAPER_DISPLACEMENTS_M = (0.02, 0.04, 0.06)
PAPER_TOLERANCE_M = 0.005
"""Points whose true displacement is this near to 2, 4 or 6 cm stand for it."""
DENSITY_BIN_M = 0.002


@dataclass(frozen=True)
class Spread:
    """Mean, median, 95 % quantile and maximum of `count` numbers, mm."""

    count: int
    mean_mm: float
    median_mm: float
    p95_mm: float
    max_mm: float


@dataclass(frozen=True)
class Bin:
    """Errors where a quantity lies from `low` to below `high`, in the unit of the binned quantity's edges."""

    low: float
    high: float
    errors: Spread | None


@dataclass(frozen=True)
class Calibration:
    """Predicted standard deviations beside true errors.

    chi is error over predicted standard deviation. Of a calibrated normal prediction 68.3 % and 95.4 % of all errors
    are within one and two standard deviations, and the root mean square of chi is 1.

    Attributes
    ----------
    samples
        How many were counted.
    within_one_sigma, within_two_sigma
        Shares of components of errors, over all points.
    length_within_68, length_within_95
        Shares of points whose error's length is within the radius that should hold 68.27 % and 95.45 % (chi squared
        with three degrees of freedom).
    rms_chi
        Root mean square of chi over all components.
    correlation_over_samples
        Pearson's r of a sample's mean predicted standard deviation with its mean error; None for fewer than 3 samples.
    correlation_within_samples
        Mean over samples of Pearson's r over a sample's points.
    """

    samples: int
    within_one_sigma: float
    within_two_sigma: float
    length_within_68: float
    length_within_95: float
    rms_chi: float
    correlation_over_samples: float | None
    correlation_within_samples: float | None


Condition = Callable[[Truth], bool]

CONDITIONS: Mapping[str, Condition] = {
    "all": lambda truth: True,
    "seen_load": lambda truth: (
        truth.load_seen_share is not None and truth.load_seen_share >= HIDDEN_LOAD_BELOW
    ),
    "hidden_load": lambda truth: (
        truth.load_seen_share is not None and truth.load_seen_share < HIDDEN_LOAD_BELOW
    ),
}
"""Which samples belong to each row of the tables."""


def spread(errors_m: FloatArray) -> Spread | None:
    """Summarise errors in metres, (n,); None without any."""
    if len(errors_m) == 0:
        return None
    millimetres = 1e3 * errors_m.astype(np.float64)
    return Spread(
        len(millimetres),
        float(millimetres.mean()),
        float(np.median(millimetres)),
        float(np.quantile(millimetres, 0.95)),
        float(millimetres.max()),
    )


def compared(results: Sequence[CaseResult]) -> list[CaseResult]:
    """Return the samples that every estimator answered; only these make comparisons fair."""
    return [result for result in results if result.all_answered]


def hidden_errors(result: CaseResult, label: str) -> FloatArray:
    """Lengths of an answer's errors at the points that are not visible, (h,) m."""
    return result.answers[label].error_length[result.truth.hidden]


def over_samples(results: Sequence[CaseResult], label: str, *, hidden: bool = True) -> Spread | None:
    """Summarise samples' mean errors, over their hidden or over all points."""
    means = [_mean_error(result, label, hidden) for result in results]
    return spread(np.array([mean for mean in means if mean is not None]))


def over_points(results: Sequence[CaseResult], label: str, *, hidden: bool = True) -> Spread | None:
    """Summarise the errors of all samples' points, hidden ones or all."""
    parts = [
        hidden_errors(result, label) if hidden else result.answers[label].error_length for result in results
    ]
    return spread(np.concatenate([np.empty(0), *parts]))


def _mean_error(result: CaseResult, label: str, hidden: bool = True) -> float | None:
    errors = hidden_errors(result, label) if hidden else result.answers[label].error_length
    return float(errors.mean(dtype=np.float64)) if len(errors) else None


def by_visible_share(results: Sequence[CaseResult], label: str) -> list[Bin]:
    """Bin samples' mean errors at hidden points by the share of the surface that is visible, 10 % a bin."""
    known = [
        (result.truth.visible_share, mean)
        for result in results
        if result.truth.visible_share is not None and (mean := _mean_error(result, label)) is not None
    ]
    pairs = np.array(known, dtype=np.float64).reshape(-1, 2)
    return _binned(pairs[:, 0], pairs[:, 1], SHARE_EDGES)


def by_depth(results: Sequence[CaseResult], label: str, target_m: float | None = None) -> list[Bin]:
    """Bin errors of hidden points by their distance to the visible surface, 1 cm a bin.

    Parameters
    ----------
    target_m
        Only points whose true displacement is within `PAPER_TOLERANCE_M` of this, as in the paper's figure.
    """
    depth, target, errors = _pooled(results, label)
    if target_m is not None:
        near = np.abs(target - target_m) <= PAPER_TOLERANCE_M
        depth, errors = depth[near], errors[near]
    return _binned(depth, errors, DEPTH_EDGES_M)


def by_displacement(results: Sequence[CaseResult], label: str) -> list[Bin]:
    """Bin errors of hidden points by the length of their true displacement, 1 cm a bin."""
    _, target, errors = _pooled(results, label)
    return _binned(target, errors, DISPLACEMENT_EDGES_M)


def magnitude_density(
    results: Sequence[CaseResult], label: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Count hidden points by true and estimated displacement, in bins of 0.2 cm.

    Returns
    -------
    counts
        (k, k), true displacement along the first axis; estimates beyond the last bin are counted in it.
    edges
        (k + 1,) m.
    """
    edges = np.arange(0.0, DISPLACEMENT_EDGES_M[-1] + 0.5 * DENSITY_BIN_M, DENSITY_BIN_M)
    counts = np.zeros((len(edges) - 1, len(edges) - 1))
    for result in results:
        hidden, target = result.truth.hidden, result.truth.target
        estimated = np.linalg.norm(target + result.answers[label].error, axis=1)[hidden]
        true = result.truth.target_length[hidden]
        last = edges[-1] - 0.5 * DENSITY_BIN_M
        counts += np.histogram2d(np.minimum(true, last), np.minimum(estimated, last), bins=(edges, edges))[0]
    return counts, edges


def calibration(results: Sequence[CaseResult], label: str) -> Calibration | None:
    """Compare predicted standard deviations with errors at hidden points; None where none are predicted."""
    parts = [_hidden_with_sigma(result.truth, result.answers[label]) for result in results]
    known = [part for part in parts if part is not None]
    if not known:
        return None
    chi = np.concatenate([error / sigma[:, None] for error, sigma in known])
    squared = (chi**2).sum(axis=1)
    lengths = [np.linalg.norm(error, axis=1) for error, _ in known]
    mean_error = np.array([length.mean() for length in lengths])
    mean_sigma = np.array([sigma.mean() for _, sigma in known])
    within = [_correlation(sigma, length) for (_, sigma), length in zip(known, lengths, strict=True)]
    found = [value for value in within if value is not None]
    return Calibration(
        samples=len(known),
        within_one_sigma=float((np.abs(chi) <= 1.0).mean()),
        within_two_sigma=float((np.abs(chi) <= 2.0).mean()),
        length_within_68=float((squared <= chi2.ppf(WITHIN_ONE_SIGMA, 3)).mean()),
        length_within_95=float((squared <= chi2.ppf(WITHIN_TWO_SIGMA, 3)).mean()),
        rms_chi=float(np.sqrt((chi**2).mean())),
        correlation_over_samples=_correlation(mean_sigma, mean_error),
        correlation_within_samples=float(np.mean(found)) if found else None,
    )


def _hidden_with_sigma(truth: Truth, answer: Answer) -> tuple[FloatArray, FloatArray] | None:
    if answer.sigma is None or not truth.hidden.any():
        return None
    sigma = np.maximum(answer.sigma[truth.hidden].astype(np.float64), 1e-9)
    return answer.error[truth.hidden].astype(np.float64), sigma


def _correlation(first: FloatArray, second: FloatArray) -> float | None:
    """Pearson's r, or None where it is not defined."""
    if len(first) < 3 or np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
        return None
    return float(np.corrcoef(first, second)[0, 1])


def _pooled(results: Sequence[CaseResult], label: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Depth, length of the true displacement and error of all hidden points, each (n,) m."""
    nothing = np.empty(0)
    depth = [result.truth.depth[result.truth.hidden] for result in results]
    target = [result.truth.target_length[result.truth.hidden] for result in results]
    errors = [hidden_errors(result, label) for result in results]
    return (
        np.concatenate([nothing, *depth]),
        np.concatenate([nothing, *target]),
        np.concatenate([nothing, *errors]),
    )


def _binned(quantity: FloatArray, errors: FloatArray, edges: FloatArray) -> list[Bin]:
    """Summarise errors by bins of a quantity; the last bin includes its upper edge and all beyond it."""
    index = np.clip(np.digitize(quantity, edges) - 1, 0, len(edges) - 2)
    return [
        Bin(float(edges[i]), float(edges[i + 1]), spread(errors[index == i])) for i in range(len(edges) - 1)
    ]
