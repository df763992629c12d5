import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_training.learning.box import crop, own_box
from softtissue_training.learning.dataset import draw_visible, prepare
from softtissue_training.learning.training_config import get_config
from softtissue_training.learning.validation import Validation
from softtissue_training.learning.view import view_of
from softtissue_training.learning.voxels import Voxeliser

SPEC = get_config("tiny").spec
FRAMES = {"rigid": SPEC, "organ": NetworkSpec(spacing=SPEC.spacing, margin_cells=1)}
STILL = RigidMotion(np.eye(3), np.zeros(3))
CPU = torch.device("cpu")


class _Known(torch.nn.Module):
    """A network that answers with the same outputs everywhere, in units of the specification."""

    def __init__(self, outputs):
        super().__init__()
        self.outputs = torch.tensor(outputs).view(1, -1, 1, 1, 1)

    def forward(self, inputs):
        return self.outputs.expand(-1, -1, *inputs.shape[2:])


class _Given(torch.nn.Module):
    """A network that has its outputs (1, c, X, Y, Z) by heart."""

    def __init__(self, outputs):
        super().__init__()
        self.outputs = outputs

    def forward(self, inputs):
        assert inputs.shape[2:] == self.outputs.shape[2:]
        return self.outputs


def _view(prepared, share, spec):
    return view_of(*draw_visible(prepared, np.random.default_rng(6), (share, share)), spec)


def _measure(prepared, share, spec):
    return Validation([prepared], [_view(prepared, share, spec)], spec, CPU)


def _answer(spec, shift):
    """The outputs that stand for a displacement (3,) m, and for a standard deviation of one unit."""
    outputs = [float(part) / spec.output_scale for part in shift]
    return _Known([*outputs, 0.0] if spec.gives_sigma else outputs)


@pytest.mark.parametrize("surroundings", [False, True])
@pytest.mark.parametrize("frame", FRAMES)
def test_validation_measures_metres_inside_the_organ(linear_sample, surroundings, frame):
    spec = FRAMES[frame]
    prepared = prepare(linear_sample, spec, surroundings=surroundings)
    measure = _measure(prepared, 1.0, spec)
    inside = (prepared.signed_distance <= 0).reshape(-1).numpy()
    truth = prepared.target.reshape(-1, 3).double().numpy()[inside]
    centres = prepared.grid.points()[inside]
    motion = _view(prepared, 1.0, spec).motion or STILL
    assert (motion is STILL) == (frame == "organ")
    for shift in (np.zeros(3), np.array([0.01, -0.02, 0.005])):
        answer = motion.apply(centres + shift) - centres
        result = measure(_answer(spec, shift))
        assert result.error == pytest.approx(np.linalg.norm(truth - answer, axis=1).mean(), rel=1e-3)
        assert result.displacement == pytest.approx(np.linalg.norm(truth, axis=1).mean(), rel=1e-6)
    assert result.rigid_error < result.displacement
    assert math.isnan(result.sigma_scale) == (not spec.gives_sigma)


def test_no_answer_is_the_rigid_motion_in_its_frame_and_no_displacement_in_the_organs(linear_sample):
    found = {}
    for frame, spec in FRAMES.items():
        found[frame] = _measure(prepare(linear_sample, spec), 1.0, spec)(_answer(spec, np.zeros(3)))
    assert found["organ"].error == pytest.approx(found["organ"].displacement, rel=1e-3)
    assert found["rigid"].error == pytest.approx(found["rigid"].rigid_error, rel=0.05)
    assert found["rigid"].error < 0.9 * found["rigid"].displacement


@pytest.mark.parametrize("frame", FRAMES)
def test_rigid_motion_is_found_by_the_rigid_fit(samples, frame):
    spec = FRAMES[frame]
    turn = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    vertices = samples[2].vertices.astype(np.float64)
    moved = dataclasses.replace(
        samples[2], displacement=(vertices @ turn.T + [0.01, 0.0, -0.02] - vertices).astype(np.float32)
    )
    result = _measure(prepare(moved, spec), 0.3, spec)(_answer(spec, np.zeros(3)))
    assert result.displacement > 0.01
    assert result.rigid_error < 1e-4
    assert (result.error < 1e-4) == (frame == "rigid")


@pytest.mark.parametrize("claimed", [0.5, 4.0])
def test_sigma_scale_makes_the_claimed_deviation_the_true_one(samples, claimed):
    """Gaussian errors of two units, claimed to have another deviation."""
    prepared = prepare(samples[2], SPEC)
    view = _view(prepared, 0.3, SPEC)
    voxels = Voxeliser(SPEC, CPU)([prepared], [view])
    target = crop(voxels, own_box(prepared.box, prepared.grid.shape))[1]
    noise = 2.0 * torch.randn(target.shape, generator=torch.Generator().manual_seed(4))
    network = _Given(torch.cat([target + noise, torch.full_like(target[:, :1], math.log(claimed))], dim=1))
    result = Validation([prepared], [view], SPEC, CPU)(network)
    # Some hundred cells inside, three components each.
    assert result.sigma_scale * claimed == pytest.approx(2.0, rel=0.1)
    assert result.calibrated_scale == result.sigma_scale


def test_deviation_that_no_factor_makes_true_is_not_given(samples):
    """Nine tenths of the errors are small and the others large, and the network says the same of all."""
    prepared = prepare(samples[2], SPEC)
    view = _view(prepared, 0.3, SPEC)
    target = crop(Voxeliser(SPEC, CPU)([prepared], [view]), own_box(prepared.box, prepared.grid.shape))[1]
    generator = torch.Generator().manual_seed(4)
    small = torch.rand(target.shape, generator=generator) < 0.88
    noise = torch.where(small, 0.1, 5.0) * torch.randn(target.shape, generator=generator)
    network = _Given(torch.cat([target + noise, torch.zeros_like(target[:, :1])], dim=1))
    result = Validation([prepared], [view], SPEC, CPU)(network)
    assert result.within_two_sigma < 0.9
    assert result.calibrated_scale == 0.0 < result.sigma_scale
