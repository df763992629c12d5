"""What was freed goes back to the system."""

import subprocess
import sys

import pytest

PROGRAM = """
from pathlib import Path
from softtissue_estimator.support.memory import give_back

def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

# Too small for pages of their own; one at the end keeps all before it from being returned.
held = [bytes(50_000) for _ in range(4000)]
last = held[-1]
before = resident_mb()
del held
kept = resident_mb()
give_back()
print(before - kept, before - resident_mb())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="asks the C library of Linux")
def test_what_was_freed_goes_back():
    done = subprocess.run([sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True)
    at_once, in_all = map(float, done.stdout.split())
    assert in_all > 150.0
    assert at_once < in_all - 50.0, "there was something to give back"
