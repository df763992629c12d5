"""From an organ and an observation to the tensor that a network reads: the only implementation, for training and use.

Channels, scales and frame are those of the network's specification (`network_spec`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_spec import LOG_SIGMA_RANGE, OBSERVED, NetworkSpec
from softtissue_estimator.estimators.paper.rasterise import rasterise
from softtissue_estimator.estimators.paper.rigid_frame import RIGID, fit_frame, into_frame, into_frames
from softtissue_estimator.inference.device import to_device
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.patch_average import ObservedPatches, average_patches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_estimator.support.cache import Arrays, cached_arrays

FloatArray = NDArray[np.float64]

PREPROCESSING_VERSION = 1  # raise it whenever the channels of an organ change: caches depend on it


@dataclass(frozen=True)
class OrganChannels:
    """The part of the input that does not change from frame to frame.

    Attributes
    ----------
    grid
        The organ's grid.
    signed_distance
        (X, Y, Z) float32 metres, positive outside.
    zero_displacement
        (X, Y, Z) float32, 1 on attached surface and 0 elsewhere.
    """

    grid: VoxelGrid
    signed_distance: Tensor
    zero_displacement: Tensor

    @property
    def organ_mask(self) -> Tensor:
        """(X, Y, Z) bool, true inside the organ."""
        return self.signed_distance <= 0.0

    @property
    def near_mask(self) -> Tensor:
        """(X, Y, Z) bool, true inside the organ and in the cells next to that, between which its surface lies."""
        inside = self.organ_mask[None, None].float()
        return functional.max_pool3d(inside, kernel_size=3, stride=1, padding=1)[0, 0] > 0.0

    def cells(self) -> Tensor:
        """Return where the cells are, (X, Y, Z, 3) float32 metres, on the device of the channels."""
        points = torch.from_numpy(self.grid.points()).float().reshape(*self.grid.shape, 3)
        return points.to(self.signed_distance.device)

    def to(self, device: str | torch.device) -> OrganChannels:
        """Return the same channels on another device."""
        return OrganChannels(self.grid, self.signed_distance.to(device), self.zero_displacement.to(device))


def organ_grid(surface: SurfaceMesh, spec: NetworkSpec) -> VoxelGrid:
    """Return the grid on which a network of this specification is given the organ.

    A network trained on the cube sees the cube, or, for an organ that does not fit into it, the smallest box that does.
    """
    lower, upper = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    if spec.cube_side_m > 0.0:
        half = 0.5 * (spec.cube_side_m - spec.spacing)  # from the middle to the outermost cell centres
        middle = 0.5 * (lower + upper)
        lower, upper = np.minimum(lower, middle - half), np.maximum(upper, middle + half)
        return VoxelGrid.covering(
            lower + 1e-9, upper - 1e-9, spec.spacing, multiple=spec.architecture.multiple, margin_cells=0
        )
    return VoxelGrid.covering(
        lower, upper, spec.spacing, multiple=spec.architecture.multiple, margin_cells=spec.margin_cells
    )


def organ_channels(surface: SurfaceMesh, attached: NDArray[np.bool_], spec: NetworkSpec) -> OrganChannels:
    """Compute signed distance and zero-displacement flag of an organ on its grid.

    Parameters
    ----------
    surface
        Preoperative surface, metres.
    attached
        (n,) true for the attached vertices of the surface.
    """
    return channels_on_grid(organ_grid(surface, spec), surface, attached)


def cached_channels(organ: Organ, grid: VoxelGrid) -> OrganChannels:
    """Return signed distance and zero-displacement flag of an organ on a grid, kept in the user's cache."""

    def compute() -> Arrays:
        channels = channels_on_grid(grid, organ.surface, organ.attached)
        return {
            "signed_distance": channels.signed_distance.numpy(),
            "zero_displacement": channels.zero_displacement.numpy(),
        }

    def fits(arrays: Arrays) -> bool:
        return arrays.keys() == {"signed_distance", "zero_displacement"} and all(
            array.dtype == np.float32 and array.shape == tuple(grid.shape) and bool(np.isfinite(array).all())
            for array in arrays.values()
        )

    parameters: dict[str, float | int | str | bool] = {
        "spacing": grid.spacing,
        "shape": str(grid.shape),
        "origin": str(grid.origin),
    }
    stored = cached_arrays("channels", organ.digest, PREPROCESSING_VERSION, parameters, compute, fits)
    return OrganChannels(
        grid, torch.from_numpy(stored["signed_distance"]), torch.from_numpy(stored["zero_displacement"])
    )


