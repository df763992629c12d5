"""How far a network is off on organs that it was not trained on, beside a rigid fit of what is observed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.paper.network import UNet
from softtissue_estimator.estimators.paper.network_spec import LOG_SIGMA_RANGE, NetworkSpec
from softtissue_estimator.observation.rigid import fit_rigid
from softtissue_training.learning.batch_order import slots_of
from softtissue_training.learning.box import crop, own_box
from softtissue_training.learning.dataset import PreparedSample
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.view import View
from softtissue_training.learning.voxels import Voxeliser

_QUANTILES = 201  # of each sample, so that all samples count alike
_ONE_SIGMA, _TWO_SIGMA = 0.6827, 0.9545  # shares of a Gaussian within one and two standard deviations
_CALIBRATED = 0.05  # by so much the share within two may be off


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
    sigma_scale
        Factor that makes two thirds (0.683) of the components of the errors lie within one standard deviation; NaN for
        a network that gives none.
    within_two_sigma
        Share of the components within two standard deviations so scaled; 0.954 of a Gaussian's are.
    """

    error: float
    displacement: float
    rigid_error: float
    sigma_scale: float = math.nan
    within_two_sigma: float = math.nan

    @property
    def score(self) -> float:
        """What the best weights are chosen by: the error."""
        return self.error

    @property
    def calibrated_scale(self) -> float:
        """`sigma_scale`, or 0 where the errors are not distributed as any factor would have it."""
        return self.sigma_scale if abs(self.within_two_sigma - _TWO_SIGMA) <= _CALIBRATED else 0.0


class Validation:
    """Samples with visible patches that stay the same through a training run.

    Parameters
    ----------
    observed
        One view of each sample, without noise.
    """

    def __init__(
        self,
        samples: Sequence[PreparedSample],
        observed: Sequence[View],
        spec: NetworkSpec,
        device: torch.device,
    ) -> None:
        self._spec = spec
        self._device = device
        self._voxelise = Voxeliser(spec, device, keep=device.type == "cuda")
        self._inputs: list[tuple[PreparedSample, View]] = []
        self._displacement: list[float] = []
        self._rigid: list[float] = []
        for sample, view in zip(samples, observed, strict=True):
            self._inputs.append((sample, view))
            inside = (sample.signed_distance <= 0).reshape(-1).numpy()
            target = sample.target.reshape(-1, 3).double().numpy()[inside]
            centres = sample.grid.points()[inside]
            before = view.points.double().numpy()
            now = before + view.displacement.double().numpy()
            motion = fit_rigid(before, now if view.motion is None else view.motion.apply(now))
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
        ratios = torch.full((len(self._inputs), _QUANTILES), 0.0, dtype=torch.float64)
        with torch.inference_mode():
            for number in slots_of(ranks.rank, ranks.size, len(self._inputs)):
                errors[number], ratios[number] = self._error(network, *self._inputs[number])
        network.train(was_training)
        error = float(ranks.sum(errors.to(self._device)).mean())
        ratios = ranks.sum(ratios.to(self._device)).flatten()
        scale = float(ratios.quantile(_ONE_SIGMA))
        within = float((ratios <= 2.0 * scale).double().mean())
        means = float(np.mean(self._displacement)), float(np.mean(self._rigid))
        return ValidationResult(error, *means, scale, within)

    def _error(self, network: UNet, sample: PreparedSample, view: View) -> tuple[float, Tensor]:
        """Return the mean distance inside the organ, metres, and quantiles of |error| over standard deviation."""
        voxels = self._voxelise([sample], [view])
        inputs, target, mask = crop(voxels, own_box(sample.box, sample.grid.shape))
        outputs = network(inputs)
        error = outputs[:, :3] - target
        mean = float((error.norm(dim=1, keepdim=True) * mask).sum() / mask.sum()) * self._spec.output_scale
        if not self._spec.gives_sigma:
            return mean, torch.full((_QUANTILES,), math.nan)
        ratio = (error.abs() * torch.exp(-outputs[:, 3:].clamp(*LOG_SIGMA_RANGE)))[
            (mask > 0.0).expand_as(error)
        ]
        rank = torch.linspace(0, len(ratio) - 1, _QUANTILES).long()
        return mean, ratio.sort().values.cpu()[rank]
