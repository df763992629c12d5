"""The whole benchmark on few coarse organs: its figures counted again from the answers, and going on after a stop."""

import csv
import dataclasses
import json

import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.cli import main
from softtissue_training.errors import SolverDivergedError
from softtissue_training.evaluation import figures, methods
from softtissue_training.evaluation.benchmark import plan as planning
from softtissue_training.evaluation.benchmark import report
from softtissue_training.evaluation.benchmark import run as benchmark
from softtissue_training.evaluation.benchmark.cases import observed_organs
from softtissue_training.evaluation.benchmark.fairness import among_answering
from softtissue_training.evaluation.benchmark.intervals import mean_interval
from softtissue_training.evaluation.benchmark.pairs import compare, parse_pairs
from softtissue_training.evaluation.benchmark.plan import NamedSurface, Plan, make_plan
from softtissue_training.evaluation.measured import Answer, CaseResult, Truth
from softtissue_training.evaluation.methods import parse_methods
from softtissue_training.evaluation.store import Store
from training.phantom_cases import ellipsoid

COUNT, SWEEP = 3, 1
CASES = COUNT + 15 * SWEEP  # seven views, five ratios, two laws, several loads
ELEMENT_M = 0.02


def coarse_plan(suites=("random",), **surfaces) -> Plan:
    return coarse(make_plan(suites, surfaces, count=COUNT, sweep_count=SWEEP))


def coarse(plan) -> Plan:
    return dataclasses.replace(
        plan,
        data_sets=tuple(
            dataclasses.replace(data, recipe=dataclasses.replace(data.recipe, element_size_m=ELEMENT_M))
            for data in plan.data_sets
        ),
    )


def run(plan, out, listed="zero,rigid", **options):
    options = {"workers": 0, "show_progress": False, "pairs": (("rigid", "zero"),)} | options
    return benchmark.run_benchmark(plan, parse_methods(listed), out, **options)


def summary(out):
    return json.loads((out / "benchmark.json").read_text(encoding="utf-8"))


