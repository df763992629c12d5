import json

import pytest

from softtissue_training.cli import main
from softtissue_training.evaluation.timing import summarise


def test_every_stage_of_every_combination_is_timed(tmp_path, capsys):
    out = tmp_path / "new" / "timing.json"
    arguments = ["timing", "--out", str(out), "--estimators", "elastic", "--points", "200", "500"]
    assert main([*arguments, "--frames", "4", "--rate", "0", "--device", "cpu"]) == 0
    written = json.loads(out.read_text())
    assert written["tracking"] is True
    assert [(row["points"], row["frames"]) for row in written["results"]] == [(200, 3), (500, 3)]
    for row in written["results"]:
        stages = row["stages"]
        assert {"check", "estimate", "visibility", "estimate/match", "estimate/solve"} < stages.keys()
        assert 0.0 < stages["estimate"]["p50_ms"] <= stages["estimate"]["p95_ms"]
        assert stages["total"]["p50_ms"] >= stages["estimate"]["p50_ms"]
        assert row["first_ms"] > 0.0
    shown = capsys.readouterr().out
    assert "| stage | elastic 200 | elastic 500 |" in shown
    assert "| estimate/solve |" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--estimators", "guess"], "expected one of elastic, paper, got 'guess'"),
        (["--rate", "-1"], "expected numbers from 0, got 0 and -1.0"),
        (["--organ", "nowhere"], "nowhere"),
    ],
)
def test_wrong_arguments_end_with_code_2_and_one_sentence(arguments, message, tmp_path, capsys):
    assert main(["timing", "--out", str(tmp_path / "timing.json"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "timing.json").exists()


def test_quantiles_leave_the_first_frame_out():
    frames = [{"total": seconds, "only at times": seconds} for seconds in (9.0, 0.001, 0.002, 0.003)]
    del frames[2]["only at times"]
    found = summarise(frames)
    assert found["first_ms"] == 9000.0
    assert found["stages"]["total"] == {"p50_ms": 2.0, "p95_ms": 2.9, "max_ms": 3.0}
    assert found["stages"]["only at times"]["max_ms"] == 3.0
