"""Training of the hybrid network: loss, calibration, the whole run on posteriors made up from formulae."""

import csv
import dataclasses
import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from softtissue_estimator.errors import CheckpointError
from softtissue_estimator.estimators.hybrid.checkpoint import load_hybrid_checkpoint
from softtissue_estimator.estimators.hybrid.network import HybridNetwork
from softtissue_training.cli import main
from softtissue_training.learning.hybrid.batches import collate
from softtissue_training.learning.hybrid.config import get_hybrid_config
from softtissue_training.learning.hybrid.loss import view_losses
from softtissue_training.learning.hybrid.posterior_record import format_posteriors
from softtissue_training.learning.hybrid.posterior_set import PosteriorSet
from softtissue_training.learning.hybrid.sample import HybridSample
from softtissue_training.learning.hybrid.train import train_hybrid
from softtissue_training.learning.hybrid.validation import (
    _EDGES,
    GAINS,
    TABLE,
    HybridValidation,
    _trusted_gain,
    calibration,
    summarised,
)
from softtissue_training.learning.run_files import LOG, LOSS, STATE, WEIGHTS
from softtissue_training.learning.run_summary import SUMMARY
from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.train import RunOptions
from softtissue_training.simulation.archive import record_name, write_record
from training.hybrid_cases import made_up_record

CONFIG = get_hybrid_config("hybrid-tiny")


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("posteriors")
    for number in range(6):
        record = made_up_record(number, CONFIG.spec, views=1)
        write_record(made, record_name(number), format_posteriors(record))
    return made


def batch_of(target, sigma, visible=None):
    """Two by two by two cells, points in their middle."""
    count = len(target)
    seen = torch.zeros(count, dtype=torch.bool) if visible is None else torch.tensor(visible)
    sample = HybridSample(
        torch.zeros(1, 10, 2, 2, 2),
        torch.full((count, 3), 0.5),
        torch.tensor(target),
        torch.tensor(sigma),
        seen,
    )
    return collate([sample], 1)


def constant(*values):
    return torch.tensor(values).view(1, 4, 1, 1, 1).expand(1, 4, 2, 2, 2).clone().requires_grad_()


def test_error_is_in_millimetres_and_weighted_by_visibility():
    config = dataclasses.replace(CONFIG, balance=0.0, likelihood=0.0, visible_weight=0.25)
    batch = batch_of([[0.003, 0.0, 0.004], [0.001, 0.0, 0.0]], [0.001, 0.001], [False, True])
    loss = view_losses(constant(0.0, 0.0, 0.0, 0.0), batch, config)
    assert float(loss.detach()) == pytest.approx((5.0 + 0.25 * 1.0) / 1.25, abs=0.01)
    # Half a standard deviation of each point along x.
    loss = view_losses(constant(0.5, 0.0, 0.0, 0.0), batch, config)
    expected = np.hypot(3.0 - 0.5, 4.0) + 0.25 * 0.5
    assert float(loss.detach()) == pytest.approx(expected / 1.25, abs=0.01)


def test_balance_weighs_views_by_their_elastic_error():
    batch = batch_of([[0.0038, 0.0, 0.0]], [0.001])
    for balance, expected in ((0.0, 3.8), (0.5, 3.8 / 2.0), (1.0, 3.8 / 4.0)):
        config = dataclasses.replace(CONFIG, balance=balance, likelihood=0.0)
        loss = view_losses(constant(0.0, 0.0, 0.0, 0.0), batch, config)
        assert float(loss.detach()) == pytest.approx(expected, abs=0.01)


