import dataclasses
import itertools

import numpy as np
import pytest
import torch

from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_input import organ_grid
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec, rigid_spec
from softtissue_training.learning.augment import exchange_axes, flip, random_orientation
from softtissue_training.learning.batch_order import epoch_batches
from softtissue_training.learning.box import crop, draw_box, draw_growth, own_box
from softtissue_training.learning.dataset import draw_visible, longest_axis_last, prepare
from softtissue_training.learning.view import view_of
from softtissue_training.learning.voxel_target import voxel_displacement
from softtissue_training.learning.voxels import Voxeliser, voxelise
from training.coarse import LINEAR

SPEC = NetworkSpec(spacing=0.30 / 32, margin_cells=1)
RIGID_SPEC = rigid_spec(0.30 / 32, margin_cells=1)
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


def test_batches_use_every_sample_once_and_join_only_one_kind():
    kinds = [(24, 16, 16), (16, 16, 16)] * 9
    drawn = epoch_batches(kinds, 4, np.random.default_rng(2))
    assert sorted(index for batch in drawn for index in batch) == list(range(18))
    assert [len(batch) for batch in sorted(drawn, key=len)] == [1, 1, 4, 4, 4, 4]
    assert all(len({kinds[index] for index in batch}) == 1 for batch in drawn)
    assert drawn != epoch_batches(kinds, 4, np.random.default_rng(3))
    assert drawn == epoch_batches(kinds, 4, np.random.default_rng(2))


def test_samples_voxelised_together_are_those_voxelised_alone(samples):
    prepared = [prepare(sample, SPEC, surroundings=True) for sample in samples[:3]]
    assert len({sample.grid.shape for sample in prepared}) == 1
    seen = [draw_visible(sample, np.random.default_rng(8), (0.3, 0.3)) for sample in prepared]
    for spec in (SPEC, RIGID_SPEC):
        views = [view_of(*pair, spec) for pair in seen]
        voxels = Voxeliser(spec, CPU)(prepared, views)
        for number, (sample, pair) in enumerate(zip(prepared, seen, strict=True)):
            for together, alone in zip(voxels, voxelise(sample, *pair, spec, CPU), strict=True):
                torch.testing.assert_close(together[number : number + 1], alone, rtol=0, atol=0)


def test_noise_has_the_deviation_asked_for_on_every_component(samples):
    prepared = prepare(samples[1], SPEC)
    clean = draw_visible(prepared, np.random.default_rng(3), (0.9, 0.9))
    noisy = draw_visible(prepared, np.random.default_rng(3), (0.9, 0.9), noise_m=(0.002, 0.002))
    torch.testing.assert_close(noisy[0], clean[0], rtol=0, atol=0)
    noise = noisy[1] - clean[1]
    assert len(noise) > 2000
    np.testing.assert_allclose(noise.std(dim=0), 0.002, rtol=0.05)
    assert torch.corrcoef(noise.T).triu(1).abs().max() < 0.1


def test_sparse_correspondences_are_points_of_the_patch(samples):
    prepared = prepare(samples[1], SPEC)
    counts = set()
    for seed in range(20):
        patch, moved = draw_visible(prepared, np.random.default_rng(seed), (0.3, 0.3))
        points, displacement = draw_visible(
            prepared, np.random.default_rng(seed), (0.3, 0.3), correspondences=(5, 40)
        )
        index = {tuple(point): row for row, point in enumerate(patch.tolist())}
        rows = [index[tuple(point)] for point in points.tolist()]
        assert len(set(rows)) == len(points)
        torch.testing.assert_close(displacement, moved[rows], rtol=0, atol=0)
        counts.add(len(points))
    assert 5 <= min(counts) < 12 and 20 < max(counts) <= 40


def test_the_middle_of_the_surroundings_is_the_box_of_the_estimator(samples):
    for sample in samples[:3]:
        alone, around = prepare(sample, SPEC), prepare(sample, SPEC, surroundings=True)
        assert around.box == alone.box == alone.grid.shape
        assert around.grid.shape == (32, 32, 32)
        seen = draw_visible(alone, np.random.default_rng(4), (0.5, 0.5))
        cut = crop(voxelise(around, *seen, SPEC, CPU), own_box(around.box, around.grid.shape))
        for part, whole in zip(cut, voxelise(alone, *seen, SPEC, CPU), strict=True):
            torch.testing.assert_close(part, whole, atol=1e-4, rtol=0)


