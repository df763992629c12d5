"""Tests that measure time wait until no other test of the run is at work, and others for them."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import alone
from alone import Turns

BUSY_S = 0.5


def turns(folder, run="run", **options):
    """Turns of a process of its own: it has opened the files itself."""
    (folder / run).mkdir(exist_ok=True)
    return Turns(folder / "machine", folder / run, **options)


def enter(own, kind, times, seen, inside, lock):
    for _ in range(times):
        with own.alone() if kind == "alone" else own.beside_others():
            with lock:
                inside.append(kind)
                seen[kind].append(list(inside))
            time.sleep(0.01)
            with lock:
                inside.remove(kind)


def test_who_is_alone_meets_nobody_and_comes_in_although_others_never_stop(tmp_path):
    """Whom everyone who enters finds in the room, by kind."""
    seen, inside, lock = {"alone": [], "beside": []}, [], threading.Lock()
    threads = [
        threading.Thread(target=enter, args=(turns(tmp_path), kind, 20, seen, inside, lock))
        for kind in ("beside", "beside", "beside", "alone", "alone")
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert seen["alone"] == [["alone"]] * 40
    assert len(seen["beside"]) == 60 and all("alone" not in present for present in seen["beside"])
    assert max(map(len, seen["beside"])) > 1


def waited(room):
    began = time.monotonic()
    with room():
        return time.monotonic() - began


def test_one_run_measures_at_a_time_and_others_go_on(tmp_path):
    other = turns(tmp_path, "other", patience_s=BUSY_S)
    with turns(tmp_path).alone():
        assert waited(other.alone) >= BUSY_S
        assert waited(other.beside_others) < BUSY_S


def test_nobody_waits_for_ever(tmp_path):
    first, second = turns(tmp_path), turns(tmp_path, patience_s=BUSY_S)
    with first.beside_others():
        assert waited(second.alone) >= BUSY_S
    with first.alone():
        assert waited(second.beside_others) >= BUSY_S


def test_an_error_inside_lets_others_in(tmp_path):
    first, second = turns(tmp_path), turns(tmp_path, patience_s=60.0)
    for room in (first.alone, first.beside_others):
        with pytest.raises(ZeroDivisionError), room():
            raise ZeroDivisionError
        assert waited(second.alone) < 30.0


SUITE = """
import pytest

@pytest.mark.alone
def test_measuring():
    pass

def test_ordinary():
    pass
"""
CONFTEST = """
from pathlib import Path
from alone import AlonePlugin

def pytest_configure(config):
    config.pluginmanager.register(AlonePlugin(config))

def pytest_collection_finish():
    Path("collected").touch()
"""


@pytest.mark.parametrize("processes", [0, 1])
def test_waiting_is_in_no_tests_time_and_measuring_tests_come_last(tmp_path, processes):
    (tmp_path / "test_suite.py").write_text(SUITE)
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "pytest.ini").write_text("[pytest]\ntimeout = 1\nmarkers = alone\n")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")} | {
        "TMPDIR": str(tmp_path),
        "PYTHONPATH": str(Path(alone.__file__).parent),
    }
    command = [sys.executable, "-m", "pytest", "-v", "-n", str(processes), str(tmp_path)]
    with Turns(tmp_path / f"softtissue-tests-measuring-{os.getuid()}").alone():
        run = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True)
        while run.poll() is None and not (tmp_path / "collected").exists():
            time.sleep(0.01)
        time.sleep(1.5)  # longer than any of its tests may take
        assert run.poll() is None
    shown = run.communicate(timeout=60.0)[0]
    assert run.returncode == 0, shown
    lines = [line for line in shown.splitlines() if "PASSED" in line]
    assert [("ordinary" in line, "measuring" in line) for line in lines] == [(True, False), (False, True)]
