"""How far a network is off on organs that it was not trained on, beside a rigid fit of what is seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.network import UNet
from softtissue_estimator.network_input import NetworkSpec
from softtissue_estimator.rigid import fit_rigid
from softtissue_training.dataset import PreparedSample, draw_visible, voxelise


@dataclass(frozen=True)
class ValidationResult:
    """Means over organs of means over the cells inside each, metres.

    Attributes
    ----------
    error
        Distance between estimated and true displacement.
    displacement
        Length of the true displacement: the error of estimating no displacement.
    rigid_error
        Error of the rigid motion that fits the visible points best.
    """

    error: float
    displacement: float
    rigid_error: float


class Validation:
    """Held-out organs with visible patches that stay the same through a training run."""

    def __init__(
        self,
        samples: Sequence[PreparedSample],
        spec: NetworkSpec,
        share: tuple[float, float],
        rng: np.random.Generator,
        device: torch.device,
    ) -> None:
        self._spec = spec
        self._device = device
        self._inputs: list[tuple[PreparedSample, Tensor, Tensor]] = []
        self._displacement: list[float] = []
        self._rigid: list[float] = []
        for sample in samples:
            points, displacement = draw_visible(sample, rng, share)
            self._inputs.append((sample, points, displacement))
            inside = (sample.signed_distance <= 0).reshape(-1).numpy()
            target = sample.target.reshape(-1, 3).double().numpy()[inside]
            centres = sample.grid.points()[inside]
            seen = points.double().numpy()
            motion = fit_rigid(seen, seen + displacement.double().numpy())
            self._displacement.append(float(np.linalg.norm(target, axis=1).mean()))
            self._rigid.append(float(np.linalg.norm(motion.apply(centres) - centres - target, axis=1).mean()))

    def __call__(self, network: UNet) -> ValidationResult:
        """Measure a network; it is left in the mode it was in."""
        was_training = network.training
        network.eval()
        errors = []
        with torch.inference_mode():
            for sample, points, displacement in self._inputs:
                inputs, target, mask = voxelise(sample, points, displacement, self._spec, self._device)
                distance = (network(inputs) - target).norm(dim=1, keepdim=True)
                errors.append(float((distance * mask).sum() / mask.sum()) * self._spec.output_scale)
        network.train(was_training)
        return ValidationResult(
            float(np.mean(errors)), float(np.mean(self._displacement)), float(np.mean(self._rigid))
        )
