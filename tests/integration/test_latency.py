"""The tool `latency`: its arithmetic, and a small run through real processes."""

import contextlib
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from integration.harness import executable, write_organ
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.ros.inputs.conversions import read_cloud
from softtissue_estimator.ros.tools.latency.clouds import moving_clouds
from softtissue_estimator.ros.tools.latency.message_paths import ring_alone, time_answer, time_cloud
from softtissue_estimator.ros.tools.latency.statistics import Run, ages_ms, latencies_ms, quantiles, summarise
from softtissue_estimator.ros.tools.latency.usage import cpu_share, gpu_memory_mb, usage_of
from softtissue_training.evaluation.realtime.plan import RealtimePlan
from softtissue_training.evaluation.realtime.report import bench_summary, markdown
from softtissue_training.evaluation.realtime.run import run_realtime

MS = 1_000_000


def status(stamp, answered, counts, **stages):
    return {
        "stamp": stamp,
        "answered": answered,
        "stages": stages,
        "counts": dict(zip(("answered", "dropped", "refused"), counts, strict=True)),
    }


def test_age_grows_from_one_answer_to_the_next_newer_one():
    # Published at 0, 10, 20, 30 ms; the answer to 10 comes late, after that to 20, and makes nothing newer.
    pairs = [(0, 5 * MS), (20 * MS, 28 * MS), (10 * MS, 31 * MS), (30 * MS, 44 * MS)]
    measured = frozenset(stamp for stamp, _ in pairs)
    # Just before 28: that of 0 is 28 old. Just before 44: that of 20 is 24 old.
    assert ages_ms(pairs, measured).tolist() == [28.0, 24.0]
    assert latencies_ms(pairs, measured).tolist() == [5.0, 8.0, 21.0, 14.0]
    assert ages_ms(pairs, frozenset([30 * MS])).tolist() == []


def test_age_of_a_steady_stream_is_latency_and_interval():
    stamps = 1_700_000_000_000_000_000 + 20 * MS * np.arange(50)
    pairs = [(int(stamp), int(stamp) + 7 * MS) for stamp in stamps]
    ages = ages_ms(pairs, frozenset(stamp for stamp, _ in pairs))
    assert len(ages) == 49
    np.testing.assert_allclose(ages, 27.0, atol=1e-6)


def test_quantiles_are_those_of_numpy():
    values = np.random.default_rng(0).exponential(5.0, size=1001)
    found = quantiles(values, "x_")
    for name, share in (("p50", 50), ("p95", 95), ("p99", 99), ("max", 100)):
        assert found[f"x_{name}_ms"] == pytest.approx(np.percentile(values, share), abs=1e-3)
    assert quantiles(np.array([])) == {"p50_ms": None, "p95_ms": None, "p99_ms": None, "max_ms": None}


def test_every_cloud_is_counted_once_and_the_warm_up_not_at_all():
    sent = [10 * MS * i for i in range(1, 13)]
    answered = [s for i, s in enumerate(sent) if i not in (1, 5, 6, 9)]
    pairs = [(stamp, stamp + 4 * MS) for stamp in answered]
    statuses = [status(stamp, True, (0, 0, 0), estimate=0.002) for stamp in answered]
    statuses += [status(sent[9], False, (0, 0, 0)), status(sent[11], True, (8, 3, 1), estimate=0.002)]
    found = summarise(Run(2, sent, pairs, [(sent[3], sent[3] + 6 * MS)], statuses))
    assert (found["sent"], found["answered"], found["dropped"], found["refused"]) == (10, 7, 2, 1)
    assert (found["unaccounted"], found["lost_answers"]) == (0, 0)
    assert found["p50_ms"] == found["max_ms"] == pytest.approx(4.0)
    assert found["sent_hz"] == pytest.approx(100.0)
    assert found["throughput_hz"] == pytest.approx(6 / 0.09, abs=0.01)
    # Two dropped in a row: the answer before them is three intervals and a latency old.
    assert found["age_max_ms"] == pytest.approx(34.0)
    assert found["estimate_p50_ms"] == pytest.approx(2.0)
    assert found["age_over_estimate"] == pytest.approx(17.0)
    assert found["markers_p50_ms"] == pytest.approx(6.0)