def rows(out):
    with (out / "samples.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder of a benchmark of four organs, two in each sweep."""
    out = tmp_path_factory.mktemp("benchmark")
    shown = run(coarse_plan(), out, command="softtissue-train benchmark")
    return out, shown


def test_every_condition_is_counted_from_the_answers(finished):
    """Means of the JSON against the stored answers themselves, read without the benchmark's bookkeeping."""
    out, _ = finished
    store, spec = Store(out / "answers"), parse_methods("rigid")[0]
    means = {}
    for data in coarse_plan().data_sets:
        jobs, digest = observed_organs(data, out / "simulations" / data.name)
        assert summary(out)["simulations"][data.name]["digest"] == digest
        for job in jobs:
            truths = store.read_truths(job.key)
            answers = store.read_answers(job.key, spec.key())
            for truth, answer in zip(truths, answers, strict=True):
                condition = truth.name.split("/")[2]
                error = np.linalg.norm(answer.error[~truth.visible], axis=1).mean()
                means.setdefault(condition, []).append((1e3 * error, truth.visible_share))
    found = summary(out)["estimators"]["rigid"]
    for condition, values in means.items():
        errors = [error for error, _ in values]
        assert found[condition]["samples"] == len(errors) == (COUNT if condition == "all" else SWEEP)
        assert found[condition]["mean_mm"] == pytest.approx(np.mean(errors), rel=1e-5)
        assert found[condition]["max_mm"] == pytest.approx(np.max(errors), rel=1e-5)
    assert len(means) == 16
    bins = ("visible_08_15", "visible_15_25", "visible_25_40", "visible_40_60")
    for name, (low, high) in zip(bins, ((8, 15), (15, 25), (25, 40), (40, 100)), strict=True):
        within = [error for error, share in means["all"] if low <= 100 * share < high]
        assert found[name]["samples"] == len(within)
        if within:
            assert found[name]["mean_mm"] == pytest.approx(np.mean(within), rel=1e-5)
    unknown = [error for name in ("nu_0.30", "nu_0.40", "nu_0.45", "nu_0.49") for error, _ in means[name]]
    assert found["nu_unknown"]["mean_mm"] == pytest.approx(np.mean(unknown), rel=1e-5)
    base = [error for error, _ in means["all"][:SWEEP]]
    assert found["noise_0mm"]["mean_mm"] == pytest.approx(np.mean(base), rel=1e-5)
    ratio = summary(out)["over_base"]["rigid"]["noise_3mm"]
    noisy = [error for error, _ in means["noise_3mm"]]
    assert ratio == {"base": "noise_0mm", "ratio": pytest.approx(np.mean(noisy) / np.mean(base), rel=1e-5)}


def test_all_estimators_see_the_same_samples_and_everything_is_reported(finished):
    out, shown = finished
    found = summary(out)
    table = rows(out)
    seen = {
        label: [row["sample"] for row in table if row["estimator"] == label] for label in ("zero", "rigid")
    }
    assert seen["zero"] == seen["rigid"]
    assert len(set(seen["zero"])) == len(seen["zero"]) == CASES
    assert set(found["estimators"]) == {"zero", "rigid"}
    assert list(found["estimators"]["zero"]) == list(found["samples"])
    assert found["command"] == "softtissue-train benchmark"
    assert found["machine"]["cores"] >= 1 and found["versions"]["numpy"] and "UTC" in found["date"]
    assert found["estimators"]["zero"]["all"]["calibration"] is None
    text = (out / "benchmark.md").read_text(encoding="utf-8")
    for condition in found["samples"]:
        assert f"| `{condition}` |" in text and f"| `{condition}` |" in shown
    assert f"| {found['estimators']['rigid']['noise_2mm']['mean_mm']:.2f} |" in text
    assert (out / "figures" / "random" / "displacement_density.png").is_file()


def test_finished_work_is_not_done_again(finished, monkeypatch):
    out, _ = finished
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    monkeypatch.setattr(figures, "write_figures", lambda folder, results: [])
    first = summary(out)
    run(coarse_plan(), out)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")} == before
    assert summary(out)["estimators"] == first["estimators"]


def test_an_interrupted_run_goes_on(finished, tmp_path, monkeypatch):
    out, _ = finished
    for data in (out / "simulations").iterdir():
        target = tmp_path / "simulations" / data.name
        target.mkdir(parents=True)
        for path in list(data.iterdir())[1:]:  # one simulation of each set is missing
            (target / path.name).write_bytes(path.read_bytes())
    asked = []

    def stopping(case):
        asked.append(case.name)
        if len(asked) == 13:
            raise KeyboardInterrupt
        return methods.rigid_displacement(case)

    monkeypatch.setattr(figures, "write_figures", lambda folder, results: [])
    monkeypatch.setitem(methods._FUNCTIONS, "rigid", stopping)
    with pytest.raises(KeyboardInterrupt):
        run(coarse_plan(), tmp_path)
    assert not (tmp_path / "benchmark.json").exists()
    run(coarse_plan(), tmp_path)
    assert summary(tmp_path)["estimators"] == summary(out)["estimators"]
    # Only the cases of the one organ that was being answered are asked again.
    assert len(set(asked)) == CASES
    assert len(asked) - len(set(asked)) <= 8


def test_an_estimator_that_always_fails_spoils_nothing_for_others(finished, monkeypatch):
    out, _ = finished

    def fragile(case):
        if case.name.endswith("/noise_2mm"):
            raise SolverDivergedError("no equilibrium")
        return np.zeros_like(case.points)

    monkeypatch.setattr(figures, "write_figures", lambda folder, results: [])
    monkeypatch.setitem(methods._FUNCTIONS, "fragile", fragile)
    before = summary(out)["estimators"]["rigid"]
    run(coarse_plan(), out, "rigid,fragile", pairs=(("fragile", "rigid"),))
    found = summary(out)
    assert found["samples"]["noise_2mm"] == {"asked": SWEEP, "compared": SWEEP}
    assert found["estimators"]["rigid"] == before
    row = found["estimators"]["fragile"]["noise_2mm"]
    assert (row["samples"], row["failed"], row["failures"]) == (0, SWEEP, {"no equilibrium": SWEEP})
    assert "noise_2mm" not in found["over_base"]["fragile"]
    assert found["over_base"]["fragile"]["noise_1mm"]["ratio"] == 1.0
    text = (out / "benchmark.md").read_text(encoding="utf-8")
    assert f"fragile, `noise_2mm`: {SWEEP} times: no equilibrium" in text


def test_a_sample_that_one_of_twenty_fails_on_counts_for_nobody():
    results = [result(0.001, 0.002, 0.3, [0.005], [0.005]) for _ in range(20)]
    failure = Answer("no equilibrium", np.empty((0, 3), dtype=np.float32), None, 0.0, 0.0)
    results[3].answers["a"] = results[4].answers["a"] = failure
    kept = among_answering(results)
    assert [set(each.answers) for each in kept] == [{"a", "b"}] * 20
    assert report._row(results, "b")["samples"] == 18
    results[5].answers["a"] = failure  # now in more than a tenth
    assert [set(each.answers) for each in among_answering(results)] == [{"b"}] * 20
    assert report._row(results, "b")["samples"] == 20
    assert report._row(results, "a")["samples"] == 0 and report._row(results, "a")["failed"] == 3


def test_one_surface_is_one_mesh_with_many_loads(tmp_path, monkeypatch):
    """In worker processes, too."""
    monkeypatch.setattr(figures, "write_figures", lambda folder, results: [])
    known = ellipsoid()
    path = tmp_path / "organ.ply"
    trimesh.Trimesh(1e3 * known.vertices, known.faces, process=False).export(path)
    run(coarse_plan(("own",), own=NamedSurface(path, 1e-3)), tmp_path, workers=1)
    found = summary(tmp_path)
    assert found["estimators"]["zero"]["own_all"]["samples"] == COUNT
    assert found["suites"]["own"]["rigid"]["by_visible_share"]
    zero = [row for row in rows(tmp_path) if row["estimator"] == "zero"]
    assert len({row["points"] for row in zero}) == 1
    assert len({row["mean_mm"] for row in zero}) == len({row["visible_share"] for row in zero}) == COUNT
    with np.load(tmp_path / "simulations" / "own" / "organ.mesh.npz") as mesh:
        extent = np.ptp(mesh["vertices"], axis=0)
    assert extent == pytest.approx(np.ptp(known.vertices, axis=0), rel=0.05)
    other = NamedSurface(path, 0.9e-3)
    with pytest.raises(InvalidInputError, match="got those of another surface or unit; name another --out"):
        run(coarse_plan(("own",), own=other), tmp_path)


def result(error_one, error_other, share, target, depth):
    """One sample with the given errors along x, all points hidden."""
    count = len(target)
    zero = np.zeros(count)

    def answer(error):
        vector = np.column_stack([np.broadcast_to(error, count), zero, zero]).astype(np.float32)
        return Answer(None, vector, None, 0.0, 0.0)

    truth = Truth(
        "sample",
        share,
        None,
        np.column_stack([target, zero, zero]).astype(np.float32),
        np.asarray(depth, dtype=np.float32),
        np.zeros(count, dtype=bool),
    )
    return CaseResult(truth, {"a": answer(error_one), "b": answer(error_other)})


def test_pairs_say_where_one_is_better():
    results = [
        result(0.001, 0.002, 0.12, [0.005, 0.015], [0.005, 0.015]),
        result([0.004, 0.003, 0.002], 0.001, 0.25, [0.005, 0.005, 0.025], [0.005, 0.015, 0.015]),
    ]
    found = compare(results, "a", "b")
    shares = {entry["from_percent"]: entry for entry in found["by_visible_share"]}
    assert (shares[10.0]["better"], shares[20.0]["better"]) == ("a", "b")
    assert shares[20.0]["a_mm"] == pytest.approx(3.0) and shares[20.0]["difference_mm"] == pytest.approx(2.0)
    depth = {entry["from_mm"]: entry for entry in found["by_depth"]}
    # Points of both samples are pooled: errors 1 and 4, then 1, 3 and 2.
    assert depth[0.0]["a_mm"] == pytest.approx(2.5) and depth[0.0]["b_mm"] == pytest.approx(1.5)
    assert depth[10.0]["a_mm"] == pytest.approx(2.0) and depth[10.0]["count"] == 3
    moved = {entry["from_mm"]: entry for entry in found["by_displacement"]}
    assert moved[0.0]["a_mm"] == pytest.approx((1 + 4 + 3) / 3)
    assert (found["bins"], found["worse"], found["clearly_worse"]) == (7, 5, 0)


def test_pairs_that_differ_clearly_are_said_to():
    rng = np.random.default_rng(0)
    results = [
        result(0.002 + 1e-4 * rng.normal(), 0.001, 0.3, [0.005, 0.015], [0.005, 0.015]) for _ in range(30)
    ]
    worse = compare(results, "a", "b")
    assert worse["worse"] == worse["clearly_worse"] == worse["bins"] == 5
    low, high = worse["by_depth"][0]["difference_95_mm"]
    assert low < 1.0 < high and high - low < 0.2
    assert compare(results, "b", "a")["worse"] == 0


def test_interval_is_that_of_a_mean():
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    low, high = mean_interval(values, np.ones(400), np.random.default_rng(0))
    half = 1.96 * values.std() / 20.0
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.04)
    assert mean_interval(values[:2], np.ones(2), np.random.default_rng(0)) is None


