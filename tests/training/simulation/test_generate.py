import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.simulation.archive import list_records
from softtissue_training.simulation.cluster import connect
from softtissue_training.simulation.generate import generate
from training.coarse import COARSE

COMMAND = [sys.executable, "-m", "softtissue_training", "generate", "--element-size", "20", "--seed", "3"]


def _environment():
    return dict(os.environ, PYTHONPATH=os.pathsep.join(path for path in sys.path if path))


def _assert_same(folder, expected):
    assert list_records(folder) == list_records(expected)
    for name in list_records(folder):
        assert (folder / name).read_bytes() == (expected / name).read_bytes()
    assert len(list(folder.iterdir())) == len(list_records(folder)) + len(list(folder.glob("*.partial*")))


def test_only_missing_organs_are_simulated(data_folder, tmp_path):
    for name in list_records(data_folder)[:3]:
        (tmp_path / name).write_bytes((data_folder / name).read_bytes())
    (tmp_path / "organ_000004.npz.partial123").write_bytes(b"left by a killed run")
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in list_records(tmp_path)}
    report = generate(tmp_path, 6, 3, COARSE, show_progress=False)
    assert (report.organs, report.simulations) == (6, 6)
    assert all((tmp_path / name).stat().st_mtime_ns == written for name, written in before.items())
    _assert_same(tmp_path, data_folder)


def test_rejections_are_counted_over_all_records_whenever_they_were_made(records, data_folder, tmp_path):
    for name in list_records(data_folder):
        (tmp_path / name).write_bytes((data_folder / name).read_bytes())
    total = sum(sum(record.rejected.values()) for record in records)
    assert total > 0
    assert sum(generate(tmp_path, 6, 3, COARSE, show_progress=False).rejected.values()) == total


@pytest.mark.parametrize(
    ("seed", "recipe", "message"),
    [
        (4, COARSE, "got organ_000000.npz of seed 3"),
        (3, dataclasses.replace(COARSE, gravity=(0.0, 1.0)), r"of seed 3 and gravity \(0.0, 0.0\)"),
    ],
)
def test_data_sets_are_not_mixed(data_folder, seed, recipe, message):
    before = list_records(data_folder)
    with pytest.raises(InvalidInputError, match=message):
        generate(data_folder, 10, seed, recipe, show_progress=False)
    assert list_records(data_folder) == before


def test_a_killed_run_goes_on_with_the_same_command(data_folder, tmp_path):
    command = [*COMMAND, "--count", "6", "--out", str(tmp_path)]
    with subprocess.Popen(
        command,
        env=_environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as run:
        deadline = time.monotonic() + 90
        while not list_records(tmp_path) and time.monotonic() < deadline and run.poll() is None:
            time.sleep(0.02)
        os.killpg(run.pid, signal.SIGKILL)
    assert 1 <= len(list_records(tmp_path)) < 6
    subprocess.run(command, env=_environment(), check=True, capture_output=True, timeout=90)
    _assert_same(tmp_path, data_folder)


def test_a_killed_worker_loses_and_doubles_nothing(data_folder, tmp_path):
    with connect(workers=2) as client:
        killed = []

        def kill_one():
            # In the middle: as soon as the first record is there.
            while not list_records(tmp_path):
                time.sleep(0.01)
            processes = list(client.run(os.getpid).values())
            os.kill(processes[0], signal.SIGKILL)
            killed.append(processes[0])

        killer = threading.Thread(target=kill_one)
        killer.start()
        report = generate(tmp_path, 6, 3, COARSE, client=client, show_progress=False)
        killer.join()
        with contextlib.suppress(ProcessLookupError):
            assert client.run(os.getpid) != killed
    assert killed
    assert report.organs == 6
    _assert_same(tmp_path, data_folder)


def test_a_running_scheduler_is_used(data_folder, tmp_path):
    with connect(workers=1) as client:
        address = client.scheduler.address
        command = [*COMMAND, "--count", "2", "--scheduler", address, "--out", str(tmp_path)]
        subprocess.run(command, env=_environment(), check=True, capture_output=True, timeout=60)
    assert list_records(tmp_path) == list_records(data_folder)[:2]
    for name in list_records(tmp_path):
        assert (tmp_path / name).read_bytes() == (data_folder / name).read_bytes()


def test_a_scheduler_that_does_not_answer_gives_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr("softtissue_training.simulation.cluster._CONNECT_S", 1)
    with (
        pytest.raises(InvalidInputError, match="--scheduler must be the address of a running Dask scheduler"),
        connect(1, "tcp://127.0.0.1:9"),
    ):
        pass