def test_clouds_and_answers_that_are_missing_are_told_apart():
    sent = [10 * MS, 20 * MS, 30 * MS]
    pairs = [(10 * MS, 12 * MS)]
    # The node says that it answered two; of the third it knows nothing.
    found = summarise(Run(0, sent, pairs, [], [status(30 * MS, True, (2, 0, 0), estimate=0.001)]))
    assert (found["answered"], found["dropped"]) == (1, 2)
    assert (found["unaccounted"], found["lost_answers"]) == (1, 1)


def test_own_processor_time_is_seen():
    before = usage_of(os.getpid())
    end = time.process_time() + 0.3
    while time.process_time() < end:
        pass
    after = usage_of(os.getpid())
    # Ticks are 10 ms; other threads of this process may work too.
    assert after.cpu_s - before.cpu_s >= 0.25
    assert cpu_share(before, after) > 0.0
    assert 10.0 < after.rss_mb < 20_000.0


def test_gpu_memory_is_that_of_the_process_or_all_that_is_used(tmp_path, monkeypatch):
    tool = tmp_path / "nvidia-smi"
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    for processes, all_used, expected in (
        ("41, 100\n42, 1000\n", "2000", 1048.576),  # MiB to MB
        ("41, 100\n", "2000", 2097.152),
        ("42, [N/A]\n", "[N/A]", None),
    ):
        tool.write_text(
            f"#!/bin/sh\ncase \"$1\" in *compute*) printf '{processes}' ;; *) echo '{all_used}' ;; esac\n"
        )
        tool.chmod(0o755)
        assert gpu_memory_mb(42) == (None if expected is None else pytest.approx(expected))
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    assert gpu_memory_mb(42) is None


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"))


def test_clouds_of_one_period_move_and_come_back(folder):
    organ = load_organ(folder)
    clouds = [
        read_cloud(deserialize_message(data, PointCloud2))
        for data in moving_clouds(organ, 300, 10.0, 0.02, 2.0, 0)
    ]
    assert len(clouds) == 20
    moved = [np.linalg.norm(cloud.points - cloud.reference, axis=1).max() for cloud in clouds]
    assert max(moved) == pytest.approx(0.02, abs=0.002) and np.argmax(moved) in (9, 10, 11)
    assert moved[0] < 0.003 and moved[-1] < 0.004
    assert all(np.array_equal(cloud.reference, clouds[0].reference) for cloud in clouds)


@pytest.mark.alone
def test_naive_paths_do_the_same_and_take_longer(folder):
    organ = load_organ(folder)
    for row in (time_cloud(organ, 2000), time_answer(organ)):
        assert row["same_result"] is True
        assert row["naive_over_ours"] > 2.0
    ring = ring_alone()
    assert (len(ring.surface.vertices), len(ring.surface.faces)) == (10_000, 20_000)


SMALL = RealtimePlan(
    estimators=("elastic",),
    points=(500,),
    rates=(20.0,),
    seconds=1.0,
    vertices=(1000,),
    device="cpu",
    frames=3,
    stage_points=(500,),
    element_sizes_m=(0.02,),
    fem_repeats=1,
    network_repeats=0,
    soak_s=0.0,
    quick=True,
    overlays=("64x48@10",),
)


