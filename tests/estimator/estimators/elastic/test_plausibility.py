"""What no tissue endures, and what nothing observed suggests."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from estimator.shapes import box_tets, rotation
from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody
from softtissue_estimator.estimators.elastic.plausibility import (
    has_implausible_elements,
    is_implausible_displacement,
    plausible_fit,
)

MESH = box_tets((0.06, 0.04, 0.03), (4, 3, 2))
COUNT = len(MESH.nodes)
BODY = HyperelasticBody(MESH, np.eye(COUNT), np.eye(COUNT)[:, -2:], torch.device("cpu"))
OBSERVED = np.array([[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]])


def deformed_beyond(share, stretches):
    """Displacement that stretches the elements of the last `share` of the length of the block so."""
    begin = 0.06 * (1.0 - share)
    beyond = np.maximum(MESH.nodes[:, 0] - begin, 0.0)
    moved = np.zeros_like(MESH.nodes)
    moved[:, 0] = (stretches[0] - 1.0) * beyond
    moved[:, 1:] = (np.array(stretches[1:]) - 1.0) * MESH.nodes[:, 1:] * (beyond > 0.0)[:, None]
    return torch.from_numpy(moved)


@pytest.mark.parametrize(
    ("stretches", "implausible"),
    [
        ((1.0, 1.0, 1.0), False),
        ((1.8, 0.75, 0.75), False),  # more than any organ, but no more than an estimate may pass through
        ((3.0, 1.0, 1.0), True),
        ((-0.5, 1.0, 1.0), True),
    ],
)
def test_what_no_tissue_endures_is_implausible(stretches, implausible):
    assert has_implausible_elements(BODY, deformed_beyond(0.5, stretches)) is implausible
    turned = rotation([0.3, -0.8, 0.5], 1.2)
    moved = (MESH.nodes + deformed_beyond(0.5, stretches).numpy()) @ turned.T - MESH.nodes
    assert has_implausible_elements(BODY, torch.from_numpy(moved)) is implausible


@pytest.mark.parametrize(("farthest_m", "implausible"), [(0.019, False), (0.021, True)])
def test_moving_twice_as_far_as_anything_observed_is_implausible(farthest_m, implausible):
    moved = torch.zeros((COUNT, 3), dtype=torch.float64)
    moved[3, 0] = farthest_m
    assert is_implausible_displacement(moved, OBSERVED) is implausible


@pytest.mark.parametrize(
    ("plausible_from_m", "observed_m", "tried_m", "found_m"),
    [
        (0.0, 0.03, [0.001], 0.001),
        (0.003, 0.03, [0.001, 0.002, 0.004], 0.004),
        # Inverted whatever the model's error is: as far as observed, and several times as far.
        (np.inf, 0.03, [0.001, 0.002, 0.004, 0.008, 0.016], 0.001),
        (np.inf, 0.01, [0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128], 0.128),
    ],
)
def test_the_fit_is_that_with_the_least_plausible_error_of_the_model(
    plausible_from_m, observed_m, tried_m, found_m
):
    inverted = deformed_beyond(0.5, (-0.5, 1.0, 1.0))  # 45 mm at the end
    tried = []

    def fit(model_sigma_m):
        tried.append(model_sigma_m)
        mean = torch.zeros_like(inverted) if model_sigma_m >= plausible_from_m else inverted
        return SimpleNamespace(mean=mean, model_sigma_m=model_sigma_m)

    found, plausible = plausible_fit(fit, 0.001, BODY, np.array([[0.0, observed_m, 0.0]]))
    assert tried == pytest.approx(tried_m)
    assert found.model_sigma_m == pytest.approx(found_m)
    assert plausible is bool(np.isfinite(plausible_from_m))
