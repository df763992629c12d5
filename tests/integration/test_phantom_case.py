"""A case of the phantom experiment, replayed as a bag through the node: the same errors as offline."""

import json
import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from ros_domain import environment_of
from softtissue_training.evaluation.methods import parse_methods
from softtissue_training.experiments.phantom.case import load_phantom_case
from softtissue_training.experiments.phantom.case_bag import write_case_bag
from softtissue_training.experiments.phantom.experiment import content_of, run_phantom
from training.phantom_cases import write_case

DEMO = [sys.executable, "-m", "softtissue_estimator.ros.tools.demo"]


@pytest.mark.timeout(300)
def test_node_and_offline_errors_of_a_case_are_the_same(tmp_path, domain):
    # The 13 correspondences are spread over the surface; what that says comes with its own standard deviations.
    case = load_phantom_case(write_case(tmp_path / "case", correspondences=13, coarse=True))
    run = run_phantom(case, parse_methods("elastic"))
    offline = content_of(run, "test")["estimators"]["elastic"]
    write_case_bag(tmp_path / "bag", run, frames=12)
    out = tmp_path / "out"
    arguments = ["--bag", str(tmp_path / "bag"), "--organ", str(tmp_path / "case"), "--out", str(out)]
    arguments += ["--estimator", "elastic", "--parameter", "tracking:=false"]
    environment = os.environ | environment_of(domain)
    result = subprocess.run([*DEMO, *arguments], env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    report = json.loads((out / "report.json").read_text())["tre_mm"]
    assert report["before"]["mean"] == pytest.approx(offline["tre_mm"]["before"]["mean"], abs=1e-3)
    assert report["after"]["mean"] == pytest.approx(offline["tre_mm"]["after"]["mean"], abs=0.1)
    assert report["after"]["max"] == pytest.approx(offline["tre_mm"]["after"]["max"], abs=0.1)
    for marker, entry in zip(report["markers"], offline["markers"].values(), strict=True):
        assert marker["after"]["mean"] == pytest.approx(entry["after_mm"], abs=0.1)
    assert offline["tre_mm"]["after"]["mean"] < 0.5 * offline["tre_mm"]["before"]["mean"]
    assert (out / "phantom.png").read_bytes().startswith(b"\x89PNG")
