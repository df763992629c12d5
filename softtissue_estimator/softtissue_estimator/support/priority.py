"""Priority of a process that others must not wait for. Knows no ROS."""

import contextlib
import os
import sys
import time
from pathlib import Path

_THREADS = Path("/proc/self/task")
_GROUP = Path("/proc/self/autogroup")
_ATTEMPTS, _PAUSE_S = 5, 0.12  # Linux takes ten a second


def step_back(niceness: int) -> None:
    """Let other processes come first, with all threads that there are and those that they will start.

    A thread that already has a higher niceness keeps it: to take it back needs rights that nobody should need.

    Parameters
    ----------
    niceness : int
        0 changes nothing; 19 leaves the most to others.
    """
    if sys.platform != "linux":
        # Elsewhere a process has one niceness, and not each of its threads.
        os.nice(max(0, niceness - os.getpriority(os.PRIO_PROCESS, 0)))
        return
    for thread in _THREADS.iterdir():
        with contextlib.suppress(ProcessLookupError):  # it ended meanwhile
            if os.getpriority(os.PRIO_PROCESS, int(thread.name)) < niceness:
                os.setpriority(os.PRIO_PROCESS, int(thread.name), niceness)
    if niceness > 0 and os.getsid(0) == os.getpid():
        # Linux may share out its time among sessions first, whatever the niceness in each. Only who began a session,
        # as a service does, speaks for it: in a terminal's there may be the estimator, too.
        _step_session_back(niceness)


def _step_session_back(niceness: int) -> None:
    for _ in range(_ATTEMPTS):
        try:
            _GROUP.write_text(str(niceness), encoding="ascii")
            return
        except BlockingIOError:  # another process has just said its own
            time.sleep(_PAUSE_S)
        except OSError:  # a Linux without it
            return
