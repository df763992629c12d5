"""One view of one simulation as the hybrid network is given it, made by the estimator's own preprocessing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softtissue_estimator.estimators.hybrid.input import (
    VECTOR_CHANNELS,
    HybridSpec,
    ObservedMisfit,
    assemble_hybrid_input,
    posterior_cells,
)
from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_input import OrganChannels
from softtissue_estimator.organ.volume_mesh import VolumeMesh
from softtissue_training.learning.hybrid.posterior_record import PosteriorCase

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HybridSample:
    """Input and target of one view; lengths in metres.

    Attributes
    ----------
    inputs
        (1, C, X, Y, Z), as `assemble_hybrid_input` makes them.
    position
        (k, 3) points of the simulation, in cells.
    target
        (k, 3) their true displacement minus the posterior's mean.
    sigma
        (k,) the posterior's standard deviation of each component.
    visible
        (k,) bool, points on the visible surface.
    """

    inputs: Tensor
    position: Tensor
    target: Tensor
    sigma: Tensor
    visible: Tensor


def hybrid_sample(case: PosteriorCase, view: int, spec: HybridSpec) -> HybridSample:
    """Make input and target of a view."""
    grid = _grid(case, spec)
    mesh = VolumeMesh(case.nodes.astype(np.float64), case.tets.astype(np.int64))
    channels = OrganChannels(
        grid, torch.from_numpy(case.signed_distance).float(), torch.from_numpy(case.attached).float()
    )
    cells = posterior_cells(channels.signed_distance, grid.spacing)
    mean, sigma = _posterior_at(grid.points()[cells.numpy()], case.cell_tet, mesh, case, view)
    points = case.points.astype(np.float64)
    point_mean, point_sigma = _posterior_at(points, case.point_tet, mesh, case, view)
    inputs = assemble_hybrid_input(
        channels, cells, torch.from_numpy(mean), torch.from_numpy(sigma), _observed(case, view), spec
    )
    return HybridSample(
        inputs=inputs,
        position=torch.from_numpy(grid.index(points)).float(),
        target=torch.from_numpy(case.truth - point_mean).float(),
        sigma=torch.from_numpy(point_sigma).float(),
        visible=torch.from_numpy(case.visible[view]),
    )


def _posterior_at(
    points: FloatArray, tet: NDArray[np.int32], mesh: VolumeMesh, case: PosteriorCase, view: int
) -> tuple[FloatArray, FloatArray]:
    """Mean (n, 3) and standard deviation (n,) at points (n, 3), as `ElasticEstimate.interpolated` gives them."""
    weights = mesh.weights(points, tet.astype(np.int64))
    corners = mesh.tets[tet]
    variance = case.sigma[view].astype(np.float64) ** 2
    mean = np.einsum("nk,nkc->nc", weights, case.displacement[view].astype(np.float64)[corners])
    spread = np.maximum(np.einsum("nk,nk->n", weights, variance[corners]), variance.min())
    return mean, np.sqrt(spread)


def _grid(case: PosteriorCase, spec: HybridSpec) -> VoxelGrid:
    x, y, z = case.origin.tolist()
    nx, ny, nz = case.shape.tolist()
    return VoxelGrid((x, y, z), spec.spacing, (nx, ny, nz))


def _observed(case: PosteriorCase, view: int) -> ObservedMisfit:
    end = int(case.counts[: view + 1].sum())
    part = slice(end - int(case.counts[view]), end)
    return ObservedMisfit(
        torch.from_numpy(case.reference[part].astype(np.float64)),
        torch.from_numpy(case.misfit[part].astype(np.float64)),
        torch.from_numpy(case.seen_sigma[part].astype(np.float64)),
    )


def oriented(sample: HybridSample, order: tuple[int, ...], mirrored: tuple[int, ...]) -> HybridSample:
    """Rename the axes and mirror some: as good as another simulation, for the material is isotropic.

    Parameters
    ----------
    order
        Axis i of the result is axis `order[i]` of the sample.
    mirrored
        Axes of the result along which it is mirrored.
    """
    inputs = sample.inputs.permute(0, 1, *(2 + axis for axis in order)).flip([2 + axis for axis in mirrored])
    sign = torch.ones(3)
    sign[list(mirrored)] = -1.0
    source = list(range(inputs.shape[1]))
    factor = torch.ones(inputs.shape[1])
    for vector in VECTOR_CHANNELS:
        for axis in range(3):
            source[vector[axis]] = vector[order[axis]]
            factor[vector[axis]] = sign[axis]
    position = sample.position[:, list(order)]
    last = torch.tensor(inputs.shape[2:]).float() - 1.0
    return HybridSample(
        inputs=inputs[:, source] * factor.view(1, -1, 1, 1, 1),
        position=torch.where(sign < 0.0, last - position, position),
        target=sample.target[:, list(order)] * sign,
        sigma=sample.sigma,
        visible=sample.visible,
    )
