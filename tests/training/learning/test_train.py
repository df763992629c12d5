"""Training as a whole: what a run leaves, how it ends, and that an interruption changes nothing."""

import csv
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from softtissue_estimator.errors import CheckpointError, InvalidInputError
from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_training.cli import main
from softtissue_training.learning.run_files import CONFIG, LOG, LOSS, STATE, WEIGHTS
from softtissue_training.learning.run_summary import SUMMARY
from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.train import RunOptions, train
from softtissue_training.learning.training_config import get_config

TINY = get_config("tiny")


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def _rows(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def test_run_leaves_weights_settings_curves_and_summary(data_folder, tmp_path):
    schedule = Schedule(steps=9, validate_every_steps=3)
    summary = train(data_folder, tmp_path, TINY, schedule, RunOptions(command="test"))
    log, losses = _rows(tmp_path / LOG), _rows(tmp_path / LOSS)
    assert [int(row["step"]) for row in losses] == list(range(1, 10))
    assert [int(row["step"]) for row in log] == [3, 6, 9]
    for row in log:
        last = [float(r["loss"]) for r in losses if int(row["step"]) - 3 < int(r["step"]) <= int(row["step"])]
        assert float(row["loss"]) == pytest.approx(sum(last) / 3, abs=1e-6)
    best = min(log, key=lambda row: float(row["error_mm"]))
    stored = json.loads((tmp_path / SUMMARY).read_text())
    assert stored["validation_error_mm"] == pytest.approx(float(best["error_mm"]))
    assert stored["best_step"] == int(best["step"])
    assert stored["rigid_error_mm"] < stored["no_estimate_error_mm"]
    # Of six organs, numbers 0 and 4 are held out.
    assert (stored["organs"], stored["training_samples"], stored["held_out_samples"]) == (6, 4, 2)
    assert (stored["steps"], stored["ended_by"], stored["seed"]) == (9, "steps", 1)
    assert stored["versions"]["torch"] == torch.__version__
    assert all(part in summary.text() for part in (stored["data_sha256"][:16], str(data_folder), "seed 1"))
    checkpoint = load_checkpoint(tmp_path / WEIGHTS)
    # What validation found replaces the factor of the standard deviation, and nothing else.
    assert dataclasses.replace(checkpoint.spec, sigma_scale=1.0) == TINY.spec
    assert 0.0 <= checkpoint.spec.sigma_scale < 100.0 and checkpoint.spec.sigma_scale != 1.0
    assert checkpoint.provenance["validation_error_mm"] == pytest.approx(float(best["error_mm"]))
    assert checkpoint.provenance["data_sha256"] == stored["data_sha256"]
    assert json.loads((tmp_path / CONFIG).read_text())["name"] == "tiny"


def test_run_ends_at_its_time_limit_and_goes_on_later(data_folder, tmp_path):
    def run(seconds):
        return train(data_folder, tmp_path, TINY, Schedule(time_limit_s=seconds, validate_every_s=0.4))

    summary = run(1.0)
    rows = _rows(tmp_path / LOG)
    assert summary.ended_by == "time limit"
    assert (tmp_path / WEIGHTS).is_file()
    assert 1.0 <= float(rows[-1]["seconds"]) < 10.0
    assert float(rows[-1]["learning_rate"]) < 0.01 * TINY.learning_rate
    run(2.0)
    more = _rows(tmp_path / LOG)
    assert [row["step"] for row in more[: len(rows)]] == [row["step"] for row in rows]
    assert int(more[-1]["step"]) > int(rows[-1]["step"])
    steps = [int(row["step"]) for row in _rows(tmp_path / LOSS)]
    assert steps == list(range(1, steps[-1] + 1))


def test_time_limit_and_resume_do_not_change_a_run_of_given_steps(data_folder, tmp_path):
    once, twice = tmp_path / "once", tmp_path / "twice"
    train(data_folder, once, TINY, Schedule(steps=40, validate_every_steps=7))
    first = train(data_folder, twice, TINY, Schedule(steps=40, validate_every_steps=7, time_limit_s=0.2))
    assert first.ended_by == "time limit"
    assert (twice / WEIGHTS).is_file()
    assert train(data_folder, twice, TINY, Schedule(steps=40, validate_every_steps=7)).ended_by == "steps"
    _assert_same_run(once, twice)


def _assert_same_run(one: Path, other: Path) -> None:
    assert (one / LOSS).read_text() == (other / LOSS).read_text()
    ours, theirs = _rows(one / LOG), _rows(other / LOG)
    for row in (*ours, *theirs):
        del row["seconds"], row["processor_s"]
    assert ours == theirs
    for name in (WEIGHTS, STATE):
        expected, got = load_file(one / name), load_file(other / name)
        assert expected.keys() == got.keys()
        for key, tensor in expected.items():
            assert torch.equal(tensor, got[key]), key


def test_processes_that_draw_leave_the_curve_of_the_thread_bit_for_bit(data_folder, tmp_path):
    config = get_config(
        "tiny",
        noise_m=(0.0, 0.003),
        noisy=0.5,
        correspondences=(8, 60),
        sparse=0.3,
        misregistered=0.5,
        misattached=0.5,
    )
    schedule = Schedule(steps=12, validate_every_steps=6)
    for drawers in (0, 2):
        train(data_folder, tmp_path / str(drawers), config, schedule, RunOptions(drawers=drawers))
    losses = [float(row["loss"]) for row in _rows(tmp_path / "0" / LOSS)]
    assert len(losses) == 12 and len(set(losses)) > 6
    _assert_same_run(tmp_path / "0", tmp_path / "2")


def test_killed_and_resumed_run_leaves_the_same_curve_as_an_undisturbed_one(data_folder, tmp_path):
    once, killed = tmp_path / "once", tmp_path / "killed"
    arguments = ["train", "--data", str(data_folder), "--config", "tiny", "--steps", "90"]
    arguments += ["--validate-every", "10", "--threads", "1", "--device", "cpu", "--noise", "0", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "softtissue_training", *arguments, "--out", str(killed)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    end = time.monotonic() + 100.0
    try:
        while not ((killed / LOSS).exists() and len((killed / LOSS).read_text().splitlines()) > 36):
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.002)
    finally:
        process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    reached = len(_rows(killed / LOSS))
    assert 36 <= reached < 90
    # What a kill in the middle of a row leaves.
    with (killed / LOSS).open("a") as stream:
        stream.write(str(reached + 1)[:1])
    assert main([*arguments, "--out", str(killed), "--resume"]) == 0
    assert main([*arguments, "--out", str(once)]) == 0
    assert len(_rows(once / LOSS)) == 90
    _assert_same_run(once, killed)


def test_run_ends_when_validation_no_longer_improves(data_folder, tmp_path):
    # A vanishing learning rate, so that nothing improves after the first validation.
    config = get_config("tiny", learning_rate=1e-30)
    summary = train(data_folder, tmp_path, config, Schedule(patience=3, validate_every_steps=2))
    assert summary.ended_by == "no improvement"
    assert [int(row["step"]) for row in _rows(tmp_path / LOG)] == [2, 4, 6, 8]
    assert (summary.steps, summary.best_step) == (8, 2)


def test_signal_of_a_scheduler_ends_a_run_cleanly(data_folder, tmp_path):
    class Ended(Schedule):
        def learning_rate(self, config, progress):
            if progress.step == 5:
                os.kill(os.getpid(), signal.SIGTERM)
            return super().learning_rate(config, progress)

    summary = train(data_folder, tmp_path, TINY, Ended(steps=1000, validate_every_steps=100))
    assert (summary.ended_by, summary.steps) == ("stopped", 6)
    assert (tmp_path / WEIGHTS).is_file() and (tmp_path / STATE).is_file()


def test_a_run_does_not_go_on_with_other_settings_or_data(data_folder, tmp_path):
    out, other = tmp_path / "run", tmp_path / "other"
    train(data_folder, out, TINY, Schedule(steps=2))
    with pytest.raises(CheckpointError, match="batch_size: expected 2, got 3"):
        train(data_folder, out, get_config("tiny", batch_size=3), Schedule(steps=4))
    train(data_folder, out, get_config("tiny", learning_rate=1e-5), Schedule(steps=4))
    other.mkdir()
    for path in sorted(data_folder.iterdir())[:5]:
        (other / path.name).write_bytes(path.read_bytes())
    with pytest.raises(CheckpointError, match="with the data it began with.*--watch"):
        train(other, out, TINY, Schedule(steps=6))
    assert train(other, out, TINY, Schedule(steps=6), RunOptions(watch=True)).steps == 6


def test_watched_data_are_used_as_they_come(data_folder, tmp_path):
    records = sorted(data_folder.iterdir())
    data = tmp_path / "sims"
    data.mkdir()
    for path in records[:5]:
        (data / path.name).write_bytes(path.read_bytes())

    class Growing(Schedule):
        def learning_rate(self, config, progress):
            (data / records[5].name).write_bytes(records[5].read_bytes())
            return super().learning_rate(config, progress)

    schedule = Growing(steps=4, validate_every_steps=2)
    for watch, samples in ((False, ["3", "3"]), (True, ["3", "4"])):
        (data / records[5].name).unlink(missing_ok=True)
        out = tmp_path / str(watch)
        train(data, out, TINY, schedule, RunOptions(watch=watch, drawers=2 if watch else 0))
        assert [row["samples"] for row in _rows(out / LOG)] == samples


def test_the_best_weights_are_measured_anew_on_the_organs_that_are_held_out_now(data_folder, tmp_path):
    records = sorted(data_folder.iterdir())
    data, out = tmp_path / "sims", tmp_path / "run"
    data.mkdir()
    for path in records[:4]:  # organ 0 is held out, and later organ 4 too
        (data / path.name).write_bytes(path.read_bytes())
    schedule = Schedule(steps=2, validate_every_steps=2)
    few = train(data, out, TINY, schedule, RunOptions(watch=True))
    for path in records[4:]:
        (data / path.name).write_bytes(path.read_bytes())
    all_of_them = train(data, out, TINY, schedule, RunOptions(watch=True))
    assert all_of_them.held_out_samples == 2
    assert all_of_them.validation_error_mm != pytest.approx(few.validation_error_mm)
    # No step was made: the weights of the last step are the best ones.
    assert all_of_them.validation_error_mm == pytest.approx(all_of_them.last_error_mm)


def test_too_little_data_is_refused(tmp_path):
    (tmp_path / "sims").mkdir()
    with pytest.raises(InvalidInputError, match="at least 5 organs, got 0"):
        train(tmp_path / "sims", tmp_path / "out", TINY, Schedule(steps=1))


def test_curves_for_tensorboard_are_those_of_the_csv_files(data_folder, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    schedule = Schedule(steps=4, validate_every_steps=2)
    train(data_folder, tmp_path, TINY, schedule, RunOptions(tensorboard=True))
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    losses = [(event.step, event.value) for event in events.Scalars("loss")]
    assert [step for step, _ in losses] == [1, 2, 3, 4]
    assert [value for _, value in losses] == pytest.approx(
        [float(row["loss"]) for row in _rows(tmp_path / LOSS)]
    )
    errors = [event.value for event in events.Scalars("validation/error mm")]
    assert errors == pytest.approx([float(row["error_mm"]) for row in _rows(tmp_path / LOG)], abs=1e-3)


def test_without_tensorboard_one_sentence_says_what_to_install(data_folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(InvalidInputError, match=r'pip install "softtissue-training\[tensorboard\]"'):
        train(data_folder, tmp_path, TINY, Schedule(steps=1), RunOptions(tensorboard=True))


def test_a_run_begins_with_given_weights(data_folder, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    train(data_folder, first, TINY, Schedule(steps=4))
    hardly = dataclasses.replace(TINY, learning_rate=1e-9, seed=2)
    train(data_folder, second, hardly, Schedule(steps=1), RunOptions(start=first / WEIGHTS))
    begun = load_file(second / WEIGHTS)
    for name, kept in load_file(first / WEIGHTS).items():
        torch.testing.assert_close(begun[name], kept, rtol=0, atol=1e-7)
    other = get_config("overfit")
    with pytest.raises(CheckpointError, match="expected weights of a network as overfit has it"):
        train(data_folder, tmp_path / "other", other, Schedule(steps=1), RunOptions(start=first / WEIGHTS))
