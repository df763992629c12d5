"""A short soak: counts balance, answers bear their organ's name, and another organ makes no gap (`make soak`)."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.soak import Plan, soak

# Organs are loaded without a pause, on cores that other tests may share; the target of 0.5 s is that of `make soak`.
MOST_GAP_S = 1.5


@pytest.mark.alone
@pytest.mark.timeout(240)
def test_another_organ_makes_no_gap(tmp_path):
    result = soak(
        Plan(seconds=6.0, rate=2.0, load_every_s=1.0, least_loads=2, longest_gap_s=MOST_GAP_S), tmp_path
    )
    assert result.wrong() == []
