"""Which DDS profile is used."""

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
