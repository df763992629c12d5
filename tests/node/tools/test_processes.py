"""Processes that are started, and ended whatever happens."""

import signal
import subprocess
import sys
import threading

import pytest

from softtissue_estimator.ros.tools.processes import process

SLEEPER = [sys.executable, "-c", "import time; time.sleep(60)"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_process_starts_ends_that_process(monkeypatch, number):
    started = []

    def popen(*arguments, **keywords):
        started.append(real(*arguments, **keywords))
        signal.raise_signal(number)  # the process runs, and nobody knows it yet
        return started[-1]

    real = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", popen)
    before = signal.signal(number, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), process(SLEEPER):
            pytest.fail("the signal was lost")
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, before)
    assert [child.poll() for child in started] == [-signal.SIGTERM]


def test_a_process_that_does_not_start_leaves_the_handlers():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(FileNotFoundError), process(["/nowhere"]):
        pytest.fail("there is no such program")
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_thread_can_start_processes():
    codes = []

    def run():
        with process(SLEEPER) as child:
            codes.append(child.poll())
        codes.append(child.poll())

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(20.0)
    assert codes == [None, -signal.SIGTERM]