def test_likelihood_is_best_at_the_root_mean_square_error_and_moves_the_deviation_alone():
    config = dataclasses.replace(CONFIG, balance=0.0)
    errors = 0.002 * np.random.default_rng(0).normal(size=(400, 3))
    batch = batch_of(errors.astype(np.float32).tolist(), [0.001] * 400)
    rms = float(np.sqrt((errors**2).mean()))
    slopes = []
    for factor in (0.9, 1.0, 1.1):
        # The inverse of the bound on g, so that sigma is factor times the root mean square error.
        change = config.spec.log_sigma_limit * np.arctanh(
            np.log(factor * rms / 0.001) / config.spec.log_sigma_limit
        )
        outputs = constant(0.0, 0.0, 0.0, float(change))
        with_likelihood = torch.autograd.grad(view_losses(outputs, batch, config).sum(), outputs)[0]
        without = dataclasses.replace(config, likelihood=0.0)
        alone = torch.autograd.grad(view_losses(outputs, batch, without).sum(), outputs)[0]
        torch.testing.assert_close(with_likelihood[:, :3], alone[:, :3])
        assert (alone[:, 3] == 0).all()
        slopes.append(float(with_likelihood[:, 3].sum()))
    assert slopes[0] < -1e-3 < abs(slopes[1]) < 1e-3 < slopes[2]


def test_calibration_finds_the_factor_of_a_normal_distribution():
    ratio = np.abs(1.7 * np.random.default_rng(1).normal(size=200_000))
    histogram = np.bincount(np.digitize(ratio, _EDGES), minlength=len(_EDGES) + 1) / len(ratio)
    factor, within = calibration(histogram)
    assert factor == pytest.approx(1.7, rel=0.05)
    assert within == pytest.approx((0.6827, 0.9545), abs=0.015)


def test_results_are_means_over_views_in_bins_of_what_is_seen():
    table = np.zeros((4, *TABLE))
    table[:, :, 0] = 9.0
    best = GAINS.index(0.75)
    table[:, best, 0] = (1.0, 2.0, 3.0, 4.0)
    table[:, :, 1], table[:, :, 2] = ([[2.0], [2.0], [4.0], [8.0]], [[1.0], [2.0], [3.0], [5.0]])
    table[:, :, 3], table[:, :, 4:] = 20.0, 1.0 / (len(_EDGES) + 1)
    result = summarised(table, np.array([0.05, 0.10, 0.12, 1.0]))
    assert (result.error, result.elastic_error, result.remainder_gain) == (2.5, 4.0, 0.75)
    assert result.score == pytest.approx(2.5 + 1e-4 * 20.0)
    assert result.correlation == pytest.approx(np.corrcoef([1, 2, 3, 4], [1, 2, 3, 5])[0, 1])
    assert result.by_share == ((1, 1.0, 2.0), (2, 2.5, 3.0), (0, 0.0, 0.0), (0, 0.0, 0.0), (1, 4.0, 8.0))


def test_a_remainder_that_does_not_hold_is_not_trusted(folder):
    """Outputs that point away from the truth: the gain is zero, and the error that of the posterior."""
    views = PosteriorSet([folder], CONFIG, show_progress=False).held_out
    network = HybridNetwork(CONFIG.spec.architecture)
    wrong = torch.nn.Parameter(-torch.tensor([1.0, -0.5, 0.75, 0.0]))
    with torch.no_grad():
        network.heads[0].weight.zero_()
        network.heads[0].bias.copy_(wrong)
    result = HybridValidation(views, CONFIG.spec, torch.device("cpu"))(network)
    assert (result.remainder_gain, result.error) == (0.0, result.elastic_error)
    with torch.no_grad():
        network.heads[0].bias.copy_(-0.5 * wrong)
    right = HybridValidation(views, CONFIG.spec, torch.device("cpu"))(network)
    assert right.remainder_gain == 1.0 and right.error < 0.9 * right.elastic_error
    assert right.score < result.score


