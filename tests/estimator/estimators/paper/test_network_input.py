"""From organ and observation to the network's input: order, scale, sign, flips."""

import numpy as np
import torch
import trimesh

from softtissue_estimator.estimators.paper.network_input import (
    assemble_input,
    from_batch,
    organ_channels,
    organ_grid,
    to_batch,
    visible_displacement,
)
from softtissue_estimator.estimators.paper.network_spec import CHANNELS, NetworkSpec
from softtissue_estimator.organ.mesh import SurfaceMesh

SPEC = NetworkSpec()


def _ellipsoid() -> SurfaceMesh:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    return SurfaceMesh(np.asarray(sphere.vertices) * [0.06, 0.045, 0.03], np.asarray(sphere.faces))


def test_channels_order_and_scale() -> None:
    surface = _ellipsoid()
    attached = surface.vertices[:, 0] < -0.05
    channels = organ_channels(surface, attached, SPEC)
    visible = torch.arange(3.0).expand(*channels.grid.shape, 3) + 1.0
    inputs = assemble_input(channels, visible, SPEC)
    assert inputs.shape == (1, 5, *channels.grid.shape) and len(CHANNELS) == 5
    torch.testing.assert_close(inputs[0, 0], channels.signed_distance * 5.0)
    for axis in range(3):
        torch.testing.assert_close(inputs[0, 1 + axis], torch.full(channels.grid.shape, (axis + 1.0) * 50.0))
    torch.testing.assert_close(inputs[0, 4], channels.zero_displacement * 5.0)
    # The paper's proportions: distance and flag at a tenth of the displacement.
    scales = np.array(SPEC.input_scales)
    np.testing.assert_allclose(scales / scales[1], [0.1, 1.0, 1.0, 1.0, 0.1])
    np.testing.assert_allclose(scales[1] * SPEC.output_scale, 1.0)


def test_zero_displacement_marks_the_attached_side_only() -> None:
    surface = _ellipsoid()
    channels = organ_channels(surface, surface.vertices[:, 0] < -0.04, SPEC)
    points = channels.grid.points().reshape(*channels.grid.shape, 3)
    flagged = channels.zero_displacement.numpy() == 1.0
    assert set(np.unique(channels.zero_displacement.numpy())) == {0.0, 1.0}
    assert points[flagged][:, 0].max() < -0.04 + 2 * SPEC.spacing
    # Closed: every cell that the attached surface passes through is flagged.
    near = (np.abs(channels.signed_distance.numpy()) < 0.5 * SPEC.spacing) & (points[..., 0] < -0.045)
    assert near.any() and flagged[near].all()


def test_nothing_attached_gives_an_empty_flag() -> None:
    surface = _ellipsoid()
    channels = organ_channels(surface, np.zeros(len(surface.vertices), dtype=bool), SPEC)
    assert float(channels.zero_displacement.sum()) == 0.0


def test_box_grid_is_smaller_than_the_cube_and_large_organs_work() -> None:
    surface = _ellipsoid()
    box = organ_grid(surface, SPEC)
    cube = organ_grid(surface, NetworkSpec(cube_side_m=0.30))
    assert cube.shape == (64, 64, 64) and box.cells < cube.cells / 8
    large = SurfaceMesh(surface.vertices * 4.0, surface.faces)  # 48 cm long
    for spec in (SPEC, NetworkSpec(cube_side_m=0.30)):
        grid = organ_grid(large, spec)
        assert all(cells % 8 == 0 for cells in grid.shape)
        index = grid.index(large.vertices)
        assert index.min() >= 0.0 and np.all(index.max(axis=0) <= np.array(grid.shape) - 1)


def test_flipping_the_organ_flips_the_input() -> None:
    surface = _ellipsoid()
    attached = surface.vertices[:, 0] < -0.04
    rng = np.random.default_rng(0)
    observed = surface.vertices[rng.choice(len(surface.vertices), 60, replace=False)]
    moved = rng.normal(scale=0.01, size=observed.shape)
    flip = np.array([-1.0, 1.0, 1.0])
    mirrored = SurfaceMesh(surface.vertices * flip, surface.faces[:, ::-1])

    def inputs(mesh: SurfaceMesh, reference: np.ndarray, displacement: np.ndarray) -> torch.Tensor:
        channels = organ_channels(mesh, attached, SPEC)
        visible = visible_displacement(
            channels.grid, torch.from_numpy(reference), torch.from_numpy(displacement)
        )
        return assemble_input(channels, visible, SPEC)

    plain = inputs(surface, observed, moved)
    other = inputs(mirrored, observed * flip, moved * flip)
    expected = plain.flip(2)
    expected[:, 1] *= -1.0
    torch.testing.assert_close(other, expected, atol=2e-5, rtol=1e-4)


def test_batch_layout_is_reversible() -> None:
    values = torch.randn(4, 5, 6, 3, generator=torch.Generator().manual_seed(0))
    assert to_batch(values).shape == (1, 3, 4, 5, 6)
    assert torch.equal(from_batch(to_batch(values)), values)
    assert float(to_batch(values)[0, 2, 1, 3, 5]) == float(values[1, 3, 5, 2])
