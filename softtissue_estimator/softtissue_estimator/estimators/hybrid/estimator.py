"""The elastic posterior and a network that predicts what it leaves."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import CheckpointError, InvalidInputError
from softtissue_estimator.estimators.elastic.estimate import ElasticEstimate
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.elastic.model import ElasticModel
from softtissue_estimator.estimators.estimator import Estimate, Estimator, Progress, silent
from softtissue_estimator.estimators.hybrid.checkpoint import load_hybrid_checkpoint
from softtissue_estimator.estimators.hybrid.input import (
    HybridSpec,
    ObservedMisfit,
    assemble_hybrid_input,
    hybrid_grid,
    posterior_cells,
    remainder,
    sample_field,
)
from softtissue_estimator.estimators.hybrid.posterior import PosteriorReader, make_reader, observed_misfit
from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_input import OrganChannels, cached_channels
from softtissue_estimator.inference.captured_call import CapturedCall
from softtissue_estimator.inference.device import StageClock, choose_device, one_thread, to_device, to_host
from softtissue_estimator.inference.precision import choose_precision
from softtissue_estimator.inference.runtime import NetworkRuntime
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.support.resources import bundled_checkpoint


@dataclass(frozen=True, eq=False)
class Precomputed:
    """What an organ needs computed once, without the network."""

    model: ElasticModel
    channels: OrganChannels
    cells: Tensor
    reader: PosteriorReader


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What an organ needs computed once."""

    channels: OrganChannels
    cells: Tensor  # flat numbers of the cells that carry the posterior
    reader: PosteriorReader
    answer: (
        CapturedCall  # from the network's inputs to its outputs on the grid and at the organ's query points
    )


