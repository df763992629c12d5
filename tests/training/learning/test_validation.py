import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from softtissue_training.learning.dataset import draw_visible, prepare
from softtissue_training.learning.training_config import get_config
from softtissue_training.learning.validation import Validation

SPEC = get_config("tiny").spec
CPU = torch.device("cpu")


class _Known(torch.nn.Module):
    """A network that answers with one displacement everywhere, in units of the specification."""

    def __init__(self, displacement):
        super().__init__()
        self.displacement = torch.tensor(displacement).view(1, 3, 1, 1, 1)

    def forward(self, inputs):
        return self.displacement.expand(-1, -1, *inputs.shape[2:])


def _measure(prepared, share):
    seen = [draw_visible(prepared, np.random.default_rng(6), (share, share))]
    return Validation([prepared], seen, SPEC, CPU)


@pytest.mark.parametrize("surroundings", [False, True])
def test_validation_measures_metres_inside_the_organ(linear_sample, surroundings):
    prepared = prepare(linear_sample, SPEC, surroundings=surroundings)
    measure = _measure(prepared, 1.0)
    result = measure(_Known([0.0, 0.0, 0.0]))
    assert result.error == pytest.approx(result.displacement, rel=1e-3)
    inside = (prepared.signed_distance <= 0).reshape(-1).numpy()
    truth = prepared.target.reshape(-1, 3).double().numpy()[inside]
    shift = np.array([0.01, -0.02, 0.005])
    expected = np.linalg.norm(truth - shift, axis=1).mean()
    scaled = (shift / SPEC.output_scale).astype(np.float32).tolist()
    assert measure(_Known(scaled)).error == pytest.approx(expected, rel=1e-3)
    assert result.rigid_error < result.displacement


def test_rigid_motion_is_found_by_the_rigid_fit(samples):
    turn = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    vertices = samples[2].vertices.astype(np.float64)
    moved = dataclasses.replace(
        samples[2], displacement=(vertices @ turn.T + [0.01, 0.0, -0.02] - vertices).astype(np.float32)
    )
    result = _measure(prepare(moved, SPEC), 0.3)(_Known([0.0, 0.0, 0.0]))
    assert result.displacement > 0.01
    assert result.rigid_error < 1e-4
