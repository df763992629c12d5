"""Tests that measure time wait until no other test runs, and others for them."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import machine
from machine import Machine

BUSY_S = 0.1


@pytest.fixture
def seen():
    """How many are in the room whenever one enters, by kind."""
    return {"alone": [], "beside": []}


def enter(folder, kind, times, seen, inside, lock):
    own = Machine(folder)
    for _ in range(times):
        with own.alone() if kind == "alone" else own.beside_others():
            with lock:
                inside.append(kind)
                seen[kind].append(list(inside))
            time.sleep(0.01)
            with lock:
                inside.remove(kind)


def test_who_is_alone_meets_nobody_and_comes_in_although_others_never_stop(tmp_path, seen):
    inside, lock = [], threading.Lock()
    kinds = ("beside", "beside", "beside", "alone", "alone")
    # Machines of their own, as of processes of their own: each has opened the files itself.
    threads = [
        threading.Thread(target=enter, args=(tmp_path, kind, 20, seen, inside, lock)) for kind in kinds
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert seen["alone"] == [["alone"]] * 40
    assert len(seen["beside"]) == 60 and all("alone" not in present for present in seen["beside"])
    assert max(map(len, seen["beside"])) > 1


def test_nobody_waits_for_ever(tmp_path):
    other = Machine(tmp_path)
    with other.beside_others():
        began = time.monotonic()
        with Machine(tmp_path, patience_s=BUSY_S).alone():
            assert time.monotonic() - began >= BUSY_S
    with other.alone():
        began = time.monotonic()
        with Machine(tmp_path, patience_s=BUSY_S).beside_others():
            assert time.monotonic() - began >= BUSY_S


def test_an_error_inside_lets_others_in(tmp_path):
    first, other = Machine(tmp_path), Machine(tmp_path, patience_s=60.0)
    for room in (first.alone, first.beside_others):
        with pytest.raises(ZeroDivisionError), room():
            raise ZeroDivisionError
        began = time.monotonic()
        with other.alone():
            assert time.monotonic() - began < 30.0


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
from machine import AlonePlugin

def pytest_configure(config):
    config.pluginmanager.register(AlonePlugin())

def pytest_collection_finish():
    Path("collected").touch()
"""


def test_waiting_is_in_no_tests_time_and_measuring_tests_come_last(tmp_path):
    (tmp_path / "test_suite.py").write_text(SUITE)
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "pytest.ini").write_text("[pytest]\ntimeout = 1\nmarkers = alone\n")
    environment = os.environ | {"TMPDIR": str(tmp_path), "PYTHONPATH": str(Path(machine.__file__).parent)}
    command = [sys.executable, "-m", "pytest", "-v", str(tmp_path)]
    with Machine(tmp_path / f"softtissue-tests-{os.getuid()}").alone():
        run = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True)
        while run.poll() is None and not (tmp_path / "collected").exists():
            time.sleep(0.01)
        time.sleep(1.5)  # longer than any of its tests may take
        assert run.poll() is None
    shown = run.communicate(timeout=60.0)[0]
    assert run.returncode == 0, shown
    assert 0 < shown.index("test_ordinary PASSED") < shown.index("test_measuring PASSED")
