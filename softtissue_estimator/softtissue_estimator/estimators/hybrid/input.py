"""What the hybrid network reads and what its output means: one implementation for training and use.

It reads, on a grid around the organ, the elastic posterior (mean, logarithm of the standard deviation), the observation
(where, how precisely, and how far from the posterior's mean) and the organ (signed distance, attached region). Its
four outputs are smooth fields f and g; with the posterior's mean m(p) and standard deviation s(p), known exactly at
every point p, the answer is

    u(p) = m(p) + a s(p) f(p),    sigma(p) = c s(p) exp(g(p)),

with f and g interpolated linearly between cells. Two numbers are found after training, on organs that were held out: a,
from zero to one, is how far the remainder is to be trusted, and c calibrates sigma. Where the output is zero and c is
one, this is the posterior itself. |f| and |g| are bounded, so that whatever the network makes
of an input unlike all that it was trained on, the answer stays within a few of the posterior's standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from softtissue_estimator.estimators.hybrid.network import HybridArchitecture
from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_input import OrganChannels, to_batch
from softtissue_estimator.estimators.paper.rasterise import rasterise
from softtissue_estimator.organ.mesh import SurfaceMesh

FloatArray = NDArray[np.float64]

HYBRID_CHANNELS = (
    "signed_distance",
    "attached",
    "posterior_mean_x",
    "posterior_mean_y",
    "posterior_mean_z",
    "posterior_log_sigma",
    "visible",
    "misfit_x",
    "misfit_y",
    "misfit_z",
)
VECTOR_CHANNELS = ((2, 3, 4), (7, 8, 9))
"""Places of the components of vectors among the channels."""
HYBRID_SCALES = (50.0, 1.0, 50.0, 50.0, 50.0, 1.0, 1.0, 500.0, 500.0, 500.0)
_SIGMA_UNIT_M = 0.001  # log(sigma / 1 mm); a patch observed with a standard deviation of 1 mm is half visible
_SMALLEST_SIGMA_M = 1e-5  # keeps logarithm and precision finite


@dataclass(frozen=True)
class HybridSpec:
    """What a hybrid network needs to know about its input and output; stored in its checkpoint, never a parameter.

    Attributes
    ----------
    spacing
        Distance between cell centres, metres.
    margin_cells
        Free cells on each side of the organ's bounding box.
    channels
        Names of the input channels, in order.
    input_scales
        Factor of each channel, from SI units to the network's.
    remainder_limit
        Bound of |f| in each component.
    log_sigma_limit
        Bound of |g|.
    remainder_gain
        The a by which the remainder is multiplied.
    sigma_factor
        The c that calibrates the standard deviation.
    architecture
        Shapes of the weights.
    """

    spacing: float = 0.30 / 32
    margin_cells: int = 1
    channels: tuple[str, ...] = HYBRID_CHANNELS
    input_scales: tuple[float, ...] = HYBRID_SCALES
    remainder_limit: float = 6.0
    log_sigma_limit: float = 3.0
    remainder_gain: float = 1.0
    sigma_factor: float = 1.0
    architecture: HybridArchitecture = field(default_factory=HybridArchitecture)


@dataclass(frozen=True, eq=False)
class ObservedMisfit:
    """The observation beside what the posterior says there.

    Attributes
    ----------
    reference
        (c, 3) preoperative positions, metres.
    misfit
        (c, 3) observed displacement minus the posterior's mean, metres.
    sigma
        (c,) standard deviation of each component of the observed displacement, metres.
    """

    reference: Tensor
    misfit: Tensor
    sigma: Tensor


def hybrid_grid(surface: SurfaceMesh, spec: HybridSpec) -> VoxelGrid:
    """Return the grid on which a network of this specification is given the organ: its bounding box and a margin."""
    return VoxelGrid.covering(
        surface.vertices.min(axis=0),
        surface.vertices.max(axis=0),
        spec.spacing,
        multiple=spec.architecture.multiple,
        margin_cells=spec.margin_cells,
    )


def posterior_cells(signed_distance: Tensor, spacing: float) -> Tensor:
    """Return the flat numbers of the cells that carry the posterior, (b,): those inside the organ and next to it."""
    return (signed_distance.reshape(-1) <= spacing).nonzero().squeeze(1)


def assemble_hybrid_input(
    organ: OrganChannels,
    cells: Tensor,
    mean: Tensor,
    sigma: Tensor,
    observed: ObservedMisfit,
    spec: HybridSpec,
) -> Tensor:
    """Stack and scale the channels of one organ and one observation.

    Parameters
    ----------
    cells
        (b,) as of `posterior_cells`.
    mean, sigma
        (b, 3) and (b,) the posterior at the centres of these cells, metres.

    Returns
    -------
    Tensor
        (1, 10, X, Y, Z) float32, on the device of the organ's channels.
    """
    scales = spec.input_scales
    stacked = torch.zeros((*organ.grid.shape, len(HYBRID_CHANNELS)), device=organ.signed_distance.device)
    torch.mul(organ.signed_distance, scales[0], out=stacked[..., 0])
    torch.mul(organ.zero_displacement, scales[1], out=stacked[..., 1])
    logarithm = (sigma.clamp_min(_SMALLEST_SIGMA_M) / _SIGMA_UNIT_M).log()
    posterior = (*mean.unbind(1), logarithm)
    flat = stacked.view(-1, len(HYBRID_CHANNELS))
    flat[cells, 2:6] = torch.stack([_scaled(*pair) for pair in zip(posterior, scales[2:6], strict=True)], 1)
    visible = _SIGMA_UNIT_M / (_SIGMA_UNIT_M + observed.sigma)
    # Scaled before they are averaged: there are far fewer points than cells.
    found = (visible, *observed.misfit.unbind(1))
    values = torch.stack([_scaled(*pair) for pair in zip(found, scales[6:], strict=True)], 1)
    precision = observed.sigma.double().clamp_min(_SMALLEST_SIGMA_M).pow(-2)
    stacked[..., 6:] = rasterise(organ.grid, observed.reference, values, precision)[0]
    return to_batch(stacked)


def _scaled(values: Tensor, scale: float) -> Tensor:
    return values.float() * scale


def sample_field(field: Tensor, position: Tensor) -> Tensor:
    """Interpolate a field linearly; beyond the outermost cells it is constant.

    Parameters
    ----------
    field
        (B, C, X, Y, Z).
    position
        (B, n, 3) in cells, as of `VoxelGrid.index`.

    Returns
    -------
    Tensor
        (B, n, C).
    """
    place = position.to(field.dtype)
    # From -1 at the first cell to 1 at the last, the fastest axis first.
    last = [max(cells - 1.0, 1.0) for cells in field.shape[2:]]
    normalised = torch.stack([2.0 * place[..., axis] / last[axis] - 1.0 for axis in (2, 1, 0)], dim=-1)
    sampled = functional.grid_sample(
        field, normalised[:, :, None, None], mode="bilinear", padding_mode="border", align_corners=True
    )
    return sampled[..., 0, 0].transpose(1, 2)


def remainder(outputs: Tensor, sigma: Tensor, spec: HybridSpec) -> tuple[Tensor, Tensor]:
    """Turn the network's outputs at points into what they mean.

    Parameters
    ----------
    outputs
        (..., 4) interpolated outputs.
    sigma
        (...) the posterior's standard deviation, metres.

    Returns
    -------
    remainder
        (..., 3) to add to the posterior's mean, metres.
    sigma
        (...) standard deviation of each component afterwards, metres.
    """
    bounded = spec.remainder_limit * torch.tanh(outputs[..., :3] / spec.remainder_limit)
    change = spec.log_sigma_limit * torch.tanh(outputs[..., 3] / spec.log_sigma_limit)
    return spec.remainder_gain * sigma.unsqueeze(-1) * bounded, sigma * change.exp() * spec.sigma_factor
