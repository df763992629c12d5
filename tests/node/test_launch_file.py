"""Launch file and RViz configuration, as far as they can be checked without launch and RViz."""

import ast
import dataclasses
import importlib.util
import os
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import write_organ
from node.stand_ins import Recorder, stand_in
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.transport import OLD_VARIABLE, VARIABLE

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
    actions = {n: type(n, (Recorder,), {}) for n in ("DeclareLaunchArgument", "OpaqueFunction")}
    stand_in(monkeypatch, "launch.actions", **actions)
    stand_in(monkeypatch, "launch.substitutions", LaunchConfiguration=LaunchConfiguration)
    stand_in(monkeypatch, "launch_ros")
    stand_in(monkeypatch, "launch_ros.actions", LifecycleNode=Recorder, Node=Recorder)
    source = PACKAGE / "launch" / "softtissue.launch.py"
    spec = importlib.util.spec_from_file_location("softtissue_launch", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def defaults(launch_file):
    described = launch_file.generate_launch_description()
    return {
        a.args[0]: a.keywords["default_value"] for a in described if type(a).__name__.startswith("Declare")
    }


def test_launch_file_passes_on_what_is_given(launch_file):
    given = {"organ": "/data/liver", "autostart": "False", "points": "/tracker/points", "use_sim_time": "1"}
    (node,) = launch_file.processes(defaults(launch_file) | given | {"name": "liver", "respawn": "Yes"})
    assert (node.keywords["package"], node.keywords["executable"]) == ("softtissue_estimator", "node")
    file, chosen = node.keywords["parameters"]
    assert Path(file).name == "softtissue_estimator.yaml" and Path(file).is_file()
    assert chosen == {"organ": "/data/liver", "autostart": False, "use_sim_time": True}
    assert (node.keywords["name"], node.keywords["respawn"]) == ("liver", True)
    assert node.keywords["arguments"] == ["--ros-args", "--log-level", "liver:=info"]
    assert dict(node.keywords["remappings"]) == {
        "surface_points": "/tracker/points",
        "correspondences": "correspondences",
        "registration": "registration",
        "registration_with_covariance": "registration_with_covariance",
    }


def test_overlay_draws_the_answers_of_the_node_on_the_cameras_images(launch_file):
    given = {
        "overlay": "true",
        "name": "liver",
        "namespace": "room_1",
        "image": "/scope/left",
        "use_sim_time": "1",
    }
    _, overlay = launch_file.processes(defaults(launch_file) | given)
    assert (overlay.keywords["executable"], overlay.keywords["namespace"]) == ("overlay", "room_1")
    file, chosen = overlay.keywords["parameters"]
    assert Path(file).name == "softtissue_overlay.yaml" and Path(file).is_file()
    assert chosen == {"estimator_node": "liver", "use_sim_time": True}
    assert dict(overlay.keywords["remappings"]) == {
        "image": "/scope/left",
        "image/compressed": "/scope/left/compressed",
        "camera_info": "camera_info",
        "instrument_mask": "instrument_mask",
        "correspondences": "correspondences",
        "registration": "registration",
        "registration_with_covariance": "registration_with_covariance",
    }


def test_viewer_shows_the_answers_of_the_node_and_the_points_that_it_hears(launch_file):
    given = {"viewer": "true", "name": "liver", "namespace": "room_1", "points": "/tracker/points"}
    given["image"] = "/scope/left"
    _, viewer = launch_file.processes(defaults(launch_file) | given)
    assert (viewer.keywords["executable"], viewer.keywords["namespace"]) == ("viewer", "room_1")
    file, chosen = viewer.keywords["parameters"]
    assert Path(file).name == "softtissue_viewer.yaml" and Path(file).is_file()
    assert chosen == {"estimator_node": "liver"}
    assert dict(viewer.keywords["remappings"]) == {
        "surface_points": "/tracker/points",
        "image": "/scope/left",
        "image/compressed": "/scope/left/compressed",
        "camera_info": "camera_info",
    }


def test_bridge_sends_the_answers_of_the_node(launch_file):
    given = {"igtl_bridge": "true", "name": "liver", "namespace": "room_1", "use_sim_time": "1"}
    _, bridge = launch_file.processes(defaults(launch_file) | given)
    assert (bridge.keywords["executable"], bridge.keywords["namespace"]) == ("igtl_bridge", "room_1")
    file, chosen = bridge.keywords["parameters"]
    assert Path(file).name == "softtissue_igtl_bridge.yaml" and Path(file).is_file()
    assert chosen == {"estimator_node": "liver", "use_sim_time": True}
    assert bridge.keywords["remappings"] == []


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"params": "/nowhere/p.yaml"},
            "params: expected a file of parameters, found none at /nowhere/p.yaml",
        ),
        ({"overlay": "true", "overlay_params": "/nowhere"}, "overlay_params: .* found none at /nowhere"),
        ({"viewer": "true", "viewer_params": "/nowhere"}, "viewer_params: .* found none at /nowhere"),
        (
            {"igtl_bridge": "true", "igtl_bridge_params": "/nowhere"},
            "igtl_bridge_params: .* found none at /nowhere",
        ),
        ({"autostart": "maybe"}, "autostart: expected true or false, got 'maybe'"),
        ({"rviz": "true"}, "rviz: expected rviz2 to be installed"),
    ],
)
def test_launch_file_refuses_before_anything_starts(launch_file, given, words):
    with pytest.raises(InvalidInputError, match=words):
        launch_file.processes(defaults(launch_file) | given)