class HybridEstimate(Estimate):
    """An elastic estimate and the network's outputs: on the organ's grid (1, 4, X, Y, Z), and at its query points.

    The latter, (1, q, 4), are in the host's memory.
    """

    def __init__(
        self, elastic: ElasticEstimate, outputs: Tensor, at_query: Tensor, grid: VoxelGrid, spec: HybridSpec
    ) -> None:
        self._elastic, self._outputs, self._grid, self._spec = elastic, outputs, grid, spec
        self.displacement, self.sigma = self._added(elastic.displacement, elastic.sigma, at_query)
        self.stages: dict[str, float] = {}

    def displacement_at(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """See `Estimate.displacement_at`."""
        mean, sigma = self._elastic.displacement_at(points)
        position = _positions(self._grid.index(points), self._outputs.device)
        with torch.inference_mode():
            return self._added(mean, sigma, *to_host(sample_field(self._outputs, position)))

    def _added(
        self, mean: FloatArray, sigma: FloatArray | None, outputs: Tensor
    ) -> tuple[FloatArray, FloatArray]:
        if sigma is None:
            raise InvalidInputError(
                "hybrid estimator: expected a standard deviation from the elastic one, got none"
            )
        with torch.inference_mode():
            added, predicted = remainder(outputs[0].double(), torch.from_numpy(sigma), self._spec)
            return mean + added.numpy(), predicted.numpy()


class HybridEstimator(Estimator):
    """Elastic posterior plus the remainder that a network predicts on the organ's grid (`input`).

    Grid, channels and scales are read from the checkpoint.

    Raises
    ------
    CheckpointError
        The weights are missing or damaged.
    InvalidInputError
        The device does not exist.
    """

    name = "hybrid"

    def __init__(self, config: EstimatorConfig) -> None:
        checkpoint = load_hybrid_checkpoint(_weights(config))
        self._device = choose_device(config.device)
        self.device = str(self._device)
        self._spec: HybridSpec = checkpoint.spec
        self._dtype = choose_precision(config.precision, self._device)
        self._network = checkpoint.network
        self._config = config
        self._elastic = ElasticEstimator(config)
        self._prepared: _Prepared | None = None

    def load_organ(self, organ: Organ, progress: Progress = silent) -> None:
        """Prepare the elastic posterior, and where it is read on the network's grid."""
        self.take_over(organ, self.precompute(organ, progress), progress)

    def precompute(self, organ: Organ, progress: Progress = silent) -> Precomputed:
        """See `Estimator.precompute`."""
        model = self._elastic.precompute(organ, progress)
        grid = hybrid_grid(organ.surface, self._spec)
        channels = cached_channels(organ, grid)
        cells = posterior_cells(channels.signed_distance, grid.spacing)
        return Precomputed(model, channels, cells, make_reader(model.mesh, grid.points()[cells.numpy()]))

    def take_over(self, organ: Organ, computed: Precomputed, progress: Progress = silent) -> None:
        """See `Estimator.take_over`."""
        # Another one, so that the organ loaded before stays in use if this fails.
        elastic = ElasticEstimator(self._config)
        elastic.take_over(organ, computed.model, progress)
        channels, cells = computed.channels.to(self._device), computed.cells.to(self._device)
        query = _positions(channels.grid.index(organ.query_points), self._device)
        with self._threads():
            answer = self._ready(channels, query, progress)
        self._prepared = _Prepared(channels, cells, computed.reader, answer)
        self._elastic.close()
        self._elastic = elastic

    def forget(self) -> None:
        """See `Estimator.forget`."""
        self._elastic.forget()

    def forget_registration(self) -> None:
        """See `Estimator.forget_registration`."""
        self._elastic.forget_registration()

    def close(self) -> None:
        """See `Estimator.close`."""
        self._elastic.close()

    def estimate(self, observation: Observation) -> HybridEstimate:
        """See `Estimator.estimate`."""
        prepared = self._prepared
        if prepared is None:
            raise InvalidInputError("no organ is loaded: expected load_organ before the first observation")
        elastic = self._elastic.estimate(observation)
        with torch.inference_mode(), self._threads():
            clock = StageClock(self._device)
            inputs = self._inputs(elastic, prepared)
            clock.lap("channels")
            outputs, at_query = prepared.answer(inputs)
            clock.lap("network")
            (read,) = to_host(at_query)
            estimate = HybridEstimate(elastic, outputs, read, prepared.channels.grid, self._spec)
            clock.lap("remainder")
        estimate.stages = {**elastic.stages, **clock.stages()}
        return estimate

    def _ready(self, channels: OrganChannels, query: Tensor, progress: Progress) -> CapturedCall:
        """Make what runs the network and reads its outputs at `query`, (1, q, 3) in cells."""
        shape = (1, len(self._spec.channels), *channels.grid.shape)
        runtime = NetworkRuntime(self._network, shape, self._device, self._dtype, progress)

        def answer(inputs: Tensor) -> tuple[Tensor, ...]:
            outputs = runtime(inputs)
            return outputs, sample_field(outputs, query)

        with torch.inference_mode():
            return CapturedCall(answer, torch.zeros(shape, device=self._device), progress)

    def _threads(self) -> AbstractContextManager[None]:
        # The network is small, and in a stream the elastic tracker computes on another core at the same time.
        return one_thread() if self._device.type == "cpu" else nullcontext()

    def _inputs(self, elastic: ElasticEstimate, prepared: _Prepared) -> Tensor:
        mean, sigma = prepared.reader.on_grid(elastic)
        observed = observed_misfit(elastic)
        return assemble_hybrid_input(
            prepared.channels,
            prepared.cells,
            to_device(mean, self._device),
            to_device(sigma, self._device),
            ObservedMisfit(
                *(
                    to_device(part.numpy(), self._device)
                    for part in (observed.reference, observed.misfit, observed.sigma)
                )
            ),
            self._spec,
        )


def _positions(index: FloatArray, device: torch.device) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(index)).float().unsqueeze(0).to(device)


def _weights(config: EstimatorConfig) -> Path:
    if config.checkpoint:
        return Path(config.checkpoint)
    try:
        return bundled_checkpoint("hybrid")
    except InvalidInputError as error:
        raise CheckpointError(
            "estimator 'hybrid': expected weights in the parameter checkpoint or weights/hybrid.safetensors in the "
            "installation, got neither; train them with softtissue-train, or use estimator 'elastic'"
        ) from error
