"""What all tests share: a cache and a ROS domain that are not the user's, data that others recorded."""

import os
from pathlib import Path

import pytest

from alone import AlonePlugin
from recorded_data import RECORDED
from ros_domain import environment_of, reserved

MOST_WORKERS = 4  # each takes a gigabyte of memory


def pytest_xdist_auto_num_workers(config):
    """With `-n auto`: as many processes as there are cores; one for a single file, or to show what tests print."""
    one_file = len(config.args) == 1 and not Path(config.args[0]).is_dir()
    cores = len(os.sched_getaffinity(0))
    return 0 if one_file or cores == 1 or config.option.capture == "no" else min(cores, MOST_WORKERS)


def pytest_configure(config):
    config.pluginmanager.register(AlonePlugin(config))
    if config.getoption("numprocesses", None):
        # For the processes to come: beside each other they would only wait for each other's threads.
        os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(autouse=True, scope="session")
def _own_surroundings(tmp_path_factory):
    """Caches in a folder of the run, which all its processes share, and a ROS domain for this process."""
    folder = tmp_path_factory.getbasetemp()
    cache = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "cache"
    with reserved() as domain, pytest.MonkeyPatch.context() as patch:
        for name, value in {"XDG_CACHE_HOME": str(cache), **environment_of(domain)}.items():
            patch.setenv(name, value)
        yield


@pytest.fixture(scope="session")
def test_data() -> Path:
    """Folder with organs and clouds that others recorded; the test is skipped without it."""
    if not RECORDED.is_dir():
        pytest.skip(f"no test data in {RECORDED} (set SOFTTISSUE_TEST_DATA)")
    return RECORDED