def test_samples_of_one_organ_are_no_independent_ones():
    """Four equal samples an organ: the interval is that of the organs."""
    values = 0.001 * np.random.default_rng(2).uniform(1.0, 3.0, 12)

    def named(name, value):
        one = result(value, value, 0.3, [0.005], [0.005])
        return dataclasses.replace(one, truth=dataclasses.replace(one.truth, name=name))

    once = [named(f"nu/{index}/a", value) for index, value in enumerate(values)]
    often = [named(f"nu/{index}/{k}", value) for index, value in enumerate(values) for k in "abcd"]
    assert report._mean_interval(often, "a") == pytest.approx(report._mean_interval(once, "a"))


def test_pairs_are_of_labels_in_the_list():
    assert parse_pairs([], ["zero", "elastic", "rigid"]) == [("elastic", "rigid")]
    assert parse_pairs(["zero:paper:own"], ["zero", "paper:own"]) == [("zero", "paper:own")]
    with pytest.raises(ValueError, match="expected two of zero, rigid joined by a colon, got 'rigid:rigid'"):
        parse_pairs(["rigid:rigid"], ["zero", "rigid"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--estimators", "magic"], "estimators: expected zero, rigid, rbf, fem"),
        (
            ["--suites", "own,liver"],
            "suites: expected some of random, own, user, real, bag, clouds, got own, liver",
        ),
        (["--suites", "user"], "suite user: expected a surface"),
        (["--organ-surface", "liver.stl"], "--organ-surface and --unit: expected both or neither"),
        (
            ["--label", "elastic=old"],
            "--label: expected one of zero, rigid, =, and a name, got 'elastic=old'",
        ),
        (["--label", "zero=rigid"], "--label: expected different names, got rigid, rigid"),
        (["--compare", "zero:elastic"], "expected two of zero, rigid joined by a colon"),
        (
            ["--organ-surface", "none.stl", "--unit", "mm", "--suites", "user"],
            "surface: expected a file, got none.stl",
        ),
    ],
)
def test_wrong_arguments_end_with_one_sentence(tmp_path, capsys, arguments, message):
    assert main(["benchmark", "--out", str(tmp_path / "out"), "--estimators", "zero,rigid", *arguments]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_the_command_reports(finished, capsys, monkeypatch):
    """Everything is there already, so that only the reports are made."""
    out, _ = finished
    monkeypatch.setattr(figures, "write_figures", lambda folder, results: [])
    monkeypatch.setattr(planning, "make_plan", lambda *given, **options: coarse(make_plan(*given, **options)))
    arguments = ["--count", str(COUNT), "--sweep", str(SWEEP), "--suites", "random"]
    assert (
        main(
            [
                "benchmark",
                "--out",
                str(out),
                *arguments,
                "--estimators",
                "zero,rigid",
                "--compare",
                "zero:rigid",
            ]
        )
        == 0
    )
    assert f"| `three_loads_gravity` | {SWEEP} |" in capsys.readouterr().out
    assert list(summary(out)["pairs"]) == ["zero_over_rigid"]
