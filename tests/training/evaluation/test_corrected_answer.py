"""The bundled network on simulated organs: correcting its answer by what it leaves of the observations pays."""

import numpy as np
import pytest

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.paper.estimator import PaperEstimator
from softtissue_estimator.estimators.paper.residual import ResidualCorrection
from softtissue_training.evaluation.observe import ObservationSettings, simulated_case

SETTINGS = ObservationSettings(visible_share=(0.3, 0.4))


def _errors(samples, estimator):
    """Mean errors at observed and at hidden points, m."""
    seen, hidden = [], []
    for number, sample in enumerate(samples[:3]):
        case = simulated_case(sample, SETTINGS, np.random.default_rng(number), "case")
        estimator.load_organ(case.organ)
        estimate = estimator.estimate(case.observation)
        observed = estimate.displacement_at(case.observation.reference)[0] - case.observation.displacement
        elsewhere = (estimate.displacement_at(case.points)[0] - case.truth)[~case.visible]
        seen.append(np.linalg.norm(observed, axis=1).mean())
        hidden.append(np.linalg.norm(elsewhere, axis=1).mean())
    return np.mean(seen), np.mean(hidden)


def test_less_is_left_where_the_organ_is_seen_and_where_it_is_not(samples, monkeypatch: pytest.MonkeyPatch):
    estimator = PaperEstimator(EstimatorConfig(estimator="paper", device="cpu", precision="float32"))
    seen, hidden = _errors(samples, estimator)
    monkeypatch.setattr(ResidualCorrection, "__call__", lambda _, field, *__: field)
    plain_seen, plain_hidden = _errors(samples, estimator)
    print(
        f"seen {1e3 * plain_seen:.2f} -> {1e3 * seen:.2f} mm, hidden {1e3 * plain_hidden:.2f} -> {1e3 * hidden:.2f} mm"
    )
    assert seen < 0.5 * plain_seen
    assert hidden < plain_hidden
