"""The paper's estimator: displaced surface onto the grid, U-Net, displacement field (Pfeiffer et al. 2019)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import Estimate, Estimator, Progress, silent
from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_estimator.estimators.paper.displacement_field import FieldSampler
from softtissue_estimator.estimators.paper.network_input import (
    NetworkSpec,
    OrganChannels,
    assemble_input,
    cached_channels,
    from_batch,
    organ_grid,
    visible_displacement,
)
from softtissue_estimator.inference.captured_call import CapturedCall
from softtissue_estimator.inference.device import StageClock, choose_device, one_thread, to_device, to_host
from softtissue_estimator.inference.precision import choose_precision
from softtissue_estimator.inference.runtime import NetworkRuntime
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.support.resources import bundled_checkpoint

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What an organ needs computed once.

    Attributes
    ----------
    answer
        From the visible displacement (X, Y, Z, 3) to the field (X, Y, Z, 3) and to its values at the organ's query
        points (q, 3), metres.
    """

    channels: OrganChannels
    field: Callable[[Tensor], Tensor]
    sampler: FieldSampler
    answer: CapturedCall


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
        self._dtype = choose_precision(config.precision, self._device)
        self._spec: NetworkSpec = checkpoint.spec
        self._network = checkpoint.network
        self._prepared: _Prepared | None = None

    def load_organ(self, organ: Organ, progress: Progress = silent) -> None:
        """Compute the organ's grid, signed distance and attached region, and where its structures lie in it."""
        spec, device = self._spec, self._device
        progress(f"{organ.name}: signed distance and attached region on a {1e3 * spec.spacing:.2f} mm grid")
        channels = cached_channels(organ, organ_grid(organ.surface, spec))
        sampler = FieldSampler(channels.grid, channels.organ_mask, organ.query_points, device)
        channels = channels.to(device)
        with self._threads():
            shape = (1, len(spec.channels), *channels.grid.shape)
            runtime = NetworkRuntime(self._network, shape, device, self._dtype, progress)
            inside = channels.organ_mask.unsqueeze(-1)

            def field(visible: Tensor) -> Tensor:
                outputs = runtime(assemble_input(channels, visible, spec))
                return from_batch(outputs) * spec.output_scale * inside

            def answer(visible: Tensor) -> tuple[Tensor, ...]:
                found = field(visible)
                return found, sampler(found)

            with torch.inference_mode():
                nothing_observed = torch.zeros((*channels.grid.shape, 3), device=device)
                call = CapturedCall(answer, nothing_observed, progress)
        self._prepared = _Prepared(channels, field, sampler, call)

    def estimate(self, observation: Observation) -> Estimate:
        """Rasterise the visible displacement, run the network, read its field at the organ's query points."""
        prepared = self._prepared
        if prepared is None:
            raise InvalidInputError("no organ is loaded: expected load_organ before the first observation")
        with torch.inference_mode(), self._threads():
            clock = StageClock(self._device)
            visible = visible_displacement(
                prepared.channels.grid,
                to_device(observation.reference, self._device),
                to_device(observation.displacement, self._device),
                to_device(observation.sigma, self._device),
            )
            clock.lap("rasterise")
            if prepared.answer.captured:
                field, displacement = prepared.answer(visible)
                clock.lap("network")
            else:
                field = prepared.field(visible)
                clock.lap("network")
                displacement = prepared.sampler(field)
            (displacement,) = to_host(displacement)
            clock.lap("warp")
        return PaperEstimate(prepared.channels, field, displacement.double().numpy(), clock.stages())

    def _threads(self) -> AbstractContextManager[None]:
        # In half precision one core answers in milliseconds; a second would save a few of them on an idle machine
        # and, where other programs take turns on it, keep the first waiting for hundreds.
        single = self._device.type == "cpu" and self._dtype != torch.float32
        return one_thread() if single else nullcontext()
