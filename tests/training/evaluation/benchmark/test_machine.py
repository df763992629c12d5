"""On what was measured, and what else it did."""

import os
import subprocess
import sys
from contextlib import ExitStack

from softtissue_training.evaluation.benchmark.machine import busy_cores


def test_a_program_that_computes_is_seen():
    with ExitStack() as stack:
        for _ in range(os.cpu_count()):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(busy.wait)
            stack.callback(busy.kill)
        assert 0.5 <= busy_cores() <= os.cpu_count() * 1.01
