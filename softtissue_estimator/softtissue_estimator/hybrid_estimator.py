"""The elastic posterior and a network that predicts what it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.device import choose_device, device_stopwatch
from softtissue_estimator.elastic_estimator import ElasticEstimate, ElasticEstimator
from softtissue_estimator.errors import CheckpointError, InvalidInputError
from softtissue_estimator.estimator import Estimate, Estimator, Progress, silent
from softtissue_estimator.hybrid_checkpoint import load_hybrid_checkpoint
from softtissue_estimator.hybrid_input import (
    HybridSpec,
    SeenMisfit,
    assemble_hybrid_input,
    hybrid_grid,
    posterior_cells,
    remainder,
    sample_field,
)
from softtissue_estimator.hybrid_posterior import PosteriorReader, make_reader, seen_misfit
from softtissue_estimator.mesh import FloatArray
from softtissue_estimator.network_input import OrganChannels, cached_channels
from softtissue_estimator.observation import Observation
from softtissue_estimator.organ import Organ
from softtissue_estimator.resources import bundled_checkpoint


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What an organ needs computed once."""

    channels: OrganChannels
    cells: Tensor  # flat numbers of the cells that carry the posterior
    reader: PosteriorReader
    query: Tensor  # (1, q, 3) organ.query_points in cells


class HybridEstimate(Estimate):
    """An elastic estimate and the network's outputs on the organ's grid, (1, 4, X, Y, Z)."""

    def __init__(
        self, elastic: ElasticEstimate, outputs: Tensor, prepared: _Prepared, spec: HybridSpec
    ) -> None:
        self._elastic, self._outputs, self._grid, self._spec = elastic, outputs, prepared.channels.grid, spec
        self.displacement, self.sigma = self._added(elastic.displacement, elastic.sigma, prepared.query)
        self.stages: dict[str, float] = {}

    def displacement_at(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """See `Estimate.displacement_at`."""
        mean, sigma = self._elastic.displacement_at(points)
        position = _positions(self._grid.index(points), self._outputs.device)
        return self._added(mean, sigma, position)

    def _added(
        self, mean: FloatArray, sigma: FloatArray | None, position: Tensor
    ) -> tuple[FloatArray, FloatArray]:
        if sigma is None:
            raise InvalidInputError(
                "hybrid estimator: expected a standard deviation from the elastic one, got none"
            )
        with torch.inference_mode():
            spread = torch.from_numpy(sigma).to(self._outputs.device)
            outputs = sample_field(self._outputs, position)[0].double()
            added, predicted = remainder(outputs, spread, self._spec)
            return mean + added.cpu().numpy(), predicted.cpu().numpy()


class HybridEstimator(Estimator):
    """Elastic posterior plus the remainder that a network predicts on the organ's grid (`hybrid_input`).

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
        self._network = checkpoint.network.to(self._device)
        self._config = config
        self._elastic = ElasticEstimator(config)
        self._prepared: _Prepared | None = None

    def load_organ(self, organ: Organ, progress: Progress = silent) -> None:
        """Prepare the elastic posterior, and where it is read on the network's grid."""
        # Another one, so that the organ loaded before stays in use if this fails.
        elastic = ElasticEstimator(self._config)
        elastic.load_organ(organ, progress)
        grid = hybrid_grid(organ.surface, self._spec)
        channels = cached_channels(organ, grid)
        cells = posterior_cells(channels.signed_distance, grid.spacing)
        reader = make_reader(elastic, grid.points()[cells.numpy()])
        query = _positions(grid.index(organ.query_points), self._device)
        self._prepared = _Prepared(channels.to(self._device), cells.to(self._device), reader, query)
        self._elastic.close()
        self._elastic = elastic

    def forget(self) -> None:
        """See `Estimator.forget`."""
        self._elastic.forget()

    def close(self) -> None:
        """See `Estimator.close`."""
        self._elastic.close()

    def estimate(self, observation: Observation) -> HybridEstimate:
        """See `Estimator.estimate`."""
        prepared = self._prepared
        if prepared is None:
            raise InvalidInputError("no organ is loaded: expected load_organ before the first observation")
        elastic = self._elastic.estimate(observation)
        watch = device_stopwatch(self._device)
        with torch.inference_mode():
            inputs = self._inputs(elastic, prepared)
            watch.lap("channels")
            outputs = self._network(inputs).float()
            watch.lap("network")
        estimate = HybridEstimate(elastic, outputs, prepared, self._spec)
        watch.lap("remainder")
        estimate.stages = {**elastic.stages, **watch.stages}
        return estimate

    def _inputs(self, elastic: ElasticEstimate, prepared: _Prepared) -> Tensor:
        mean, sigma = prepared.reader.on_grid(elastic)
        seen = seen_misfit(elastic)
        return assemble_hybrid_input(
            prepared.channels,
            prepared.cells,
            torch.from_numpy(mean).to(self._device),
            torch.from_numpy(sigma).to(self._device),
            SeenMisfit(*(part.to(self._device) for part in (seen.reference, seen.misfit, seen.sigma))),
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