def test_every_estimator_is_named_in_the_help(launch_file):
    assert "elastic, paper" in launch_file.PARAMETERS["estimator"]


def test_rviz_looks_where_the_node_publishes(launch_file, monkeypatch, tmp_path):
    organ = write_organ(tmp_path / "organ")
    text = (organ / "organ.yaml").read_text()
    (organ / "organ.yaml").write_text(text.replace("frame: organ", "frame: liver"))
    monkeypatch.setattr(launch_file, "get_package_prefix", lambda name: "/opt/ros")
    monkeypatch.setattr(launch_file.tempfile, "mkdtemp", lambda prefix: str(tmp_path))
    given = {"rviz": "true", "organ": str(organ), "namespace": "room_1", "name": "liver_node"}
    _, rviz = launch_file.processes(defaults(launch_file) | given)
    shown = yaml.safe_load(Path(rviz.keywords["arguments"][1]).read_text())["Visualization Manager"]
    assert shown["Global Options"]["Fixed Frame"] == "liver"
    assert {d["Topic"]["Value"] for d in shown["Displays"] if "Topic" in d} == {
        "/room_1/liver_node/markers",
        "/room_1/liver_node/deformed_points",
        "/room_1/liver_node/registration",
        "/room_1/surface_points",
    }


def test_transport_profile_of_the_user_stays(launch_file, monkeypatch):
    monkeypatch.setenv(OLD_VARIABLE, "/my/profile.xml")
    monkeypatch.delenv(VARIABLE, raising=False)
    launch_file.generate_launch_description()
    assert VARIABLE not in os.environ
    assert os.environ[OLD_VARIABLE] == "/my/profile.xml"


@pytest.mark.parametrize(("library", "variable"), [("libfastdds", VARIABLE), ("libfastrtps", OLD_VARIABLE)])
def test_transport_profile_is_set_as_each_distribution_reads_it(
    launch_file, monkeypatch, tmp_path, library, variable
):
    for name in (VARIABLE, OLD_VARIABLE):
        monkeypatch.setenv(name, "")  # so that what is set here is taken back
    (tmp_path / f"{library}.so.2").touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    launch_file.generate_launch_description()
    assert [name for name in (VARIABLE, OLD_VARIABLE) if os.environ[name]] == [variable]
