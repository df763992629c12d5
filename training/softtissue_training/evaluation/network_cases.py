"""The bundled network with an input of an organ that bends, for timing it and for comparing its answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from torch import Tensor, nn

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_estimator.estimators.paper.network_input import (
    cached_channels,
    field_of,
    input_of,
    organ_grid,
)
from softtissue_estimator.observation.bending_organ import NOISE_M, BendingOrgan
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.support.resources import bundled_checkpoint

_OBSERVED_POINTS = 1200
_TIME_S = 1.2  # of the organ's swing: near its largest displacement


@dataclass(frozen=True, eq=False)
class NetworkCase:
    """A network, an input of it, and what a difference of its outputs means.

    Attributes
    ----------
    name
        As in the parameter `estimator`.
    network
        float32, on the CPU.
    inputs
        (1, C, X, Y, Z) float32, on the CPU.
    difference_mm
        Largest distance inside the organ between the answers that two outputs (1, C', X, Y, Z) stand for, mm.
    """

    name: str
    network: nn.Module
    inputs: Tensor
    difference_mm: Callable[[Tensor, Tensor], float]


def paper_case(organ: Organ, config: EstimatorConfig) -> NetworkCase:
    """Return the paper's network with the bundled weights and an input of this organ.

    Its answers are a displacement and, if it gives one, a standard deviation; the larger difference of the two counts.
    """
    checkpoint = load_checkpoint(bundled_checkpoint())
    spec = checkpoint.spec
    channels = cached_channels(organ, organ_grid(organ.surface, spec))
    inputs = input_of(organ, channels, _observation(organ, config), spec)
    inside = channels.organ_mask

    def difference_mm(first: Tensor, second: Tensor) -> float:
        answers = [field_of(outputs[0][:, inside].T, spec) for outputs in (first, second)]
        apart = answers[0] - answers[1]
        moved, spread = apart[:, :3].norm(dim=1), apart[:, 3:].abs()
        return 1e3 * max(float(moved.max()), float(spread.max()) if spec.sigma_is_calibrated else 0.0)

    return NetworkCase("paper", checkpoint.network, inputs, difference_mm)


def _observation(organ: Organ, config: EstimatorConfig) -> Observation:
    scene = BendingOrgan(organ, _OBSERVED_POINTS, np.random.default_rng(0))
    sigma = np.full(_OBSERVED_POINTS, NOISE_M)
    return make_observation(scene.points(_TIME_S), scene.reference, sigma, organ, config)[0]
