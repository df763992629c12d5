import os
import signal
import subprocess
import sys
import time

from softtissue_training.archive import list_records
from softtissue_training.generate import generate

from .conftest import ELEMENT_SIZE_M


def test_only_missing_samples_are_simulated(data_folder, tmp_path):
    for name in list_records(data_folder)[:3]:
        (tmp_path / name).write_bytes((data_folder / name).read_bytes())
    (tmp_path / "sample_000004.partial123").write_bytes(b"left by a killed run")
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in list_records(tmp_path)}
    generate(tmp_path, 5, seed=3, workers=0, edge_length_m=ELEMENT_SIZE_M, show_progress=False)
    assert len(list_records(tmp_path)) == 5
    assert all((tmp_path / name).stat().st_mtime_ns == written for name, written in before.items())
    # What was made now is what an uninterrupted run makes.
    for name in list_records(tmp_path):
        assert (tmp_path / name).read_bytes() == (data_folder / name).read_bytes()


def test_a_killed_run_goes_on_with_the_same_command(data_folder, tmp_path):
    command = [
        sys.executable,
        "-m",
        "softtissue_training",
        "generate",
        "--count",
        "6",
        "--seed",
        "3",
        "--workers",
        "1",
    ]
    command += ["--element-size", "20", "--out", str(tmp_path)]
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join(path for path in sys.path if path))
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    ) as run:
        deadline = time.monotonic() + 90
        while not list_records(tmp_path) and time.monotonic() < deadline and run.poll() is None:
            time.sleep(0.05)
        os.killpg(run.pid, signal.SIGKILL)
    assert 1 <= len(list_records(tmp_path)) < 6
    subprocess.run(command, env=environment, check=True, capture_output=True, timeout=90)
    assert list_records(tmp_path) == list_records(data_folder)
    for name in list_records(tmp_path):
        assert (tmp_path / name).read_bytes() == (data_folder / name).read_bytes()
