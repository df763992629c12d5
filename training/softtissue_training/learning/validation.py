"""How far a network is off on organs that it was not trained on, beside a rigid fit of the observation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.paper.network import UNet
from softtissue_estimator.estimators.paper.network_input import NetworkSpec
from softtissue_estimator.observation.rigid import fit_rigid
from softtissue_training.learning.batch_order import slots_of
from softtissue_training.learning.box import crop, own_box
from softtissue_training.learning.dataset import PreparedSample, voxelise
from softtissue_training.learning.distributed import Ranks


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

    @property
    def score(self) -> float:
        """What the best weights are chosen by: the error."""
        return self.error


class Validation:
    """Samples with visible patches that stay the same through a training run.

    Parameters
    ----------
    observed
        Visible points and displacements of each sample, as `draw_visible` returns them.
    """

    def __init__(
        self,
        samples: Sequence[PreparedSample],
        observed: Sequence[tuple[Tensor, Tensor]],
        spec: NetworkSpec,
        device: torch.device,
    ) -> None:
        self._spec = spec
        self._device = device
        self._inputs: list[tuple[PreparedSample, Tensor, Tensor]] = []
        self._displacement: list[float] = []
        self._rigid: list[float] = []
        for sample, (points, displacement) in zip(samples, observed, strict=True):
            self._inputs.append((sample, points, displacement))
            inside = (sample.signed_distance <= 0).reshape(-1).numpy()
            target = sample.target.reshape(-1, 3).double().numpy()[inside]
            centres = sample.grid.points()[inside]
            before = points.double().numpy()
            motion = fit_rigid(before, before + displacement.double().numpy())
            self._displacement.append(float(np.linalg.norm(target, axis=1).mean()))
            self._rigid.append(float(np.linalg.norm(motion.apply(centres) - centres - target, axis=1).mean()))

    def __call__(self, network: UNet, ranks: Ranks | None = None) -> ValidationResult:
        """Measure a network in float32, on the box that the estimator will use; it is left in the mode it was in.

        Parameters
        ----------
        ranks
            Processes that share the work, each with the same network; all get the same result.
        """
        ranks = ranks or Ranks()
        was_training = network.training
        network.eval()
        errors = torch.zeros(len(self._inputs), dtype=torch.float64)
        with torch.inference_mode():
            for number in slots_of(ranks.rank, ranks.size, len(self._inputs)):
                errors[number] = self._error(network, *self._inputs[number])
        network.train(was_training)
        error = float(ranks.sum(errors.to(self._device)).mean())
        return ValidationResult(error, float(np.mean(self._displacement)), float(np.mean(self._rigid)))

    def _error(self, network: UNet, sample: PreparedSample, points: Tensor, displacement: Tensor) -> float:
        """Return the mean distance inside the organ, metres."""
        voxels = voxelise(sample, points, displacement, self._spec, self._device)
        inputs, target, mask = crop(voxels, own_box(sample.box, sample.grid.shape))
        distance = (network(inputs) - target).norm(dim=1, keepdim=True)
        return float((distance * mask).sum() / mask.sum()) * self._spec.output_scale
