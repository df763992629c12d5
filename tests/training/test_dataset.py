import dataclasses

import numpy as np
import pytest
import torch

from softtissue_estimator.grid import VoxelGrid
from softtissue_estimator.network_input import NetworkSpec
from softtissue_training.augment import exchange_axes, flip, random_orientation
from softtissue_training.dataset import batches, draw_visible, prepare, voxelise
from softtissue_training.voxel_target import voxel_displacement

from .conftest import LINEAR

SPEC = NetworkSpec(spacing=0.30 / 32, margin_cells=1)
CPU = torch.device("cpu")


def test_linear_displacement_is_interpolated_exactly(linear_sample):
    prepared = prepare(linear_sample, SPEC)
    inside = (prepared.signed_distance <= 0).numpy()
    field = voxel_displacement(
        prepared.grid,
        linear_sample.vertices.astype(np.float64),
        linear_sample.tets.astype(np.int64),
        linear_sample.displacement.astype(np.float64),
        inside,
    )
    exact = (prepared.grid.points() @ LINEAR.T).reshape(field.shape)
    # Cells that float16 rounding of the distance counts as inside may lie a little outside all tetrahedra.
    assert inside.sum() > 200
    assert np.quantile(np.abs(field - exact)[inside], 0.99) < 1e-7
    assert (field[~inside] == 0.0).all()


def test_cell_outside_all_tetrahedra_takes_the_nearest_vertex():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    grid = VoxelGrid((-0.5, 0.2, 0.2), 0.4, (4, 1, 1))
    values = np.array([[1.0], [2.0], [3.0], [4.0]])
    field = voxel_displacement(
        grid, vertices, np.array([[0, 1, 2, 3]]), values, np.ones(grid.shape, dtype=bool)
    )
    inside = 1.0 + 1.0 * 0.3 + 2.0 * 0.2 + 3.0 * 0.2  # x = 0.3
    np.testing.assert_allclose(field.ravel(), [1.0, 1.0, inside, 2.0])


def test_input_shows_displacement_where_seen_and_target_everywhere_inside(linear_sample):
    prepared = prepare(linear_sample, SPEC)
    points, displacement = draw_visible(prepared, np.random.default_rng(0), (0.3, 0.3))
    inputs, target, mask = voxelise(prepared, points, displacement, SPEC, CPU)
    centres = prepared.grid.points()
    exact = (centres @ LINEAR.T).reshape(*prepared.grid.shape, 3) / SPEC.output_scale
    inside = mask[0, 0].bool().numpy()
    np.testing.assert_allclose(target[0].permute(1, 2, 3, 0).numpy()[inside], exact[inside], atol=0.01)
    assert (target[0][:, ~inside] == 0).all()

    seen = (inputs[0, 1:4] != 0).any(dim=0).numpy().reshape(-1)
    to_seen = np.abs(centres[:, None] - points.numpy()[::7]).max(axis=2).min(axis=1) / SPEC.spacing
    assert seen.sum() > 30
    assert to_seen[seen].max() < 3.0
    shown = inputs[0, 1:4].reshape(3, -1).T.numpy()[seen] / SPEC.input_scales[1]
    # Smoothed over two cells, so roughly the displacement of the cell.
    assert (
        np.abs(shown - centres[seen] @ LINEAR.T).max() < 2.5 * SPEC.spacing * np.abs(LINEAR).sum(axis=1).max()
    )


def test_visible_share_is_as_drawn(samples):
    prepared = prepare(samples[1], SPEC)
    total = prepared.areas.sum()
    for share in (0.1, 0.6):
        points, _ = draw_visible(prepared, np.random.default_rng(1), (share, share))
        faces = np.flatnonzero(np.isin(np.arange(len(prepared.faces)), _faces_of(prepared, points)))
        assert prepared.areas[faces].sum() / total == pytest.approx(share, abs=0.03)


def _faces_of(prepared, points):
    index = {
        tuple(point.tolist()): face for point, face in zip(prepared.points, prepared.point_face, strict=True)
    }
    return [index[tuple(point.tolist())] for point in points]


