"""From stored simulations to what the network reads and should answer.

What never changes (signed distance, attached region, target) is voxelised once, through the estimator's own
preprocessing. The visible patch is drawn anew every time a sample is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from softtissue_estimator.grid import VoxelGrid
from softtissue_estimator.mesh import face_areas, sample_faces
from softtissue_estimator.network_input import (
    NetworkSpec,
    OrganChannels,
    assemble_input,
    organ_channels,
    to_batch,
    visible_displacement,
)
from softtissue_training.boundary_conditions import edge_graph, grow_patch
from softtissue_training.sample import Sample
from softtissue_training.voxel_target import voxel_displacement

FloatArray = NDArray[np.float64]
Share = tuple[float, float]


@dataclass(frozen=True)
class PreparedSample:
    """A simulation, voxelised.

    Attributes
    ----------
    grid
        The organ's grid.
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
    signed_distance: Tensor
    zero_displacement: Tensor
    target: Tensor
    points: Tensor
    point_displacement: Tensor
    point_face: NDArray[np.int64]
    faces: NDArray[np.int64]
    areas: FloatArray
    graph: sparse.csr_matrix


def prepare(sample: Sample, spec: NetworkSpec) -> PreparedSample:
    """Voxelise a simulation for a network of the given specification."""
    surface = sample.surface
    channels = organ_channels(surface, sample.attached_mask, spec)
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


def draw_visible(sample: PreparedSample, rng: np.random.Generator, share: Share) -> tuple[Tensor, Tensor]:
    """Draw a visible patch.

    Parameters
    ----------
    share
        Lowest and highest share of the surface that is seen.

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
    chosen = torch.from_numpy(visible[sample.point_face])
    return sample.points[chosen], sample.point_displacement[chosen]


def voxelise(
    sample: PreparedSample, points: Tensor, displacement: Tensor, spec: NetworkSpec, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
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
    channels = OrganChannels(
        sample.grid,
        sample.signed_distance.to(device, torch.float32),
        sample.zero_displacement.to(device, torch.float32),
    )
    visible = visible_displacement(sample.grid, points.to(device), displacement.to(device))
    target = to_batch(sample.target.to(device, torch.float32) / spec.output_scale)
    mask = to_batch(channels.organ_mask.unsqueeze(-1).float())
    return assemble_input(channels, visible, spec), target, mask


def batches(samples: Sequence[PreparedSample], size: int, rng: np.random.Generator) -> Iterator[list[int]]:
    """Yield the indices of all samples once, in random batches whose grids have the same cell counts up to order.

    Axes can be exchanged (`augment`), so that 24 x 16 x 16 and 16 x 24 x 16 go together.
    """
    groups: dict[tuple[int, ...], list[int]] = {}
    for index in rng.permutation(len(samples)):
        groups.setdefault(tuple(sorted(samples[index].grid.shape)), []).append(int(index))
    parts = [group[i : i + size] for group in groups.values() for i in range(0, len(group), size)]
    for part in rng.permutation(len(parts)):
        yield parts[part]
