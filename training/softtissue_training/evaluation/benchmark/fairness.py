"""Who is compared on what: every estimator on the same samples, and none spoils a condition for the others."""

from __future__ import annotations

from collections.abc import Sequence

from softtissue_training.evaluation.measured import CaseResult

MOST_FAILURES = 0.10
"""An estimator that fails on a larger share of a condition's samples is left out of it."""


def among_answering(results: Sequence[CaseResult]) -> list[CaseResult]:
    """Leave out the estimators that fail too often; `metrics.compared` then drops what the others failed on.

    Finite elements, say, that find no equilibrium for any observation with outliers would leave no sample to compare.
    """
    if not results:
        return []
    failed = {
        label: sum(result.answers[label].failure is not None for result in results)
        for label in results[0].answers
    }
    kept = [label for label, times in failed.items() if times <= MOST_FAILURES * len(results)]
    return [CaseResult(result.truth, {label: result.answers[label] for label in kept}) for result in results]
