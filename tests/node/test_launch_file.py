"""Launch file and RViz configuration, as far as they can be checked without launch and RViz."""

import ast
import dataclasses
import importlib.util
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from node.stand_ins import Recorder, stand_in
from softtissue_estimator.config import EstimatorConfig

PACKAGE = Path(__file__).parents[2] / "softtissue_estimator"


def test_launch_file_and_rviz_configuration_are_well_formed():
    # Neither launch nor RViz is on PyPI: what can be checked without them is.
    tree = ast.parse((PACKAGE / "launch" / "softtissue.launch.py").read_text())
    assert any(isinstance(n, ast.FunctionDef) and n.name == "generate_launch_description" for n in tree.body)
    names = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    for topic in ("surface_points", "correspondences", "registration", "registration_with_covariance"):
        assert topic in names
    assert {f.name for f in dataclasses.fields(EstimatorConfig)} >= {
        "organ",
        "estimator",
        "checkpoint",
        "device",
    }
    displays = yaml.safe_load((PACKAGE / "rviz" / "softtissue.rviz").read_text())["Visualization Manager"]
    assert displays["Global Options"]["Fixed Frame"] == "organ"
    topics = {d["Topic"]["Value"] for d in displays["Displays"] if "Topic" in d}
    assert topics == {
        "/softtissue_estimator/markers",
        "/softtissue_estimator/deformed_points",
        "/softtissue_estimator/registration",
        "/surface_points",
    }


@pytest.fixture
def launch_file(monkeypatch):
    """The launch file as a module, with stand-ins for launch and launch_ros."""

    class LaunchConfiguration(Recorder):
        def perform(self, context):
            return context[self.args[0]]

    stand_in(monkeypatch, "launch", LaunchContext=dict, LaunchDescription=list)
    actions = {
        n: type(n, (Recorder,), {})
        for n in ("DeclareLaunchArgument", "OpaqueFunction", "SetEnvironmentVariable")
    }
    stand_in(monkeypatch, "launch.actions", **actions)
    stand_in(monkeypatch, "launch.conditions", IfCondition=Recorder)
    stand_in(monkeypatch, "launch.substitutions", LaunchConfiguration=LaunchConfiguration)
    stand_in(monkeypatch, "launch_ros")
    stand_in(monkeypatch, "launch_ros.actions", LifecycleNode=Recorder, Node=Recorder)
    source = PACKAGE / "launch" / "softtissue.launch.py"
    spec = importlib.util.spec_from_file_location("softtissue_launch", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_launch_file_passes_on_what_is_given(launch_file):
    described = launch_file.generate_launch_description()
    declared = {
        a.args[0]: a.keywords["default_value"] for a in described if type(a).__name__.startswith("Declare")
    }
    given = declared | {"organ": "/data/liver", "autostart": "False", "surface_points": "/tracker/points"}
    (node,) = launch_file.estimator(given)
    assert (node.keywords["package"], node.keywords["executable"]) == ("softtissue_estimator", "node")
    file, chosen = node.keywords["parameters"]
    assert Path(file).name == "softtissue_estimator.yaml" and Path(file).is_file()
    assert chosen == {"organ": "/data/liver", "autostart": False}
    assert dict(node.keywords["remappings"]) == {
        "surface_points": "/tracker/points",
        "correspondences": "correspondences",
        "registration": "registration",
        "registration_with_covariance": "registration_with_covariance",
    }
    rviz = Path(described[-1].keywords["arguments"][1])
    assert rviz.is_file()
