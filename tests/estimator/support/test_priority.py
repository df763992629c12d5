"""How far a process stands back."""

import os
import subprocess
import sys

import pytest

from softtissue_estimator.config import NICENESS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="threads have no niceness of their own here")

PROGRAM = """
import os, sys, threading
from pathlib import Path
from softtissue_estimator.support.priority import step_back

if "session" in sys.argv:
    os.setsid()
go_on = threading.Event()
threading.Thread(target=go_on.wait, daemon=True).start()
step_back(int(sys.argv[1]))
later = threading.Event()
threading.Thread(target=lambda: (later.set(), go_on.wait()), daemon=True).start()
later.wait()
print(sorted(os.getpriority(os.PRIO_PROCESS, int(t)) for t in os.listdir("/proc/self/task")))
group = Path("/proc/self/autogroup")
said = group.read_text().split() if group.exists() else []
print(said[-1] if said else "none")
step_back(0)
print(os.getpriority(os.PRIO_PROCESS, 0))
"""


def niceness_after(*arguments):
    """Of all threads, of the session, and after the process wanted to come forward again."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(str, arguments)], capture_output=True, text=True, check=True
    )
    threads, session, after = done.stdout.splitlines()
    return threads, session, int(after)


def test_all_threads_step_back_and_those_that_begin_later():
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert niceness_after(19)[0] == "[19, 19, 19]"
    assert niceness_after(0)[0] == str([own] * 3)
    assert niceness_after(NICENESS)[2] == max(own, NICENESS)


def test_session_steps_back_only_where_it_is_the_process_s_own():
    """Linux need not know sessions' niceness, and who began none reads an empty one."""
    assert niceness_after(17)[1] == niceness_after(0)[1]
    if niceness_after(0, "session")[1] == "none":
        pytest.skip("sessions have no niceness of their own")
    assert niceness_after(17, "session")[1] == "17"
    assert niceness_after(0, "session")[1] == "0"
