"""The paper's estimator: displaced surface onto the grid, U-Net, displacement field (Pfeiffer et al. 2019).

Its network answers in the organ's frame, as published, or in that of the rigid motion of what is observed
(`rigid_frame`), as its checkpoint says.
"""

from __future__ import annotations

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
    OrganChannels,
    assemble_input,
    cached_channels,
    field_of,
    from_batch,
    known_of,
    motion_of,
    organ_grid,
)
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.estimators.paper.residual import ResidualCorrection
from softtissue_estimator.estimators.paper.rigid_frame import out_of_frame
from softtissue_estimator.inference.captured_call import CapturedCall
from softtissue_estimator.inference.device import StageClock, choose_device, one_thread, to_host
from softtissue_estimator.inference.precision import choose_precision
from softtissue_estimator.inference.runtime import NetworkRuntime
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.patch_average import average_patches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.support.resources import bundled_checkpoint

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What an organ needs computed once.

    Attributes
    ----------
    cells
        (X, Y, Z, 3) float32 metres, where the cells of the grid are.
    field
        From what is known (X, Y, Z, 4), as `known_displacement` makes it, to the network's field (X, Y, Z, c):
        displacement in its frame and, with c = 4, standard deviation; metres.
    correction
        From that field to one that is nearer to what is observed.
    sampler
        From a field to its values at the organ's query points (q, c).
    """

    organ: Organ
    channels: OrganChannels
    cells: Tensor
    field: CapturedCall
    correction: ResidualCorrection
    sampler: FieldSampler


class PaperEstimate(Estimate):
    """A displacement field on the organ's grid, read at the organ's query points.

    Parameters
    ----------
    field
        (X, Y, Z, 3 or 4) as of `_Prepared`.
    motion
        The rigid motion in whose frame the field is; None for the organ's frame.
    values
        (q, 3 or 4) the field at the organ's query points.
    """

    def __init__(
        self,
        organ: Organ,
        channels: OrganChannels,
        field: Tensor,
        motion: RigidMotion | None,
        values: FloatArray,
        stages: dict[str, float],
    ) -> None:
        self._channels, self._field, self._motion = channels, field, motion
        self.displacement, self.sigma = self._in_organ_frame(organ.query_points, values)
        self.stages = stages

    def displacement_at(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """See `Estimate.displacement_at`; None where the network does not say how sure it is."""
        sampler = FieldSampler(self._channels.grid, self._channels.near_mask, points, self._field.device)
        return self._in_organ_frame(points, sampler(self._field).double().cpu().numpy())

    def _in_organ_frame(self, points: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        displacement = values[:, :3]
        if self._motion is not None:
            displacement = out_of_frame(self._motion, points, displacement)
        return displacement, values[:, 3] if values.shape[1] == 4 else None


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
        self.take_over(organ, self.precompute(organ, progress), progress)

    def precompute(self, organ: Organ, progress: Progress = silent) -> OrganChannels:
        """See `Estimator.precompute`."""
        spacing_mm = 1e3 * self._spec.spacing
        progress(f"{organ.name}: signed distance and attached region on a {spacing_mm:.2f} mm grid")
        return cached_channels(organ, organ_grid(organ.surface, self._spec))

    def take_over(self, organ: Organ, computed: OrganChannels, progress: Progress = silent) -> None:
        """See `Estimator.take_over`."""
        spec, device = self._spec, self._device
        sampler = FieldSampler(computed.grid, computed.near_mask, organ.query_points, device)
        correction = ResidualCorrection(computed.grid, organ.surface, organ.attached, device)
        channels = computed.to(device)
        with self._threads():
            shape = (1, len(spec.channels), *channels.grid.shape)
            runtime = NetworkRuntime(self._network, shape, device, self._dtype, progress)

            def field(known: Tensor) -> tuple[Tensor, ...]:
                return (field_of(from_batch(runtime(assemble_input(channels, known, spec))), spec),)

            with torch.inference_mode():
                nothing_observed = torch.zeros((*channels.grid.shape, 4), device=device)
                call = CapturedCall(field, nothing_observed, progress)
        self._prepared = _Prepared(organ, channels, channels.cells(), call, correction, sampler)

    def estimate(self, observation: Observation) -> Estimate:
        """Rasterise the visible displacement, run the network, correct its field, read it at the query points."""
        prepared = self._prepared
        if prepared is None:
            raise InvalidInputError("no organ is loaded: expected load_organ before the first observation")
        with torch.inference_mode(), self._threads():
            clock = StageClock(self._device)
            patches = average_patches(observation, prepared.organ.surface_lookup)
            motion = motion_of(patches, self._spec)
            if motion is not None:
                clock.lap("rigid")
            known = known_of(observation, prepared.channels, prepared.cells, motion)
            clock.lap("rasterise")
            (field,) = prepared.field(known)
            clock.lap("network")
            if motion is not None:  # what is trained as published answers as published
                field = prepared.correction(field, patches, motion)
                clock.lap("residual")
            values = prepared.sampler(field)
            (values,) = to_host(values)
            clock.lap("warp")
        return PaperEstimate(
            prepared.organ, prepared.channels, field, motion, values.double().numpy(), clock.stages()
        )

    def _threads(self) -> AbstractContextManager[None]:
        # In half precision one core answers in milliseconds; a second would save a few of them on an idle machine
        # and, where other programs take turns on it, keep the first waiting for hundreds.
        single = self._device.type == "cpu" and self._dtype != torch.float32
        return one_thread() if single else nullcontext()
