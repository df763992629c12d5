import csv
import json

import numpy as np
import pytest
import torch

from softtissue_estimator.checkpoint import load_checkpoint
from softtissue_estimator.errors import CheckpointError, InvalidInputError
from softtissue_estimator.network import UNet, initialise
from softtissue_training.dataset import draw_visible, prepare, voxelise
from softtissue_training.loss import multi_resolution_loss
from softtissue_training.precision import restrict_autocast
from softtissue_training.simulation_set import SimulationSet
from softtissue_training.train import CONFIG, LOG, STATE, WEIGHTS, RunOptions, learning_rate, train
from softtissue_training.training_config import get_config
from softtissue_training.training_state import Progress, load_state, save_state
from softtissue_training.validation import Validation

TINY = get_config("tiny")


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_a_small_network_learns_one_sample_by_heart(samples):
    prepared = prepare(samples[0], TINY.spec)
    visible = draw_visible(prepared, np.random.default_rng(0), (0.5, 0.5))
    inputs, target, mask = voxelise(prepared, *visible, TINY.spec, torch.device("cpu"))
    network = UNet(TINY.spec.architecture)
    initialise(network, inputs, generator=torch.Generator().manual_seed(0))
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(300):
        loss = multi_resolution_loss(network.forward_all(inputs), target, mask)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] / 10


def test_run_writes_weights_settings_and_log_and_can_go_on(data_folder, tmp_path):
    first = train(
        data_folder, tmp_path, TINY, RunOptions(time_limit_s=1.5, validate_every_s=0.5, command="test")
    )
    rows = list(csv.DictReader((tmp_path / LOG).read_text().splitlines()))
    checkpoint = load_checkpoint(tmp_path / WEIGHTS)
    assert len(rows) >= 2
    assert float(rows[-1]["error_mm"]) == pytest.approx(1e3 * first.error, abs=1e-3)
    assert checkpoint.spec == TINY.spec
    assert checkpoint.provenance["simulations"] == 4  # of 6, numbers 0 and 4 are held out
    best = min(float(row["error_mm"]) for row in rows)
    assert checkpoint.provenance["validation_error_mm"] == pytest.approx(best)
    assert json.loads((tmp_path / CONFIG).read_text())["name"] == "tiny"

    train(data_folder, tmp_path, TINY, RunOptions(time_limit_s=2.5, validate_every_s=0.5))
    more = list(csv.DictReader((tmp_path / LOG).read_text().splitlines()))
    assert [row["step"] for row in more[: len(rows)]] == [row["step"] for row in rows]
    assert int(more[-1]["step"]) > int(rows[-1]["step"])
    assert float(more[-1]["seconds"]) >= 2.5


def test_state_restores_weights_average_optimiser_and_progress(tmp_path):
    def trained(seed):
        torch.manual_seed(seed)
        network = UNet(TINY.spec.architecture)
        optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
        for _ in range(2):
            optimiser.zero_grad()
            network(torch.randn(1, 5, 8, 8, 8)).square().mean().backward()
            optimiser.step()
        return network, UNet(TINY.spec.architecture), optimiser

    one, average, optimiser = trained(1)
    other, other_average, other_optimiser = trained(2)
    save_state(tmp_path / STATE, one, average, optimiser, Progress(step=7, best_error=0.5), TINY.to_json())
    progress = load_state(tmp_path / STATE, other, other_average, other_optimiser, TINY.to_json())
    assert (progress.step, progress.best_error) == (7, 0.5)
    batch = torch.randn(1, 5, 8, 8, 8)
    torch.testing.assert_close(other_average(batch), average(batch))
    for network, adam in ((one, optimiser), (other, other_optimiser)):
        adam.zero_grad()
        network(batch).square().mean().backward()
        adam.step()
    torch.testing.assert_close(other(batch), one(batch), rtol=0, atol=0)


def test_a_run_does_not_go_on_with_other_settings(data_folder, tmp_path):
    train(data_folder, tmp_path, TINY, RunOptions(time_limit_s=0.2))
    with pytest.raises(CheckpointError, match="batch_size: expected 2, got 3"):
        train(data_folder, tmp_path, get_config("tiny", batch_size=3), RunOptions(time_limit_s=0.4))
    train(data_folder, tmp_path, get_config("tiny", learning_rate=1e-5), RunOptions(time_limit_s=0.4))