def channels_on_grid(grid: VoxelGrid, surface: SurfaceMesh, attached: NDArray[np.bool_]) -> OrganChannels:
    """Compute signed distance and zero-displacement flag on a given grid; parameters as of `organ_channels`."""
    distance = torch.from_numpy(signed_distance(surface, grid.points())).float().reshape(grid.shape)
    return OrganChannels(grid, distance, zero_displacement(grid, surface, attached))


def zero_displacement(grid: VoxelGrid, surface: SurfaceMesh, attached: NDArray[np.bool_]) -> Tensor:
    """Return z(p): (X, Y, Z) float32, 1 in cells near attached surface, else 0."""
    # Sampled at half a cell so that the flag is closed however coarse the triangles are.
    inner_faces = np.all(attached[surface.faces], axis=1)
    samples = sample_faces(surface, inner_faces, 0.5 * grid.spacing)[0]
    points = torch.from_numpy(np.concatenate([surface.vertices[attached], samples])).double()
    return rasterise(grid, points, torch.ones(len(points), 1))[1].float()


def visible_displacement(
    grid: VoxelGrid, reference: Tensor, displacement: Tensor, sigma: Tensor | None = None
) -> Tensor:
    """Return u_vis(p): (X, Y, Z, 3) float32 metres, zero where nothing was observed; see `observed_displacement`."""
    return observed_displacement(grid, reference, displacement, sigma)[0]