def test_boxes_that_grow_contain_the_organ_and_reach_the_whole_cube():
    rng = np.random.default_rng(5)
    box, grid = (16, 24, 16), (32, 32, 32)
    growths = {draw_growth([box], [grid], 0.7, 8, rng) for _ in range(60)}
    assert growths == {0, 8, 16}
    assert draw_box(box, grid, 0, rng) == own_box(box, grid) == (slice(8, 24), slice(4, 28), slice(8, 24))
    firsts = set()
    for _ in range(60):
        parts = draw_box(box, grid, 8, rng)
        assert [part.stop - part.start for part in parts] == [24, 32, 24]
        assert all(
            part.start <= own.start and own.stop <= part.stop
            for part, own in zip(parts, own_box(box, grid), strict=True)
        )
        firsts.add(parts[0].start)
    assert firsts == set(range(9))
    assert draw_box(box, grid, 16, rng) == (slice(0, 32),) * 3
    assert draw_growth([grid], [grid], 1.0, 8, rng) == 0


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
        results.add(inputs.numpy().tobytes())
    assert len(results) > 4


def test_mirrored_copies_keep_the_axes_and_one_orientation_changes_nothing(samples):
    prepared = prepare(samples[3], SPEC, surroundings=True)
    voxels = voxelise(prepared, *draw_visible(prepared, np.random.default_rng(5), (1.0, 1.0)), SPEC, CPU)
    shape = prepared.grid.shape
    distances = voxels[0][0, 0]
    mirrored = [distances.flip(axes) for axes in ((), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2))]
    found = set()
    for seed in range(40):
        turned = random_orientation(*voxels, np.random.default_rng(seed), shape, orientations=8)[0][0, 0]
        found.add(next(number for number, copy in enumerate(mirrored) if torch.equal(copy, turned)))
    assert found == set(range(8))
    same = random_orientation(*voxels, np.random.default_rng(0), shape, orientations=1)
    assert all(torch.equal(one, other) for one, other in zip(same, voxels, strict=True))


def _signed_volumes(sample):
    """Of the tetrahedra, and the volume that the surface's triangles enclose; m^3."""
    corners = sample.vertices[sample.tets].astype(np.float64)
    tets = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    triangles = sample.vertices[sample.faces].astype(np.float64)
    return tets, np.linalg.det(triangles).sum() / 6.0


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_the_longest_axis_comes_last_whatever_the_position(samples, order):
    spec = NetworkSpec(spacing=0.30 / 96, margin_cells=0)
    sample = dataclasses.replace(samples[0], vertices=samples[0].vertices * np.float32([0.5, 0.8, 1.2]))
    assert len(set(organ_grid(sample.surface, spec).shape)) == 3
    odd = np.linalg.det(np.eye(3)[list(order)]) < 0.0
    turned = dataclasses.replace(
        sample,
        vertices=sample.vertices[:, order],
        displacement=sample.displacement[:, order],
        faces=sample.faces[:, [0, 2, 1]] if odd else sample.faces,
        tets=sample.tets[:, [0, 1, 3, 2]] if odd else sample.tets,
    )
    found = longest_axis_last(turned, spec)
    shape = organ_grid(found.surface, spec).shape
    assert list(shape) == sorted(shape)
    # One organ in six positions is six times the same.
    expected = longest_axis_last(sample, spec)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    np.testing.assert_array_equal(found.displacement, expected.displacement)
    tets, enclosed = _signed_volumes(found)
    assert (tets > 0.0).all()
    assert enclosed == pytest.approx(tets.sum(), rel=1e-4)
    axis = [
        int(np.flatnonzero((found.vertices[:, [part]] == sample.vertices).all(axis=0))[0])
        for part in range(3)
    ]
    np.testing.assert_array_equal(found.displacement, sample.displacement[:, axis])
