"""Two signals at any moment: exit code 0, soon, and nothing left (`signal_pairs.py` tries as many as one likes)."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.signal_pairs import try_pairs

PAIRS = int(os.environ.get("SIGNAL_PAIRS", "3"))


@pytest.mark.timeout(60 + 30 * PAIRS)
def test_pairs_of_signals_end_the_node_in_order(tmp_path):
    wrong = [ending for ending in try_pairs(PAIRS, tmp_path, seed=1) if not ending.as_wanted]
    assert not wrong


def program(body: str) -> list[str]:
    return [
        sys.executable,
        "-c",
        textwrap.dedent("from softtissue_estimator.ros.runtime import *\n") + textwrap.dedent(body),
    ]


def test_a_storm_of_signals_is_one_request():
    body = """
    stop = StopRequest()
    print("ready", flush=True)
    stop.event.wait()
    leave(stop.exit_code)
    """
    for _ in range(4):
        with subprocess.Popen(program(body), stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout.readline() == "ready\n"
            for _ in range(50):
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
            assert process.wait(5.0) == 0


def test_program_that_cannot_stop_ends_at_last():
    body = """
    stop = StopRequest(0.5)
    stop.begin()
    print("ready", flush=True)
    while True:
        time.sleep(0.01)
    """
    with subprocess.Popen(program(body), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        began = time.monotonic()
        assert process.wait(5.0) == 0
        assert time.monotonic() - began < 2.0


def test_program_whose_main_thread_is_stuck_in_a_library_ends_in_order():
    body = """
    import ctypes
    stop = StopRequest(0.3)
    stop.begin()
    mutex = ctypes.create_string_buffer(64)
    lock = ctypes.CDLL(None).pthread_mutex_lock
    lock(mutex)
    print("ready", flush=True)
    lock(mutex)  # for ever; no signal ends it, and no handler can run
    """
    with subprocess.Popen(program(body), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(15.0) == 0


def test_program_whose_libraries_keep_pythons_lock_ends_and_says_where():
    body = """
    import ctypes
    stop = StopRequest(0.3)
    stop.begin()
    print("ready", flush=True)
    stop.event.wait()
    ctypes.PyDLL(None).sleep(60)
    """
    with subprocess.Popen(
        program(body), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(15.0) == 1
        assert "most recent call first" in process.stderr.read()


def test_program_that_still_imports_ends_at_once():
    body = """
    stop = StopRequest(60.0)
    print("ready", flush=True)
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        pass
    stop.begin()
    """
    with subprocess.Popen(program(body), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        began = time.monotonic()
        assert process.wait(30.0) == 0
        assert time.monotonic() - began < 5.0


def test_program_asked_to_end_while_it_imported_does_not_begin():
    body = """
    stop = StopRequest()
    os.kill(os.getpid(), signal.SIGTERM)
    stop.begin()
    print("begun", flush=True)
    """
    with subprocess.Popen(program(body), stdout=subprocess.PIPE, text=True) as process:
        assert process.wait(30.0) == 0
        assert process.stdout.read() == ""