def test_too_little_data_is_refused(tmp_path):
    (tmp_path / "sims").mkdir()
    with pytest.raises(InvalidInputError, match="at least 5 simulations, got 0"):
        train(tmp_path / "sims", tmp_path / "out", TINY, RunOptions(time_limit_s=1.0))


class _Known(torch.nn.Module):
    """A network that answers with one displacement everywhere, in units of the specification."""

    def __init__(self, displacement):
        super().__init__()
        self.displacement = torch.tensor(displacement).view(1, 3, 1, 1, 1)

    def forward(self, inputs):
        return self.displacement.expand(-1, -1, *inputs.shape[2:])


def test_validation_measures_metres_inside_the_organ(linear_sample):
    prepared = prepare(linear_sample, TINY.spec)
    rng = np.random.default_rng(6)
    measure = Validation([prepared], TINY.spec, (1.0, 1.0), rng, torch.device("cpu"))
    result = measure(_Known([0.0, 0.0, 0.0]))
    assert result.error == pytest.approx(result.displacement, rel=1e-3)
    inside = (prepared.signed_distance <= 0).reshape(-1).numpy()
    truth = prepared.target.reshape(-1, 3).double().numpy()[inside]
    shift = np.array([0.01, -0.02, 0.005])
    expected = np.linalg.norm(truth - shift, axis=1).mean()
    scaled = (shift / TINY.spec.output_scale).astype(np.float32).tolist()
    assert measure(_Known(scaled)).error == pytest.approx(expected, rel=1e-3)
    assert result.rigid_error < result.displacement


def test_rigid_motion_is_found_by_the_rigid_fit(samples):
    import dataclasses

    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    vertices = samples[2].vertices.astype(np.float64)
    moved = dataclasses.replace(
        samples[2], displacement=(vertices @ turn.T + [0.01, 0.0, -0.02] - vertices).astype(np.float32)
    )
    measure = Validation(
        [prepare(moved, TINY.spec)], TINY.spec, (0.3, 0.3), np.random.default_rng(7), torch.device("cpu")
    )
    result = measure(_Known([0.0, 0.0, 0.0]))
    assert result.displacement > 0.01
    assert result.rigid_error < 1e-4


def test_learning_rate_rises_and_falls():
    config = get_config("tiny", learning_rate=1.0, warmup_steps=10)
    rates = [learning_rate(config, step, step / 100) for step in range(101)]
    assert rates[0] == pytest.approx(0.1)
    assert np.argmax(rates) == 9
    assert rates[-1] == pytest.approx(0.0)


def test_bfloat16_gradients_agree_with_float32(samples):
    # Wide enough, and coarse enough at the bottom, for the garbage that `restrict_autocast` avoids.
    prepared = prepare(samples[0], TINY.spec)
    visible = draw_visible(prepared, np.random.default_rng(0), (0.5, 0.5))
    inputs, target, mask = voxelise(prepared, *visible, TINY.spec, torch.device("cpu"))
    network = UNet()
    initialise(network, inputs, generator=torch.Generator().manual_seed(0))
    restrict_autocast(network, torch.device("cpu"))

    def gradients(enabled):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            outputs = network.forward_all(inputs)
        return torch.autograd.grad(multi_resolution_loss(outputs, target, mask), list(network.parameters()))

    exact = gradients(False)
    for _ in range(5):
        for rough, fine in zip(gradients(True), exact, strict=True):
            assert float((rough - fine).norm()) < 0.15 * float(fine.norm()) + 1e-6


def test_voxelising_in_processes_gives_the_same_samples(data_folder):
    here, there = SimulationSet(data_folder, TINY), SimulationSet(data_folder, TINY, workers=2)
    here.rescan()
    there.rescan()
    assert (len(here.training), len(here.held_out)) == (4, 2)
    assert here.digest() == there.digest()
    for ours, theirs in zip(here.training + here.held_out, there.training + there.held_out, strict=True):
        torch.testing.assert_close(ours.target, theirs.target, rtol=0, atol=0)
    before = here.training[0]
    here.rescan()
    assert here.training[0] is before
    assert len(here.training) == 4
