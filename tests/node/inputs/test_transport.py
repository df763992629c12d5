"""Which DDS profile is used, and how Fast DDS is told of it."""

import os
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_estimator.ros.inputs import transport


@pytest.mark.parametrize(
    ("free_mb", "name"), [(24_000, "fastdds_profile.xml"), (64, "fastdds_profile_small.xml")]
)
def test_profile_fits_the_shared_memory(free_mb, name):
    assert transport.choose_profile(free_mb * 2**20).name == name


def test_users_own_profile_is_left_alone(monkeypatch):
    monkeypatch.setenv(transport.VARIABLE, "/somewhere/else.xml")
    assert "/somewhere/else.xml" in transport.use_profile()


def test_variable_is_one_that_the_library_of_this_environment_reads():
    folders = [Path(folder) for folder in os.environ["LD_LIBRARY_PATH"].split(":")]
    libraries = [path for folder in folders for path in folder.glob("libfast[rd]*s.so")]
    assert len(libraries) == 1
    read = [name for name in transport.LIBRARIES if name.encode() in libraries[0].read_bytes()]
    assert transport.profile_variable() == read[0]


@pytest.mark.parametrize(("variable", "library"), transport.LIBRARIES.items())
def test_library_is_looked_for_beside_the_packages_too(monkeypatch, tmp_path, variable, library):
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / f"{library}.3.2").touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", "")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert transport.profile_variable() == variable


def test_without_a_library_the_variable_is_that_of_today(monkeypatch):
    monkeypatch.setenv("LD_LIBRARY_PATH", "")
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/nowhere")
    assert transport.profile_variable() == transport.VARIABLE
