"""What was freed goes back to the system, and all threads take from the same pool."""

import subprocess
import sys
import threading
import weakref
from pathlib import Path

import pytest

from softtissue_estimator.support.memory import gone

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


POOLS = """
import sys, threading
from pathlib import Path
from softtissue_estimator.support.memory import one_pool
from memory_pools import pools_of

if sys.argv[1] == "one":
    one_pool()
together = threading.Barrier(4)

def work():
    held = [bytes(50_000) for _ in range(100)]
    together.wait(10.0)
    del held

threads = [threading.Thread(target=work) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(pools_of("self"))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="asks the C library of Linux")
@pytest.mark.parametrize(("chosen", "fewest", "most"), [("one", 0, 0), ("several", 2, 4)])
def test_threads_take_from_one_pool(chosen, fewest, most):
    path = f"import sys; sys.path.append({str(Path(__file__).parents[2])!r})\n"
    done = subprocess.run(
        [sys.executable, "-c", path + POOLS, chosen], check=True, capture_output=True, text=True
    )
    assert fewest <= int(done.stdout) <= most


class Thing:
    """Something that can be referred to weakly."""


def test_a_thing_is_gone_when_the_last_reference_is():
    things = [Thing()]
    thing = weakref.ref(things[0])
    assert not gone(thing, 0.0)
    threading.Timer(0.05, things.clear).start()
    assert gone(thing, 10.0)