def rows(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def test_remainder_is_learned_by_heart(folder, tmp_path):
    config = dataclasses.replace(CONFIG, validation_every=0, orientations=1, learning_rate=5e-3)
    schedule = Schedule(steps=250, validate_every_steps=125)
    summary = train_hybrid([folder], tmp_path, config, schedule, RunOptions(command="train it"))
    best = summary.provenance
    assert best["validation_elastic_error_mm"] == pytest.approx(2.6, abs=0.5)
    assert best["validation_error_mm"] < 0.3 * best["validation_elastic_error_mm"]
    assert 0.9 < best["within_two"] < 0.99
    stored = load_hybrid_checkpoint(tmp_path / WEIGHTS)
    assert stored.provenance == best
    calibrated = {name: getattr(stored.spec, name) for name in ("remainder_gain", "sigma_factor")}
    assert stored.spec == dataclasses.replace(CONFIG.spec, **calibrated)
    assert stored.spec.remainder_gain == 1.0
    last = next(row for row in rows(tmp_path / LOG) if int(row["step"]) == best["steps"])
    assert float(last["sigma_factor"]) == pytest.approx(stored.spec.sigma_factor, abs=1e-3)
    assert json.loads((tmp_path / SUMMARY).read_text())["provenance"] == best


def command(folder, out, *arguments):
    data = ("--data", str(folder), "--out", str(out), "--device", "cpu", "--threads", "1")
    steps = ("--precision", "float32", "--steps", "12", "--validate-every", "4")
    return main(["train", "--config", "hybrid-tiny", *data, *steps, *arguments])


def test_interrupted_run_is_the_same_and_exported_weights_are_the_best(folder, tmp_path, capsys):
    once, twice = tmp_path / "once", tmp_path / "twice"
    assert command(folder, once) == 0
    shown = capsys.readouterr().out
    assert "4 views for training, 2 held out" in shown and "elastic alone" in shown
    schedule = Schedule(steps=12, validate_every_steps=4, time_limit_s=1e-6)
    assert train_hybrid([folder], twice, CONFIG, schedule).ended_by == "time limit"
    assert command(folder, twice) == 2
    assert "add --resume" in capsys.readouterr().err
    assert command(folder, twice, "--resume", "--workers", "2") == 0
    assert (once / LOSS).read_text() == (twice / LOSS).read_text()
    assert len(rows(once / LOSS)) == 12
    for name in (WEIGHTS, STATE):
        expected, got = load_file(once / name), load_file(twice / name)
        assert all(torch.equal(tensor, got[key]) for key, tensor in expected.items())
    assert main(["export", str(once), str(tmp_path / "hybrid.safetensors")]) == 0
    exported = load_hybrid_checkpoint(tmp_path / "hybrid.safetensors")
    best = load_hybrid_checkpoint(once / WEIGHTS)
    assert exported.spec == best.spec
    assert "/" not in exported.provenance["command"]
    for key, tensor in best.network.state_dict().items():
        torch.testing.assert_close(exported.network.state_dict()[key], tensor, atol=1e-3, rtol=1e-3)


def test_a_run_does_not_go_on_with_other_data_and_refuses_what_it_cannot_do(folder, tmp_path, capsys):
    train_hybrid([folder], tmp_path / "run", CONFIG, Schedule(steps=1))
    with pytest.raises(CheckpointError, match="with the data it began with"):
        train_hybrid([folder, folder], tmp_path / "run", CONFIG, Schedule(steps=2))
    for options, message in (
        (["--noise", "0", "2"], "expected none of them for the hybrid network"),
        (["--watch"], "posteriors cannot be watched"),
    ):
        assert command(folder, tmp_path / "other", *options) == 2
        assert message in capsys.readouterr().err


def test_a_gain_that_chance_explains_is_not_trusted():
    rng = np.random.default_rng(2)
    without = rng.uniform(1.0, 3.0, size=60)
    errors = np.repeat(without[:, None], len(GAINS), axis=1)
    errors[:, -1] += rng.normal(-0.001, 0.1, size=60)
    assert errors[:, -1].mean() < errors[:, 0].mean()
    assert _trusted_gain(errors) == 0
    errors[:, -1] = 0.9 * without
    assert _trusted_gain(errors) == len(GAINS) - 1
