"""The organ leaves the view of a running node for a second: no answers, and it is found where it comes back."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.losing import run


def test_the_organ_is_lost_and_found_again(tmp_path):
    found = run("given", 1.0, 1.8, tmp_path, last_s=2.4, step=True)
    assert (found.answered_without, found.noticed_s) == (0, 0.0)
    assert found.reasons and all(reason.startswith("cloud: expected") for reason in found.reasons)
    assert found.found_again_s is not None and found.found_again_s <= 5.0