@pytest.mark.alone
@pytest.mark.timeout(120)
def test_small_benchmark_through_real_processes(tmp_path, monkeypatch, capfd, environment):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    summary = bench_summary(run_realtime(SMALL, tmp_path, print), "command", "today")
    plain, markers, services, drawn = summary["end_to_end"]
    for row in summary["end_to_end"]:
        assert (row["estimator"], row["device"], row["points"], row["rate_hz"]) == (
            "elastic",
            "cpu",
            500,
            20.0,
        )
        assert row["sent"] == 20 == row["answered"] + row["dropped"]
        assert (row["unaccounted"], row["lost_answers"], row["refused"]) == (0, 0, 0)
        assert 0.0 < row["p50_ms"] <= row["p95_ms"] <= row["p99_ms"] <= row["max_ms"]
        # The sender's clock and the receiver's are one: an answer cannot come before its estimate is made.
        assert row["p50_ms"] > row["estimate_p50_ms"] > 0.0
        assert row["age_max_ms"] > row["p50_ms"] + 40.0
        assert row["sent_hz"] == pytest.approx(20.0, rel=0.3)
        assert row["cpu_share"] > 0.0 and row["rss_mb"] > 100.0
        assert row["structures_vertices"] == 1000
    assert "markers_p50_ms" not in plain and markers["markers_p50_ms"] > 0.0
    for times in services["service_ms"].values():
        assert times["calls"] >= 2 and 0.0 < times["p50_ms"] <= times["max_ms"]
    overlay = drawn["overlay"]
    assert [row[one] for row in (plain, markers, services) for one in ("overlay", "viewer")] == [None] * 6
    # The newest image wins: how many are passed over depends on what else the cores do.
    assert overlay["sent"] >= 8 and 2 <= overlay["shown"] <= overlay["sent"]
    assert 0.0 < overlay["p50_ms"] <= overlay["max_ms"] and overlay["cpu_share"] > 0.0
    assert drawn["viewer"]["cpu_share"] > 0.0 and drawn["viewer"]["rss_mb"] > 100.0
    assert drawn["p95_over_alone"] == pytest.approx(drawn["p95_ms"] / plain["p95_ms"], abs=0.01)
    assert "| 64x48@10 |" in markdown(summary)
    assert summary["starts"][0]["start_to_answer_s"] > 0.0
    paths = {row["path"]: row for row in summary["messages"]}
    assert {path: row["size"] for path, row in paths.items()} == {
        "cloud to arrays": 500,
        "answer to bytes": 1000,
        "markers published": 20_000,
    }
    assert summary["ratios"]["markers_naive_over_ours"] > 20.0
    assert summary["ratios"]["cloud_naive_over_ours"] > 1.0
    assert "| elastic | 500 | 1000 | 20.0 |" in markdown(summary)
    assert "from start to first answer" in capfd.readouterr().out
    said = []
    assert run_realtime(SMALL, tmp_path, said.append)["end_to_end"] == summary["end_to_end"]
    assert sum("kept from" in text for text in said) == 3


def test_wrong_arguments_are_one_sentence_and_exit_code_2(environment):
    for arguments, words in (
        (["--rates", "0"], "--rates and --seconds above 0"),
        (["--organ", "nowhere"], "nowhere"),
        (["--parameter", "tracking"], "NAME:=VALUE"),
        (["--parameter", "tracking:=false", "--rates", "0"], "--rates and --seconds above 0"),
        (["--overlay", "640x480"], "COLUMNSxROWS@RATE"),
    ):
        command = [str(executable("latency")), *arguments]
        result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert result.returncode == 2
        assert words in result.stderr and "Traceback" not in result.stderr


def command_lines():
    """Of all processes of this machine; those that end meanwhile have none."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            yield path.read_bytes().replace(b"\0", b" ").decode(errors="replace")


@pytest.mark.timeout(60)
def test_interrupted_run_leaves_no_processes(folder, tmp_path, environment):
    command = [str(executable("latency")), "--organ", str(folder), "--seconds", "60"]
    tool = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    for line in tool.stdout:
        if "loading organ" in line:
            break
    tool.send_signal(signal.SIGTERM)
    _, errors = tool.communicate(timeout=30.0)
    assert (tool.returncode, "Traceback" in errors) == (130, False), errors
    assert [line for line in command_lines() if str(folder) in line] == []
