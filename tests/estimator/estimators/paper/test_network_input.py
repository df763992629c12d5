"""From organ and observation to the network's input: order, scale, sign, flips."""

import dataclasses
import math

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from softtissue_estimator.estimators.paper.displacement_field import FieldSampler
from softtissue_estimator.estimators.paper.network_input import (
    OrganChannels,
    assemble_input,
    field_of,
    from_batch,
    input_of,
    known_displacement,
    known_of,
    motion_of,
    observed_displacement,
    organ_channels,
    organ_grid,
    to_batch,
    visible_displacement,
)
from softtissue_estimator.estimators.paper.network_spec import CHANNELS, OBSERVED, NetworkSpec, rigid_spec
from softtissue_estimator.estimators.paper.rigid_frame import RIGID
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.patch_average import average_patches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import Organ

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


RIGID_SPEC = rigid_spec(0.006)
MOTION = RigidMotion(Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix(), np.array([0.01, 0.02, -0.03]))
BEND = np.array([0.002, 0.0, 0.001])


def test_a_cell_that_is_visible_and_attached_takes_the_visible_value() -> None:
    visible = torch.zeros(2, 2, 1, 3)
    observed = torch.tensor([[True, True], [False, False]]).reshape(2, 2, 1)
    flag = torch.tensor([[1.0, 0.0], [1.0, 0.0]]).reshape(2, 2, 1)
    visible[observed] = torch.tensor([0.001, 0.002, 0.003])
    attached = torch.full((2, 2, 1, 3), 0.05)
    known = known_displacement(visible, observed, flag, attached)
    assert known.shape == (2, 2, 1, 4)
    torch.testing.assert_close(known[0, :, 0, :3], torch.tensor([[0.001, 0.002, 0.003]]).expand(2, 3))
    torch.testing.assert_close(known[1, 0, 0, :3], torch.tensor([0.05, 0.05, 0.05]))  # attached alone
    assert not known[1, 1, 0, :3].any()  # neither
    assert torch.equal(known[..., 3], observed.float())
    # Where attached tissue does not move, nothing is written over it.
    assert torch.equal(known_displacement(visible, observed, flag, None)[..., :3], visible)


def _observed_ellipsoid() -> tuple[OrganChannels, Observation]:
    """Attached to one side and observed on the other, with cells in the middle that are both."""
    surface = _ellipsoid()
    channels = organ_channels(surface, surface.vertices[:, 0] < 0.005, RIGID_SPEC)
    reference = surface.vertices[surface.vertices[:, 0] > -0.005]
    moved = MOTION.apply(reference + BEND) - reference
    return channels, Observation(reference, moved, np.full(len(reference), 5e-4))


def test_what_is_known_stands_in_the_frame_of_the_motion() -> None:
    channels, observation = _observed_ellipsoid()
    cells = channels.cells()
    known = known_of(observation, channels, cells, MOTION).double()
    flag, seen = channels.zero_displacement == 1.0, known[..., 3] == 1.0
    assert min(int((flag & seen).sum()), int((flag & ~seen).sum()), int((~flag & seen).sum())) > 20
    # All that is observed is the bend that the motion leaves, on attached cells too.
    expected = torch.from_numpy(BEND).expand(int(seen.sum()), 3)
    torch.testing.assert_close(known[seen][:, :3], expected, rtol=0, atol=1e-7)
    # Attached tissue that is not observed stands still: R^T (x - t) - x.
    points = channels.grid.points().reshape(*channels.grid.shape, 3)[(flag & ~seen).numpy()]
    still = (points - MOTION.translation) @ MOTION.rotation - points
    np.testing.assert_allclose(known[flag & ~seen][:, :3].numpy(), still, rtol=0, atol=1e-7)
    assert np.linalg.norm(still, axis=1).min() > 0.01
    assert not known[~flag & ~seen].any()
    torch.testing.assert_close(cells.double().numpy()[(flag & ~seen).numpy()], points, rtol=0, atol=1e-7)


def test_the_sixth_channel_tells_a_point_at_rest_from_one_that_was_not_seen() -> None:
    surface = _ellipsoid()
    channels = organ_channels(surface, np.zeros(len(surface.vertices), dtype=bool), RIGID_SPEC)
    reference = torch.from_numpy(surface.vertices[surface.vertices[:, 2] > 0.02])
    visible, observed = observed_displacement(channels.grid, reference, torch.zeros_like(reference))
    assert not visible.any() and 20 < int(observed.sum()) < channels.grid.cells / 4
    inputs = assemble_input(
        channels, known_displacement(visible, observed, channels.zero_displacement, None), RIGID_SPEC
    )
    assert RIGID_SPEC.channels == (*CHANNELS, OBSERVED) and inputs.shape == (1, 6, *channels.grid.shape)
    assert not inputs[0, 1:4].any()
    assert torch.equal(inputs[0, 5], observed.float())


