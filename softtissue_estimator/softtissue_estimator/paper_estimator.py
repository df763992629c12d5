"""The paper's estimator: displaced surface onto the grid, U-Net, displacement field (Pfeiffer et al. 2019)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softtissue_estimator.checkpoint import load_checkpoint
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.device import choose_device, device_stopwatch
from softtissue_estimator.displacement_field import FieldSampler
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimator import Estimate, Estimator, Progress, silent
from softtissue_estimator.network_input import (
    NetworkSpec,
    OrganChannels,
    assemble_input,
    cached_channels,
    from_batch,
    organ_grid,
    visible_displacement,
)
from softtissue_estimator.observation import Observation
from softtissue_estimator.organ import Organ
from softtissue_estimator.resources import bundled_checkpoint

FloatArray = NDArray[np.float64]


class PaperEstimate(Estimate):
    """A displacement field on the organ's grid, read at the organ's query points."""

    def __init__(
        self, channels: OrganChannels, field: Tensor, displacement: FloatArray, stages: dict[str, float]
    ) -> None:
        self._channels = channels
        self._field = field
        self.displacement = displacement
        self.sigma = None  # the paper's network gives none
        self.stages = stages

    def displacement_at(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Displacement (k, 3) in metres of preoperative points (k, 3) in metres; no standard deviation."""
        sampler = FieldSampler(self._channels.grid, self._channels.organ_mask, points, self._field.device)
        return sampler(self._field).double().cpu().numpy(), None


class PaperEstimator(Estimator):
    """U-Net on the organ's grid, with grid, channels and scales read from its checkpoint.

    Raises
    ------
    CheckpointError
        The weights are missing or damaged.
    InvalidInputError
        The device does not exist.
    """

    name = "paper"

    def __init__(self, config: EstimatorConfig) -> None:
        checkpoint = load_checkpoint(Path(config.checkpoint) if config.checkpoint else bundled_checkpoint())
        self._device = choose_device(config.device)
        self.device = str(self._device)
        self._spec: NetworkSpec = checkpoint.spec
        self._network = checkpoint.network.to(self._device)
        self._channels: OrganChannels | None = None
        self._sampler: FieldSampler | None = None

    def load_organ(self, organ: Organ, progress: Progress = silent) -> None:
        """Compute the organ's grid, signed distance and attached region, and where its structures lie in it."""
        progress(
            f"{organ.name}: signed distance and attached region on a {1e3 * self._spec.spacing:.2f} mm grid"
        )
        channels = cached_channels(organ, organ_grid(organ.surface, self._spec))
        sampler = FieldSampler(channels.grid, channels.organ_mask, organ.query_points, self._device)
        self._channels, self._sampler = channels.to(self._device), sampler

    def estimate(self, observation: Observation) -> Estimate:
        """Rasterise the visible displacement, run the network, read its field at the organ's query points."""
        if self._channels is None or self._sampler is None:
            raise InvalidInputError("no organ is loaded: expected load_organ before the first observation")
        watch = device_stopwatch(self._device)
        with torch.inference_mode():
            visible = visible_displacement(
                self._channels.grid,
                torch.from_numpy(observation.reference).to(self._device),
                torch.from_numpy(observation.displacement).to(self._device),
                torch.from_numpy(observation.sigma).to(self._device),
            )
            inputs = assemble_input(self._channels, visible, self._spec)
            watch.lap("rasterise")
            field = self._forward(inputs)
            watch.lap("network")
            displacement = self._sampler(field).double().cpu().numpy()
            watch.lap("warp")
        return PaperEstimate(self._channels, field, displacement, watch.stages)

    def _forward(self, inputs: Tensor) -> Tensor:
        """Return the displacement field (X, Y, Z, 3) in metres, zero outside the organ."""
        channels = self._channels
        if channels is None:
            raise InvalidInputError("no organ is loaded")
        field = from_batch(self._network(inputs)).float() * self._spec.output_scale
        return field * channels.organ_mask.unsqueeze(-1)
