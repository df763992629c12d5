"""From stored simulations to what the network reads and should answer.

What never changes (signed distance, attached region, target) is voxelised once, through the estimator's own
preprocessing. The visible patch is drawn anew every time a sample is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_input import (
    channels_on_grid,
    organ_grid,
    zero_displacement,
)
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.organ.mesh import face_areas, sample_faces
from softtissue_training.learning.voxel_target import voxel_displacement
from softtissue_training.organs.organ_shape import CUBE_SIDE_M
from softtissue_training.organs.surface_patch import edge_graph, grow_patch, resized
from softtissue_training.simulation.sample import Sample

FloatArray = NDArray[np.float64]
Share = tuple[float, float]


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
    misattached
        (2, X, Y, Z) float16, the flag where the attached region is told too small and too large; None: never.
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
    misattached: Tensor | None
    target: Tensor
    points: Tensor
    point_displacement: Tensor
    point_face: NDArray[np.int64]
    faces: NDArray[np.int64]
    areas: FloatArray
    graph: sparse.csr_matrix


def prepare(
    sample: Sample, spec: NetworkSpec, *, surroundings: bool = False, misattachment: float = 0.0
) -> PreparedSample:
    """Voxelise a simulation for a network of the given specification.

    Parameters
    ----------
    surroundings
        Voxelise the whole cube of 0.30 m around the organ, not only the box that the specification asks for.
    misattachment
        By which share of its area the attached region may be told too small or too large; 0: never.
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
        misattached=_misattached(sample, grid, misattachment) if misattachment else None,
        target=torch.from_numpy(target).half(),
        points=torch.from_numpy(points).float(),
        point_displacement=torch.from_numpy(moved).float(),
        point_face=face,
        faces=surface.faces,
        areas=face_areas(surface),
        graph=edge_graph(surface),
    )


def longest_axis_last(sample: Sample, spec: NetworkSpec) -> Sample:
    """Rename the axes of a simulation so that its box has the most cells along the last one.

    Organs of one box in any position then make a batch, which is turned as a whole.
    """
    order = np.argsort(organ_grid(sample.surface, spec).shape, kind="stable")
    # An odd order mirrors the organ: its triangles and tetrahedra are turned inside out.
    odd = np.linalg.det(np.eye(3)[order]) < 0.0
    return replace(
        sample,
        vertices=np.ascontiguousarray(sample.vertices[:, order]),
        displacement=np.ascontiguousarray(sample.displacement[:, order]),
        faces=sample.faces[:, [0, 2, 1]] if odd else sample.faces,
        tets=sample.tets[:, [0, 1, 3, 2]] if odd else sample.tets,
    )


def _misattached(sample: Sample, grid: VoxelGrid, share: float) -> Tensor:
    """Return the flags of regions that are smaller and larger by a share of their area, (2, X, Y, Z)."""
    regions = [resized(sample.surface, sample.attached_mask, 1.0 + sign * share) for sign in (-1, 1)]
    return torch.stack([zero_displacement(grid, sample.surface, region).half() for region in regions])


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