def test_scales_of_the_rigid_frame_and_networks_without_its_extras() -> None:
    channels, observation = _observed_ellipsoid()
    known = known_of(observation, channels, channels.cells(), MOTION)
    inputs = assemble_input(channels, known, RIGID_SPEC)
    torch.testing.assert_close(inputs[0, 0], 5.0 * channels.signed_distance)
    torch.testing.assert_close(inputs[0, 4], 5.0 * channels.zero_displacement)
    torch.testing.assert_close(inputs[0, 1:4], 200.0 * known[..., :3].permute(3, 0, 1, 2))
    assert RIGID_SPEC.frame == RIGID and RIGID_SPEC.architecture.out_channels == 4
    plain = rigid_spec(0.006, sigma=False, observed=False, margin_cells=0, widths=(4, 4, 4, 8))
    assert (plain.architecture.in_channels, plain.architecture.out_channels) == (5, 3)
    assert (
        plain.channels == CHANNELS and plain.margin_cells == 0 and plain.architecture.widths == (4, 4, 4, 8)
    )
    assert torch.equal(assemble_input(channels, known, plain), inputs[:, :5])


def test_input_of_an_observation_is_that_of_its_parts() -> None:
    channels, observation = _observed_ellipsoid()
    surface = _ellipsoid()
    organ = Organ("ellipsoid", "organ", surface, (), surface.vertices[:, 0] < 0.005, None, "ellipsoid")
    patches = average_patches(observation, organ.surface_lookup)
    motion = motion_of(patches, RIGID_SPEC)
    assert motion is not None and motion_of(patches, SPEC) is None
    np.testing.assert_allclose(motion.rotation, MOTION.rotation, atol=1e-3)
    known = known_of(observation, channels, channels.cells(), motion)
    assert torch.equal(
        input_of(organ, channels, observation, RIGID_SPEC), assemble_input(channels, known, RIGID_SPEC)
    )
    in_organ = known_of(observation, channels, channels.cells(), None)
    assert torch.equal(input_of(organ, channels, observation, SPEC), assemble_input(channels, in_organ, SPEC))


def test_field_is_displacement_and_deviation_in_metres() -> None:
    outputs = torch.tensor([[1.0, -2.0, 0.5, math.log(0.3)], [0.0, 0.0, 0.0, 90.0], [0.0, 0.0, 0.0, -90.0]])
    spec = dataclasses.replace(RIGID_SPEC, sigma_scale=0.7)
    field = field_of(outputs, spec)
    torch.testing.assert_close(field[0], torch.tensor([0.005, -0.010, 0.0025, 0.3 * 0.7 * 0.005]))
    # However sure or unsure the network says it is, the deviation stays a number.
    torch.testing.assert_close(field[1:, 3], torch.tensor([math.exp(4.0), math.exp(-6.0)]) * 0.7 * 0.005)
    # One that held-out organs do not bear out is not given.
    assert torch.equal(field_of(outputs, dataclasses.replace(spec, sigma_scale=0.0)), field[:, :3])
    plain = field_of(outputs[:, :3], SPEC)
    torch.testing.assert_close(plain, outputs[:, :3] * SPEC.output_scale)


def test_a_linear_field_is_read_rightly_at_the_surface() -> None:
    surface = _ellipsoid()
    channels = organ_channels(surface, surface.vertices[:, 0] < -0.05, SPEC)
    field = channels.cells() @ torch.tensor([[0.1, 0.0, 0.2], [0.0, -0.1, 0.0], [0.3, 0.0, 0.1]])
    expected = surface.vertices @ np.array([[0.1, 0.0, 0.2], [0.0, -0.1, 0.0], [0.3, 0.0, 0.1]])
    found, cut = (
        FieldSampler(channels.grid, mask, surface.vertices)(field).numpy()
        for mask in (channels.near_mask, channels.organ_mask)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-6)
    # From the cells inside alone it is off by the gradient times a part of a cell.
    assert np.abs(cut - expected).max() > 0.05 * SPEC.spacing
