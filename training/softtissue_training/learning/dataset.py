"""From stored simulations to what the network reads and should answer.

What never changes (signed distance, attached region, target) is voxelised once, through the estimator's own
preprocessing. The visible patch is drawn anew every time a sample is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_input import (
    NetworkSpec,
    OrganChannels,
    assemble_input,
    channels_on_grid,
    organ_grid,
    to_batch,
)
from softtissue_estimator.estimators.paper.rasterise import rasterise_many
from softtissue_estimator.organ.mesh import face_areas, sample_faces
from softtissue_training.learning.voxel_target import voxel_displacement
from softtissue_training.organs.organ_shape import CUBE_SIDE_M
from softtissue_training.organs.surface_patch import edge_graph, grow_patch
from softtissue_training.simulation.sample import Sample

FloatArray = NDArray[np.float64]
Share = tuple[float, float]
Voxels = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class PreparedSample:
    """A simulation, voxelised.

    Attributes
    ----------
    grid
        The grid of the arrays: the one on which the estimator is given the organ, or the cube around it.
    box
        Cell counts of the former, which lies in the middle of the latter.
    signed_distance, zero_displacement
        (X, Y, Z) float16, as `OrganChannels`.
    target
        (X, Y, Z, 3) float16 metres, zero outside the organ.
    points, point_displacement
        (k, 3) float32 metres, spread evenly over the whole surface.
    point_face
        (k,) the face of each point.
    faces, areas, graph
        Surface triangles, their areas in m^2, and the graph of edge lengths, for drawing visible patches.
    """

    grid: VoxelGrid
    box: tuple[int, int, int]
    signed_distance: Tensor
    zero_displacement: Tensor
    target: Tensor
    points: Tensor
    point_displacement: Tensor
    point_face: NDArray[np.int64]
    faces: NDArray[np.int64]
    areas: FloatArray
    graph: sparse.csr_matrix


def prepare(sample: Sample, spec: NetworkSpec, *, surroundings: bool = False) -> PreparedSample:
    """Voxelise a simulation for a network of the given specification.

    Parameters
    ----------
    surroundings
        Voxelise the whole cube of 0.30 m around the organ, not only the box that the specification asks for.
    """
    surface = sample.surface
    box = organ_grid(surface, spec)
    grid = _in_cube(box, organ_grid(surface, replace(spec, cube_side_m=CUBE_SIDE_M))) if surroundings else box
    channels = channels_on_grid(grid, surface, sample.attached_mask)
    # The signed distance is stored in float16; the mask must be the one that training will see.
    distance = channels.signed_distance.half()
    displacement = sample.displacement.astype(np.float64)
    target = voxel_displacement(
        channels.grid,
        sample.vertices.astype(np.float64),
        sample.tets.astype(np.int64),
        displacement,
        (distance <= 0).numpy(),
    )
    points, face, barycentric = sample_faces(surface, None, 0.5 * spec.spacing)
    moved = np.einsum("ka,kac->kc", barycentric, displacement[surface.faces[face]])
    return PreparedSample(
        grid=channels.grid,
        box=box.shape,
        signed_distance=distance,
        zero_displacement=channels.zero_displacement.half(),
        target=torch.from_numpy(target).half(),
        points=torch.from_numpy(points).float(),
        point_displacement=torch.from_numpy(moved).float(),
        point_face=face,
        faces=surface.faces,
        areas=face_areas(surface),
        graph=edge_graph(surface),
    )


def _in_cube(box: VoxelGrid, cube: VoxelGrid) -> VoxelGrid:
    """Return the grid of the cube, made larger where the box reaches beyond it; both have the same middle."""
    counts = np.maximum(box.shape, cube.shape)
    first = np.array(box.origin) - 0.5 * box.spacing * (counts - np.array(box.shape))
    return VoxelGrid(
        (float(first[0]), float(first[1]), float(first[2])),
        box.spacing,
        (int(counts[0]), int(counts[1]), int(counts[2])),
    )


def draw_visible(
    sample: PreparedSample,
    rng: np.random.Generator,
    share: Share,
    *,
    noise_m: tuple[float, float] = (0.0, 0.0),
    correspondences: tuple[int, int] | None = None,
) -> tuple[Tensor, Tensor]:
    """Draw a visible patch and what is known of it.

    Parameters
    ----------
    share
        Lowest and highest share of the surface that is visible.
    noise_m
        Lowest and highest standard deviation of Gaussian noise on each component of the displacement, metres.
    correspondences
        Lowest and highest number of points that are known, drawn uniformly on a logarithmic scale; None: all.

    Returns
    -------
    points
        (k, 3) float32 metres, preoperative positions of the visible points.
    displacement
        (k, 3) float32 metres.
    """
    seed_face = int(rng.choice(len(sample.areas), p=sample.areas / sample.areas.sum()))
    from_seed = dijkstra(sample.graph, directed=False, indices=[int(sample.faces[seed_face, 0])])[0]
    visible = grow_patch(from_seed, sample.faces, sample.areas, rng.uniform(*share))
    chosen = np.flatnonzero(visible[sample.point_face])
    if correspondences is not None:
        low, high = np.log(correspondences)
        count = min(len(chosen), round(float(np.exp(rng.uniform(low, high)))))
        chosen = rng.choice(chosen, count, replace=False)
    index = torch.from_numpy(chosen)
    displacement = sample.point_displacement[index]
    if noise_m[1] > 0.0:
        noise = rng.normal(scale=rng.uniform(*noise_m), size=(len(chosen), 3))
        displacement = displacement + torch.from_numpy(noise.astype(np.float32))
    return sample.points[index], displacement


def voxelise(
    sample: PreparedSample, points: Tensor, displacement: Tensor, spec: NetworkSpec, device: torch.device
) -> Voxels:
    """Turn a sample and its visible points into network input, target and mask, on a device.

    Returns
    -------
    inputs
        (1, 5, X, Y, Z) float32, scaled.
    target
        (1, 3, X, Y, Z) float32 in the network's unit of length.
    mask
        (1, 1, X, Y, Z) float32, 1 inside the organ.
    """
    return voxelise_many([sample], [(points, displacement)], spec, device)[0]


def voxelise_many(
    samples: Sequence[PreparedSample],
    observed: Sequence[tuple[Tensor, Tensor]],
    spec: NetworkSpec,
    device: torch.device,
) -> list[Voxels]:
    """Do the same for several samples; those whose grids have the same cell counts go through the device together.

    Parameters
    ----------
    observed
        Visible points and displacements of each sample, as `draw_visible` returns them.
    """
    together = len({sample.grid.shape for sample in samples}) == 1
    groups = [range(len(samples))] if together else [range(i, i + 1) for i in range(len(samples))]
    result: list[Voxels] = []
    for group in groups:
        visible = rasterise_many(
            [samples[i].grid for i in group],
            [observed[i][0].to(device) for i in group],
            [observed[i][1].to(device) for i in group],
        )[0]
        result += [
            _channels(samples[i], field, spec, device) for i, field in zip(group, visible, strict=True)
        ]
    return result


def _channels(sample: PreparedSample, visible: Tensor, spec: NetworkSpec, device: torch.device) -> Voxels:
    channels = OrganChannels(
        sample.grid,
        sample.signed_distance.to(device, torch.float32),
        sample.zero_displacement.to(device, torch.float32),
    )
    target = to_batch(sample.target.to(device, torch.float32) / spec.output_scale)
    mask = to_batch(channels.organ_mask.unsqueeze(-1).float())
    return assemble_input(channels, visible, spec), target, mask
