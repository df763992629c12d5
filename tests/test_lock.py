"""The lock files hold what is installed at run time, in the versions of constraints.txt, with a hash for every file."""

import re
from importlib.metadata import version

import pytest
from packaging.version import Version

from installed_packages import ROOT, RUN_TIME, VIEWER, named, needed, pinned

pytestmark = pytest.mark.skipif(
    not version("torch").endswith("+cpu"), reason="lock files are those of PyTorch's CPU build"
)
LOCKS = {file: file.replace(".txt", ".lock") for file in (*RUN_TIME, VIEWER)}
JAZZY = "requirements-jazzy.lock"
CONSTRAINTS = pinned("constraints.txt")


@pytest.mark.parametrize("lock", LOCKS.values())
def test_lock_has_the_versions_of_the_constraints(lock):
    locked = {name: Version(pin).public for name, pin in pinned(lock).items()}
    assert len(locked) > (10 if lock == LOCKS[VIEWER] else 30)
    assert locked == {name: CONSTRAINTS.get(name) for name in locked}, "run scripts/lock"


def test_other_distribution_has_its_own_ros_and_the_versions_of_the_constraints_for_all_else():
    locked, wanted = pinned(JAZZY), pinned(JAZZY.replace(".lock", ".txt"))
    assert wanted["ros-rclpy"] != CONSTRAINTS["ros-rclpy"]
    assert {name: locked.get(name) for name in wanted} == wanted, "run scripts/lock"
    others = {name: pin for name, pin in locked.items() if not name.startswith("ros-")}
    assert len(others) > 30
    assert others == {name: CONSTRAINTS.get(name) for name in others}, "run scripts/lock"


@pytest.mark.parametrize("requirements", LOCKS)
def test_lock_holds_what_is_installed_and_no_more(requirements):
    assert set(pinned(LOCKS[requirements])) == needed(named(requirements)), "run scripts/lock"


@pytest.mark.parametrize("lock", [*LOCKS.values(), JAZZY])
def test_every_package_has_hashes_and_no_place_is_named(lock):
    text = (ROOT / lock).read_text(encoding="utf-8")
    entry = r"[\w.-]+(?:\[[\w,-]+\])?==\S+(?: \\\n    --hash=sha256:[0-9a-f]{64})+\n"
    assert re.fullmatch(rf"# .*\n(?:{entry})+", text)


def test_torch_is_the_cpu_build_and_nothing_of_cuda_is_locked():
    locked = pinned(LOCKS["requirements.txt"])
    assert locked["torch"].endswith("+cpu")
    assert [name for name in locked if re.match("nvidia|cuda|triton", name)] == []


@pytest.mark.parametrize("other", [LOCKS["requirements-ros.txt"], JAZZY, LOCKS[VIEWER]])
def test_what_both_locks_hold_is_the_same_so_that_they_install_together(other):
    """Pip takes only the hashes that both name."""
    entries = re.compile(r"^(\S+) \\\n((?: +--hash=\S+(?: \\)?\n)+)", re.MULTILINE)
    locks = (LOCKS["requirements.txt"], other)
    both = [dict(entries.findall((ROOT / lock).read_text(encoding="utf-8"))) for lock in locks]
    shared = both[0].keys() & both[1].keys()
    assert any(pin.startswith("numpy==") for pin in shared)
    assert {pin: both[0][pin] for pin in shared} == {pin: both[1][pin] for pin in shared}
