"""The whole experiment on small simulations: reports, figures, failures, going on after an interruption."""

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from softtissue_estimator.estimators.paper.checkpoint import save_checkpoint
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.support.cache import cache_folder
from softtissue_training.cli import main
from softtissue_training.errors import SolverDivergedError
from softtissue_training.evaluation import figures, methods, runner
from softtissue_training.evaluation.insilico import SimulatedOrgan, evaluate_in_silico, simulated_organs
from softtissue_training.evaluation.methods import parse_methods
from softtissue_training.evaluation.observe import ObservationSettings
from softtissue_training.evaluation.runner import evaluate
from softtissue_training.simulation.archive import pack, record_name, write_record
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.record_format import format_record
from softtissue_training.simulation.simulate import simulate

SETTINGS = ObservationSettings()
FIGURES = (
    "error_by_depth.png",
    "error_by_displacement.png",
    "error_by_visible_share.png",
    "displacement_density.png",
)


def run(data, out, listed="zero,rigid", settings=SETTINGS, **options):
    """Evaluate in this process."""
    options = {"workers": 0, "show_progress": False} | options
    return evaluate_in_silico(data, parse_methods(listed), out, settings, **options)


def rows(out):
    with (out / "samples.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def summary(out):
    return json.loads((out / "evaluation.json").read_text(encoding="utf-8"))


def untimed(out):
    """Rows without what differs from run to run."""
    return [{name: value for name, value in row.items() if not name.endswith("_s")} for row in rows(out)]


@pytest.fixture
def no_figures(monkeypatch):
    """Leave out what is slow and not looked at."""
    monkeypatch.setattr(figures, "write_figures", lambda folder, results: [])


@pytest.fixture
def method(monkeypatch):
    """Add an estimator for the length of a test."""
    return lambda name, function: monkeypatch.setitem(methods._FUNCTIONS, name, function)


def test_reports_agree_with_the_simulations(data_folder, records, tmp_path):
    shown = run(data_folder, tmp_path)
    found = summary(tmp_path)
    assert "6 of 6 samples compared" in shown
    assert (found["samples"], found["data"]["records"], found["observation"]["noise_m"]) == (6, 6, 0.0)
    lengths = [np.linalg.norm(record.simulations[0].displacement, axis=1) for record in records]
    zero = found["estimators"]["zero"]["conditions"]["all"]
    assert zero["all_points"]["mean_mm"] == pytest.approx(
        1e3 * np.mean([each.mean() for each in lengths]), rel=1e-5
    )
    assert zero["all_points"]["over_points"]["max_mm"] == pytest.approx(
        1e3 * np.max([each.max() for each in lengths])
    )
    table = rows(tmp_path)
    assert len(table) == 12
    means = [float(row["mean_mm"]) for row in table if row["estimator"] == "rigid"]
    rigid = found["estimators"]["rigid"]["conditions"]["all"]
    assert (rigid["samples"], rigid["mean_mm"]) == (6, pytest.approx(np.mean(means), rel=1e-3))
    assert rigid["mean_mm"] < zero["mean_mm"]
    counts = [
        found["estimators"]["zero"]["conditions"][name]["samples"] for name in ("seen_load", "hidden_load")
    ]
    assert sum(counts) == 6
    for name in FIGURES:
        assert (tmp_path / "figures" / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("compact", [False, True])
def test_a_packed_file_gives_the_same(data_folder, tmp_path, no_figures, compact):
    pack(data_folder, tmp_path / "sims.pack", compact=compact)
    run(data_folder, tmp_path / "folder", count=2)
    run(tmp_path / "sims.pack", tmp_path / "packed", count=2)
    for packed, stored in zip(rows(tmp_path / "packed"), rows(tmp_path / "folder"), strict=True):
        assert packed["sample"] == stored["sample"]
        # A packed record may be rounded, by micrometres.
        for name in ("visible_share", "load_seen_share", "mean_mm", "all_points_max_mm"):
            assert float(packed[name]) == pytest.approx(float(stored[name]), abs=0.03)


def test_worker_processes_give_the_same(data_folder, tmp_path, no_figures):
    run(data_folder, tmp_path / "here", count=3)
    run(data_folder, tmp_path / "there", count=3, workers=2)
    assert untimed(tmp_path / "there") == untimed(tmp_path / "here")


def test_finished_answers_are_not_computed_again(data_folder, tmp_path, method, no_figures):
    asked = []

    def counted(case):
        asked.append(case.name)
        return np.zeros_like(case.points)

    method("counted", counted)
    run(data_folder, tmp_path, "zero,counted", count=3)
    first = (tmp_path / "samples.csv").read_bytes()
    run(data_folder, tmp_path, "zero,counted", count=3)
    assert asked == ["organ_000000", "organ_000001", "organ_000002"]
    assert (tmp_path / "samples.csv").read_bytes() == first
    run(data_folder, tmp_path, "counted,rigid", count=4)  # one estimator and one organ more
    assert asked[3:] == ["organ_000003"]
    assert [row["estimator"] for row in rows(tmp_path)] == 4 * ["counted", "rigid"]
    run(data_folder, tmp_path, "counted", ObservationSettings(noise_m=0.001), count=1)
    run(data_folder, tmp_path, "counted", count=1, seed=1)
    assert asked[4:] == ["organ_000000", "organ_000000"]


def test_a_finished_evaluation_makes_no_case_again(data_folder, tmp_path, no_figures, monkeypatch):
    run(data_folder, tmp_path, "zero", count=2)
    monkeypatch.setattr(SimulatedOrgan, "cases", lambda self: pytest.fail("made again"))
    assert "2 of 2 samples compared" in run(data_folder, tmp_path, "zero", count=2)


def test_an_interrupted_evaluation_goes_on(data_folder, tmp_path, method, no_figures):
    stop_at = ["organ_000002"]

    def interrupted(case):
        if case.name in stop_at:
            raise KeyboardInterrupt
        return methods.rigid_displacement(case)

    method("fit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(data_folder, tmp_path / "killed", "zero,fit", count=4)
    stop_at.clear()
    finished = len(list((tmp_path / "killed" / "answers").iterdir()))
    assert finished == 2 * 3 + 2
    run(data_folder, tmp_path / "killed", "zero,fit", count=4)
    run(data_folder, tmp_path / "whole", "zero,fit", count=4)
    assert untimed(tmp_path / "killed") == untimed(tmp_path / "whole")


def ended(pid):
    """Whether a process is gone, or only waits to be counted by its parent."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def wait_until(condition, seconds=90.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "not in time"
        time.sleep(0.02)


def test_killed_in_the_middle_it_leaves_no_process_and_goes_on(data_folder, tmp_path, no_figures):
    out = tmp_path / "killed"
    arguments = ["--data", str(data_folder), "--estimators", "fem,rigid", "--out", str(out), "--workers", "1"]
    running = subprocess.Popen(
        [sys.executable, "-m", "softtissue_training", "evaluate", "insilico", *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stderr=subprocess.DEVNULL,
    )
    wait_until(lambda: len(list(out.glob("answers/*.npz"))) >= 4)
    children = Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()
    running.kill()
    running.wait()
    assert children
    wait_until(lambda: all(ended(pid) for pid in children))
    run(data_folder, out, "fem,rigid")
    run(data_folder, tmp_path / "whole", "fem,rigid")
    assert untimed(out) == untimed(tmp_path / "whole")


def test_a_damaged_answer_is_said(data_folder, tmp_path, capsys, no_figures):
    run(data_folder, tmp_path, "zero", count=1)
    for path in (tmp_path / "answers").glob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    arguments = ["evaluate", "insilico", "--data", str(data_folder), "--estimators", "zero", "--count", "1"]
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    assert "expected complete files, got damaged ones; delete them" in capsys.readouterr().err


def test_what_is_seen_depends_on_the_record_alone(data_folder, tmp_path, no_figures):
    run(data_folder, tmp_path / "all", "rigid")
    run(data_folder, tmp_path / "last", "rigid", skip=4, count=2)
    assert untimed(tmp_path / "last") == untimed(tmp_path / "all")[4:]
    shares = [float(row["visible_share"]) for row in rows(tmp_path / "all")]
    assert np.ptp(shares) > 0.1


def test_a_failing_estimator_is_reported_and_compared_for_nobody(data_folder, tmp_path, method, no_figures):
    def solved(case):
        if case.name == "organ_000001":
            raise SolverDivergedError("no equilibrium")
        if case.name == "organ_000003":
            return np.full_like(case.points, np.nan)
        if case.name == "organ_000004":
            raise IndexError("beyond the end")
        return np.zeros_like(case.points)

    method("fragile", solved)
    shown = run(data_folder, tmp_path, "rigid,fragile", workers=0)
    found = summary(tmp_path)
    assert found["compared"] == 3
    assert found["estimators"]["fragile"]["failures"] == {
        "no equilibrium": 1,
        "the estimate has numbers that are not finite": 1,
        "IndexError: beyond the end": 1,
    }
    assert "fragile failed on 1: no equilibrium" in shown
    assert found["estimators"]["rigid"]["conditions"]["all"]["samples"] == 3
    failed = [row for row in rows(tmp_path) if row["failure"]]
    assert [row["sample"] for row in failed] == ["organ_000001", "organ_000003", "organ_000004"]
    assert all(row["mean_mm"] == "" and row["compared"] == "0" for row in failed)


def test_without_a_common_sample_there_are_no_figures(data_folder, tmp_path, method):
    def broken(case):
        raise SolverDivergedError("never")

    method("broken", broken)
    assert "0 of 1 samples compared" in run(data_folder, tmp_path, "zero,broken", count=1)
    assert not (tmp_path / "figures").exists()


class Loading(methods.Simple):
    """Remembers which organs it was asked to prepare for."""

    def __init__(self):
        super().__init__(methods.no_displacement)
        self.loaded = []

    def load(self, organ):
        self.loaded.append(organ.digest)


def test_load_cases_of_one_organ_are_samples_of_their_own(tmp_path, no_figures):
    record = simulate(5, 0, Recipe(element_size_m=0.02, load_cases=2))
    data = tmp_path / "sims"
    data.mkdir()
    write_record(data, record_name(0), format_record(record))
    run(data, tmp_path / "out", "zero")
    table = rows(tmp_path / "out")
    assert [row["sample"] for row in table] == ["organ_000000.0", "organ_000000.1"]
    assert table[0]["target_mean_mm"] != table[1]["target_mean_mm"]
    assert table[0]["visible_share"] != table[1]["visible_share"]


def test_an_organ_is_loaded_once_for_cases_that_share_it(data_folder):
    jobs, _ = simulated_organs(data_folder, SETTINGS, 0, 2)
    first, other = jobs[0].cases()[0], jobs[1].cases()[0]
    method = Loading()
    assert all(answer.failure is None for answer in runner._answers(method, [first, first, other]))
    assert method.loaded == [first.organ.digest, other.organ.digest]


def test_the_products_estimators_answer_through_their_interface(data_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # others add to the one of the run
    weights = tmp_path / "own.safetensors"
    spec = NetworkSpec(spacing=0.30 / 16, architecture=UNetArchitecture(widths=(4, 4, 4, 8)))
    save_checkpoint(weights, UNet(spec.architecture), spec, {"command": "train it"})
    before = set(cache_folder().glob("*")) if cache_folder().exists() else set()
    run(data_folder, tmp_path / "out", f"zero,rigid,elastic,paper={weights}", count=1)
    after = set(cache_folder().glob("*")) if cache_folder().exists() else set()
    assert after == before  # an evaluation leaves nothing in the user's cache
    found = summary(tmp_path / "out")
    assert found["compared"] == 1
    means = {name: one["conditions"]["all"]["mean_mm"] for name, one in found["estimators"].items()}
    assert means["elastic"] < 0.9 * means["rigid"] < means["zero"]
    # Untrained weights answer, and have no idea.
    assert means["paper"] > 0.5 * means["zero"]
    assert found["estimators"]["paper"]["calibration"] is None
    # Of a single sample, on a coarse mesh that is another one in every run.
    assert 0.1 < found["estimators"]["elastic"]["calibration"]["rms_chi"] < 20.0
    assert found["estimators"]["elastic"]["time_s"]["setup_median"] > 0.1
    assert found["checkpoints"]["paper"]["provenance"] == {"command": "train it"}
    assert (tmp_path / "out" / "figures" / "calibration.png").is_file()


def test_figures_show_every_estimator(data_folder, tmp_path):
    jobs, _ = simulated_organs(data_folder, SETTINGS, 0, 3)
    results = evaluate(jobs, parse_methods("zero,rigid"), tmp_path, workers=0, show_progress=False)
    two = figures.write_figures(tmp_path / "two", results)
    assert sorted(path.name for path in two) == sorted(FIGURES)
    for result in results:
        del result.answers["zero"]
    one = figures.write_figures(tmp_path / "one", results)
    for first, second in zip(two, one, strict=True):
        assert first.read_bytes() != second.read_bytes()


def cli(data, out, *arguments):
    return main(["evaluate", "insilico", "--data", str(data), "--out", str(out), *arguments])


def test_command_prints_the_table(data_folder, tmp_path, capsys, no_figures, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/softtissue-train", "evaluate", "in silico"])
    assert cli(data_folder, tmp_path, "--estimators", "zero", "--count", "1", "--visible", "20", "30") == 0
    shown = capsys.readouterr()
    assert "1 of 1 samples compared" in shown.out
    assert "evaluating" in shown.err  # the progress bar
    assert 0.2 <= float(rows(tmp_path)[0]["visible_share"]) < 0.35
    assert summary(tmp_path)["command"] == "softtissue-train evaluate 'in silico'"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--estimators", "magic"], "estimators: expected zero, rigid, rbf, fem"),
        (["--estimators", "paper=none.safetensors"], "expected a file of weights for paper"),
        (["--visible", "60", "8"], "visible surface: expected two shares in ascending order"),
        (["--noise", "-1"], "noise: expected 0 to 100 mm, got -1 mm"),
        (["--sparse", "1"], "observed points: expected at least 3, got 1"),
        (["--count", "7"], "expected 7 simulations, got 6"),
        (["--skip", "6"], "expected simulations after the first 6, got 6 in all"),
        (["--seed", "-1"], "--seed and --skip: expected whole numbers from 0, got -1 and 0"),
    ],
)
def test_wrong_arguments_end_with_one_sentence(data_folder, tmp_path, capsys, arguments, message):
    assert cli(data_folder, tmp_path, "--estimators", "zero", *arguments) == 2
    said = capsys.readouterr().err
    assert message in said
    assert "Traceback" not in said and said.count("\n") <= 2


def test_wrong_data_end_with_one_sentence(tmp_path, capsys):
    assert cli(tmp_path / "none", tmp_path / "out", "--estimators", "zero") == 2
    assert "none, which does not exist" in capsys.readouterr().err
    assert cli(tmp_path, tmp_path / "out", "--estimators", "zero") == 2
    assert "expected simulations, got none" in capsys.readouterr().err
    (tmp_path / record_name(0)).write_bytes(b"half a record")
    assert cli(tmp_path, tmp_path / "out", "--estimators", "zero") == 2
    assert "organ_000000.npz must be a complete simulation record" in capsys.readouterr().err
