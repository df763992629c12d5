"""From prepared samples and views of them to the tensors that a network reads and should answer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_input import known_displacement, stacked_channels
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.estimators.paper.rasterise import rasterise_many
from softtissue_estimator.estimators.paper.rigid_frame import into_frames
from softtissue_training.learning.dataset import PreparedSample
from softtissue_training.learning.view import View, view_of

Voxels = tuple[Tensor, Tensor, Tensor]
Kept = tuple[Tensor, Tensor, Tensor]


class Voxeliser:
    """Voxelises views on a device, where the samples stay from their first use on.

    Parameters
    ----------
    spec
        Of the network.
    keep
        Whether samples stay on the device, which a GPU has the memory for.
    """

    def __init__(self, spec: NetworkSpec, device: torch.device, *, keep: bool = False) -> None:
        self._spec, self._device, self._keep = spec, device, keep
        self._kept: dict[int, Kept] = {}

    def __call__(self, samples: Sequence[PreparedSample], views: Sequence[View]) -> Voxels:
        """Return network input, target and mask of samples whose grids have the same cell counts.

        Returns
        -------
        inputs
            (B, c, X, Y, Z) float32, scaled.
        target
            (B, 3, X, Y, Z) float32 in the network's unit of length, in its frame.
        mask
            (B, 1, X, Y, Z) float32, 1 inside the organ.
        """
        parts = [self._on_device(sample) for sample in samples]
        distance = torch.stack([part[0] for part in parts]).float()
        flag = torch.stack(
            [part[1][view.attachment] for part, view in zip(parts, views, strict=True)]
        ).float()
        target = torch.stack([part[2] for part in parts]).float()
        counts = [len(view.points) for view in views]
        points = torch.cat([view.points for view in views]).to(self._device).split(counts)
        moved = torch.cat([view.displacement for view in views]).to(self._device).split(counts)
        grids = [sample.grid for sample in samples]
        visible, observed = rasterise_many(grids, points, moved)
        mask = (distance <= 0.0).unsqueeze(-1)
        attached = None
        motions = [view.motion for view in views if view.motion is not None]
        if motions:
            rotation = torch.tensor([motion.rotation.tolist() for motion in motions], device=self._device)
            translation = torch.tensor(
                [motion.translation.tolist() for motion in motions], device=self._device
            )
            cells = _cells(grids, self._device)
            attached = into_frames(rotation, translation, cells, torch.zeros((), device=self._device))
            target = into_frames(rotation, translation, cells, target) * mask
        known = known_displacement(visible, observed, flag, attached)
        inputs = stacked_channels(distance, flag, known, self._spec)
        return (
            inputs.permute(0, 4, 1, 2, 3),
            (target / self._spec.output_scale).permute(0, 4, 1, 2, 3),
            mask.permute(0, 4, 1, 2, 3).float(),
        )

    def _on_device(self, sample: PreparedSample) -> Kept:
        """Return signed distance, flags (v, X, Y, Z) and target of a sample."""
        kept = self._kept.get(id(sample))
        if kept is not None:
            return kept
        flags = sample.zero_displacement[None]
        if sample.misattached is not None:
            flags = torch.cat([flags, sample.misattached])
        tensors = (sample.signed_distance, flags, sample.target)
        kept = (tensors[0].to(self._device), tensors[1].to(self._device), tensors[2].to(self._device))
        if self._keep:
            self._kept[id(sample)] = kept
        return kept


def voxelise(
    sample: PreparedSample, points: Tensor, displacement: Tensor, spec: NetworkSpec, device: torch.device
) -> Voxels:
    """Turn a sample and its visible points into network input, target and mask, (1, ...), as `Voxeliser` does.

    Parameters
    ----------
    points, displacement
        (k, 3) float32 metres, in the organ's frame.
    """
    return Voxeliser(spec, device)([sample], [view_of(points, displacement, spec)])


def _cells(grids: Sequence[VoxelGrid], device: torch.device) -> Tensor:
    """Return where the cells of grids with the same cell counts are, (B, X, Y, Z, 3) float32 metres."""
    spacing = grids[0].spacing
    axes = [torch.arange(count, dtype=torch.float32, device=device) * spacing for count in grids[0].shape]
    offsets = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    origins = torch.tensor([grid.origin for grid in grids], dtype=torch.float32, device=device)
    return origins[:, None, None, None] + offsets