def test_batches_use_every_sample_once_and_join_only_grids_that_fit(samples):
    prepared = [prepare(sample, SPEC) for sample in samples] * 3
    drawn = list(batches(prepared, 2, np.random.default_rng(2)))
    assert sorted(index for batch in drawn for index in batch) == list(range(18))
    assert max(len(batch) for batch in drawn) == 2
    for batch in drawn:
        assert len({tuple(sorted(prepared[index].grid.shape)) for index in batch}) == 1


def _mirrored(sample, axis):
    sign = np.ones(3, dtype=np.float32)
    sign[axis] = -1
    return dataclasses.replace(
        sample,
        vertices=sample.vertices * sign,
        displacement=sample.displacement * sign,
        faces=sample.faces[:, [0, 2, 1]],
        tets=sample.tets[:, [0, 1, 3, 2]],
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_flip_is_the_input_of_the_mirrored_organ(samples, axis):
    prepared, mirrored = prepare(samples[0], SPEC), prepare(_mirrored(samples[0], axis), SPEC)
    points, displacement = draw_visible(prepared, np.random.default_rng(3), (0.4, 0.4))
    sign = torch.ones(3)
    sign[axis] = -1.0
    inputs, target, _ = voxelise(prepared, points, displacement, SPEC, CPU)
    expected, expected_target, _ = voxelise(mirrored, points * sign, displacement * sign, SPEC, CPU)
    flipped, flipped_target = flip(inputs, target, (axis,))
    assert inputs[0, 1 + axis].abs().max() > 0.05
    torch.testing.assert_close(flipped[:, :4], expected[:, :4], atol=2e-3, rtol=0)
    torch.testing.assert_close(flipped_target, expected_target, atol=5e-3, rtol=0)
    assert not torch.allclose(inputs[:, :4], expected[:, :4], atol=0.02)


def test_exchanged_axes_are_the_input_of_the_turned_organ(samples):
    sample, order = samples[0], [2, 0, 1]
    turned = dataclasses.replace(
        sample, vertices=sample.vertices[:, order], displacement=sample.displacement[:, order]
    )
    prepared, expected_sample = prepare(sample, SPEC), prepare(turned, SPEC)
    points, displacement = draw_visible(prepared, np.random.default_rng(4), (0.4, 0.4))
    inputs, target, _ = voxelise(prepared, points, displacement, SPEC, CPU)
    expected, expected_target, _ = voxelise(
        expected_sample, points[:, order], displacement[:, order], SPEC, CPU
    )
    exchanged, exchanged_target = exchange_axes(inputs, target, (2, 0, 1))
    torch.testing.assert_close(exchanged[:, :4], expected[:, :4], atol=2e-3, rtol=0)
    torch.testing.assert_close(exchanged_target, expected_target, atol=5e-3, rtol=0)


def test_random_orientation_keeps_input_target_and_mask_together(samples):
    prepared = prepare(samples[3], SPEC)
    points, displacement = draw_visible(prepared, np.random.default_rng(5), (1.0, 1.0))
    voxels = voxelise(prepared, points, displacement, SPEC, CPU)
    shape = tuple(sorted(prepared.grid.shape))
    results = set()
    for seed in range(12):
        inputs, target, mask = random_orientation(*voxels, np.random.default_rng(seed), shape)
        assert tuple(inputs.shape[2:]) == shape
        torch.testing.assert_close(mask[:, 0].bool(), inputs[:, 0] <= 0)
        assert (target * (1 - mask) == 0).all()
        shown, wanted = (
            inputs[:, 1:4][(mask > 0).expand(-1, 3, -1, -1, -1)],
            target[(mask > 0).expand(-1, 3, -1, -1, -1)],
        )
        seen = shown != 0
        assert torch.corrcoef(torch.stack([shown[seen], wanted[seen]]))[0, 1] > 0.9
        results.add(round(float(inputs.flatten()[: inputs.numel() // 3].sum()), 3))
    assert len(results) > 4
