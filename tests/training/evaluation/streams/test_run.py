"""The whole suite on two coarse organs: figures counted again from the answers, going on after a stop."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.cli import main
from softtissue_training.errors import SolverDivergedError
from softtissue_training.evaluation import methods
from softtissue_training.evaluation.benchmark import plan as planning
from softtissue_training.evaluation.benchmark.plan import REAL_SEED, make_plan
from softtissue_training.evaluation.methods import parse_methods
from softtissue_training.evaluation.streams.conditions import CONDITIONS
from softtissue_training.evaluation.streams.earlier import FIGURES
from softtissue_training.evaluation.streams.instances import instances
from softtissue_training.evaluation.streams.markdown import markdown
from softtissue_training.evaluation.streams.plan import StreamPlan, organ_name
from softtissue_training.evaluation.streams.run import run_streams
from softtissue_training.simulation.reserved_seeds import FIRST_RESERVED_SEED
from training.coarse import COARSE_MOTION, COARSE_STREAM

PLAN = StreamPlan(REAL_SEED, 2, COARSE_MOTION, COARSE_STREAM)
STRIDE = 5


def run(out, listed="zero,rigid", plan=PLAN):
    return run_streams(
        plan,
        parse_methods(listed),
        out,
        workers=0,
        stride=STRIDE,
        show_progress=False,
        command="the command",
    )


def summary(out):
    return json.loads((out / "real.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("real")
    return out, run(out)


@pytest.fixture
def again(finished, tmp_path):
    """A copy of it, to run other things in."""
    return Path(shutil.copytree(finished[0], tmp_path / "again"))


def test_every_condition_is_counted_from_the_streams(finished):
    """The error of `zero` is the motion itself, whatever the condition, but for frames that a jump leaves out."""
    out, shown = finished
    found = summary(out)["common_frames"]["zero"]
    assert set(found) == set(CONDITIONS)
    for condition, row in found.items():
        variants = len([one for one in instances(0, 2) if one.condition == condition])
        assert row["streams"] == 2 * variants == (6 if condition.startswith("registration") else 2)
        assert row["answered"] == 1.0 and row["calibration"] is None
        if condition != "jump":
            assert row["errors"]["mean_mm"] == pytest.approx(found["exact"]["errors"]["mean_mm"])
            assert row["frames"] == 3 * row["streams"]  # 5, 10 and 15 of 20
        assert f"| `{condition}` |" in shown
    text = (out / "real.md").read_text(encoding="utf-8")
    rigid = summary(out)["common_frames"]["rigid"]["registration_10"]["errors"]
    assert f"{rigid['mean_mm']:.1f} / {rigid['p95_mm']:.1f} / {rigid['max_mm']:.1f} |" in text
    assert rigid["mean_mm"] > 10.0


def test_what_an_estimator_with_a_history_does_in_every_frame_is_reported(finished):
    found = summary(finished[0])
    row = found["common_frames"]["rigid"]["exact"] | {"over_exact": 1.0, "degraded": 0.25}
    rows, errors = {"exact": row}, row["errors"]
    text = markdown(found | {"all_frames": {"followed": rows}})
    spread = f"{errors['mean_mm']:.1f} / {errors['p95_mm']:.1f} / {errors['max_mm']:.1f}"
    assert "## followed, every frame\n\n| condition | mean / 95 % / max, mm |" in text
    assert f"| `exact` | {spread} | 1.0 |" in text and "| 25.0% |" in text


def test_what_it_was_measured_on_is_said(finished):
    out, _ = finished
    found = summary(out)
    assert found["command"] == "the command" and found["machine"]["cores"] >= 1 and len(found["digest"]) == 64
    assert [one["name"] for one in found["streams"]] == [organ_name(0), organ_name(1)]
    assert found["plan"]["seed"] == REAL_SEED > FIRST_RESERVED_SEED
    assert "2 organs, seed 1000003, digest" in (out / "real.md").read_text(encoding="utf-8")


def test_finished_work_is_not_done_again_and_stopped_work_goes_on(finished, tmp_path, monkeypatch):
    out, _ = finished
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    first = summary(out)
    run(out)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")} == before

    (tmp_path / "motions").mkdir()
    name = f"{organ_name(0)}.npz"  # the other motion is missing
    (tmp_path / "motions" / name).write_bytes((out / "motions" / name).read_bytes())
    asked = []

    def stopping(case):
        asked.append(case.name)
        if len(asked) == 50:
            raise KeyboardInterrupt
        return methods.rigid_displacement(case)

    monkeypatch.setitem(methods._FUNCTIONS, "rigid", stopping)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path)
    assert not (tmp_path / "real.json").exists()
    run(tmp_path)
    for label, rows in summary(tmp_path)["common_frames"].items():
        assert without_time(rows) == without_time(first["common_frames"][label])
    assert summary(tmp_path)["digest"] == first["digest"]
    shown = sum(len(range(0, frames, STRIDE)) for frames in frames_shown())
    assert len(asked) <= shown + 4  # those of the one stream that was stopped are asked again


def frames_shown():
    for number in range(2):
        for one in instances(number, 2):
            yield 14 if one.condition == "jump" else 20


def without_time(rows):
    return {
        name: {key: value for key, value in row.items() if not key.endswith("_ms")}
        for name, row in rows.items()
    }


def test_an_estimator_that_fails_spoils_nothing_for_others(again, monkeypatch):
    out = again
    before = summary(out)["common_frames"]["rigid"]

    def fragile(case):
        if case.organ.attached.any():
            raise SolverDivergedError(f"no equilibrium of {case.name}")
        return np.zeros_like(case.points)

    monkeypatch.setitem(methods._FUNCTIONS, "fragile", fragile)
    shown = run(out, "rigid,fragile")
    found = summary(out)["common_frames"]
    assert found["rigid"] == before
    assert found["fragile"]["exact"]["answered"] == 0.0 and found["fragile"]["exact"]["errors"] is None
    assert found["fragile"]["attached_unknown"]["answered"] == 1.0
    row = next(line for line in shown.splitlines() if line.startswith("| `exact`"))
    assert row.endswith("| - |")
    text = (out / "real.md").read_text(encoding="utf-8")
    assert "- fragile, `exact`: 8 times, such as: no equilibrium of moving_00000" in text


def test_an_earlier_run_is_shown_beside(again, tmp_path):
    out = again
    path = tmp_path / "earlier.json"
    earlier = summary(out)
    for kind in FIGURES:
        earlier[kind] = {f"{label}@0": rows for label, rows in earlier[kind].items()}
    path.write_text(json.dumps(earlier), encoding="utf-8")
    shown = run_streams(
        PLAN, parse_methods("zero"), out, workers=0, stride=STRIDE, show_progress=False, beside=path
    )
    assert "| condition | zero@0 | rigid@0 | zero |" in shown
    found = summary(out)["common_frames"]
    assert found["rigid@0"] == earlier["common_frames"]["rigid@0"]
    assert without_time(found["zero"]) == without_time(found["zero@0"])
    for wrong, message in (
        ({"digest": "0" * 64, **{kind: {} for kind in FIGURES}}, "got .* of others"),
        ({"digest": 3}, "expected a real.json of an earlier run"),
    ):
        path.write_text(json.dumps(wrong), encoding="utf-8")
        with pytest.raises(InvalidInputError, match=message):
            run_streams(
                PLAN, parse_methods("zero"), out, workers=0, stride=STRIDE, show_progress=False, beside=path
            )


def test_other_motions_are_not_mixed(finished):
    out, _ = finished
    with pytest.raises(
        InvalidInputError, match=r"expected a motion with states 13, got 11; name another --out"
    ):
        run(out, plan=dataclasses.replace(PLAN, motion=dataclasses.replace(COARSE_MOTION, states=13)))


def test_the_digest_changes_with_what_is_observed(finished):
    observation = dataclasses.replace(COARSE_STREAM, noise_m=0.001)
    other = dataclasses.replace(PLAN, observation=observation)
    assert other.stream_key("hash", 1) != PLAN.stream_key("hash", 1) != PLAN.stream_key("other", 1)


def test_the_plan_has_twenty_organs_or_four():
    assert make_plan(("real",), {}).streams == StreamPlan(REAL_SEED, 20)
    quick = make_plan(("real", "random"), {}, quick=True)
    assert quick.streams.organs == 4 and quick.suites == ("random",)
    assert make_plan(("random",), {}).streams is None


def test_the_command_reports(again, capsys, monkeypatch):
    """Every tenth frame is asked for, as without tests, and a process answers."""
    out = again
    monkeypatch.setattr(planning, "make_plan", lambda *given, **options: planning.Plan((), (), PLAN))
    arguments = ["benchmark", "--suites", "real", "--quick", "--out", str(out), "--workers", "1"]
    assert main([*arguments, "--estimators", "zero", "--label", "zero=nothing"]) == 0
    said = capsys.readouterr().out
    assert "| `attached_unknown` |" in said and "| condition | nothing |" in said


def test_the_streams_are_not_flat(finished):
    for one in summary(finished[0])["streams"]:
        assert np.isfinite(list(value for key, value in one.items() if key != "name")).all()
        assert one["largest_displacement_mm"] > 5.0 and 0.1 <= one["visible_share"] <= 0.6