def observed_displacement(
    grid: VoxelGrid, reference: Tensor, displacement: Tensor, sigma: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return u_vis(p) and where something was observed.

    Parameters
    ----------
    reference
        (n, 3) preoperative positions of tracked points, metres.
    displacement
        (n, 3) metres.
    sigma
        (n,) standard deviations, metres: nearby points are averaged with weights 1 / sigma^2. Equal if None.

    Returns
    -------
    visible
        (X, Y, Z, 3) float32 metres, zero where nothing was observed.
    observed
        (X, Y, Z) bool.
    """
    weights = None if sigma is None else sigma.double().clamp_min(1e-5).pow(-2)
    return rasterise(grid, reference, displacement.float(), weights)


def known_displacement(
    visible: Tensor, observed: Tensor, zero_displacement: Tensor, attached: Tensor | None
) -> Tensor:
    """Join what is observed and what attached tissue does.

    Parameters
    ----------
    visible
        (..., 3) visible displacement in the network's frame, metres.
    observed
        (...) bool, where something was observed.
    zero_displacement
        (...) the flag z.
    attached
        (..., 3) displacement of tissue that does not move, in the network's frame; None where that is zero.

    Returns
    -------
    Tensor
        (..., 4): the displacement, metres, which is that of attached tissue where nothing was observed; and 1 where
        something was.
    """
    if attached is not None:
        flagged = zero_displacement.unsqueeze(-1) * attached
        visible = torch.where(observed.unsqueeze(-1), visible, flagged)
    return torch.cat([visible, observed.unsqueeze(-1).to(visible.dtype)], dim=-1)


def motion_of(patches: ObservedPatches, spec: NetworkSpec) -> RigidMotion | None:
    """Return the rigid motion in whose frame a network is told what is observed; None where that is the organ's."""
    return fit_frame(patches) if spec.frame == RIGID else None


def known_of(
    observation: Observation, channels: OrganChannels, cells: Tensor, motion: RigidMotion | None
) -> Tensor:
    """Return what is known of an observation in the frame of a motion, as `known_displacement` does.

    Parameters
    ----------
    cells
        As `OrganChannels.cells` returns them, on the device of the channels.
    motion
        As `motion_of` returns it.
    """
    attached, device = None, cells.device
    if motion is None:
        displacement = to_device(observation.displacement, device)
    else:
        in_frame = into_frame(motion, observation.reference, observation.displacement)
        # The motion's few numbers travel with the displacements: each copy to a GPU has its price.
        rows = np.concatenate([in_frame, motion.rotation, motion.translation[None]])
        displacement, rotation, translation = to_device(rows, device).float().split([len(in_frame), 3, 1])
        attached = into_frames(rotation[None], translation, cells[None], torch.zeros((), device=device))[0]
    visible, observed = observed_displacement(
        channels.grid,
        to_device(observation.reference, device),
        displacement,
        to_device(observation.sigma, device),
    )
    return known_displacement(visible, observed, channels.zero_displacement, attached)


def input_of(organ: Organ, channels: OrganChannels, observation: Observation, spec: NetworkSpec) -> Tensor:
    """Return what a network reads of an observation, (1, c, X, Y, Z) float32, on the device of the channels."""
    motion = motion_of(average_patches(observation, organ.surface_lookup), spec)
    known = known_of(observation, channels, channels.cells(), motion)
    return assemble_input(channels, known, spec)


def assemble_input(channels: OrganChannels, known: Tensor, spec: NetworkSpec) -> Tensor:
    """Stack and scale the channels of one organ.

    Parameters
    ----------
    known
        (X, Y, Z, 4) as `known_displacement` returns it; where the specification has no channel for what was observed,
        (X, Y, Z, 3) will do.

    Returns
    -------
    Tensor
        (1, 5 or 6, X, Y, Z) float32, on the device of the channels.
    """
    return to_batch(stacked_channels(channels.signed_distance, channels.zero_displacement, known, spec))


def stacked_channels(
    signed_distance: Tensor, zero_displacement: Tensor, known: Tensor, spec: NetworkSpec
) -> Tensor:
    """Stack and scale channels (..., X, Y, Z) and what is known (..., X, Y, Z, 3 or 4): (..., X, Y, Z, c) float32."""
    seen = [known[..., 3]] if OBSERVED in spec.channels else []
    parts = (signed_distance, *known[..., :3].unbind(-1), zero_displacement, *seen)
    # Numbers instead of a tensor of them, which would be copied to the device in every frame.
    scaled = [part * scale for part, scale in zip(parts, spec.input_scales, strict=True)]
    return torch.stack(scaled, dim=-1)


def field_of(outputs: Tensor, spec: NetworkSpec) -> Tensor:
    """Return displacement and, if the network gives it, standard deviation, (..., 3 or 4) m, of its outputs."""
    if not spec.sigma_is_calibrated:
        return outputs[..., :3] * spec.output_scale
    log_sigma = outputs[..., 3:].clamp(*LOG_SIGMA_RANGE)
    sigma = log_sigma.exp() * (spec.output_scale * spec.sigma_scale)
    return torch.cat([outputs[..., :3] * spec.output_scale, sigma], dim=-1)


def to_batch(grid_values: Tensor) -> Tensor:
    """Turn (X, Y, Z, C) into (1, C, X, Y, Z), the only place where this happens."""
    return grid_values.permute(3, 0, 1, 2).unsqueeze(0).contiguous()


def from_batch(batch_values: Tensor) -> Tensor:
    """Turn (1, C, X, Y, Z) back into (X, Y, Z, C)."""
    return batch_values.squeeze(0).permute(1, 2, 3, 0)
