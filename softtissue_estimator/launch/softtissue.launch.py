"""Start the estimator, and overlay, viewer, bridge to 3D Slicer and RViz if asked, on a full ROS 2 installation.

ros2 launch softtissue_estimator softtissue.launch.py organ:=/data/my_liver points:=/tracker/points rviz:=true
"""

import tempfile
from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node

from launch import LaunchContext, LaunchDescription
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import estimator_names
from softtissue_estimator.organ.organ_file import read_organ_file
from softtissue_estimator.ros.inputs.transport import use_profile
from softtissue_estimator.support.resources import bundled_organ

PACKAGE = "softtissue_estimator"
# Parameters of the node: empty means as in the file of parameters.
PARAMETERS = {
    "organ": "organ folder",
    "estimator": f"{', '.join(estimator_names())} or a registered one",
    "checkpoint": "network weights (safetensors)",
    "device": "auto, cuda or cpu",
    "autostart": "true or false: configure and activate without being asked",
    "use_sim_time": "true or false: take the time from /clock",
}
# Arguments and the topics that they rename.
TOPICS = {
    "points": ("surface_points", "tracked points of the surface"),
    "correspondences": ("correspondences", "where they were on the preoperative surface"),
    "registration": ("registration", "rigid pose of the organ"),
    "registration_with_covariance": ("registration_with_covariance", "the same with its covariance"),
}
# Of the overlay and the viewer, and the topics of the camera that they rename.
IMAGES = {
    "image": (
        "image",
        "for overlay and viewer: the camera's images; compressed ones are on IMAGE/compressed",
    ),
    "camera_info": ("camera_info", "for overlay and viewer: how the camera maps"),
}
# Of the overlay alone.
MASKS = {
    "instrument_mask": ("instrument_mask", "for the overlay: where instruments are, which nothing covers")
}
TRUE, FALSE = ("true", "1", "yes", "on"), ("false", "0", "no", "off")


def share() -> Path:
    """Return the package's share folder."""
    return Path(get_package_share_directory(PACKAGE))


def truth(name: str, text: str) -> bool:
    """Read a yes or no in any spelling.

    Raises
    ------
    InvalidInputError
        If it is neither.
    """
    if text.strip().lower() not in TRUE + FALSE:
        raise InvalidInputError(f"argument {name}: expected true or false, got {text!r}")
    return text.strip().lower() in TRUE


def chosen_parameters(given: dict[str, str]) -> dict[str, Any]:
    """Return the parameters of the node that were given."""
    chosen: dict[str, Any] = {name: given[name] for name in PARAMETERS if given[name]}
    for name in ("autostart", "use_sim_time"):
        if name in chosen:
            chosen[name] = truth(name, chosen[name])
    return chosen


def rviz_configuration(given: dict[str, str]) -> Path:
    """Write RViz's configuration for the node's name and namespace, the topic of points and the organ's frame."""
    displays = yaml.safe_load((share() / "rviz" / "softtissue.rviz").read_text(encoding="utf-8"))
    manager = displays["Visualization Manager"]
    organ = Path(given["organ"]) if given["organ"] else bundled_organ()
    manager["Global Options"]["Fixed Frame"] = read_organ_file(organ).frame
    namespace = f"/{given['namespace'].strip('/')}".rstrip("/")
    points = given["points"] if given["points"].startswith("/") else f"{namespace}/{given['points']}"
    for display in manager["Displays"]:
        topic = display.get("Topic", {})
        if topic.get("Value") == "/surface_points":
            topic["Value"] = points
        elif "Value" in topic:
            own = topic["Value"].removeprefix(f"/{PACKAGE}/")
            topic["Value"] = f"{namespace}/{given['name']}/{own}"
    path = Path(tempfile.mkdtemp(prefix="softtissue_rviz_")) / "softtissue.rviz"
    path.write_text(yaml.safe_dump(displays), encoding="utf-8")
    return path


def overlay(given: dict[str, str]) -> Node:
    """Describe the overlay, which draws the answers of the node on a camera's images."""
    topics = {topic: given[name] for name, (topic, _) in (TOPICS | MASKS).items() if name != "points"}
    return listener("overlay", given, topics | images(given))


def viewer(given: dict[str, str]) -> Node:
    """Describe the viewer, which shows the answers of the node and the points that were observed on a live page."""
    return listener("viewer", given, {"surface_points": given["points"]} | images(given))


def igtl_bridge(given: dict[str, str]) -> Node:
    """Describe the bridge, which sends the answers of the node to 3D Slicer."""
    return listener("igtl_bridge", given, {})


def images(given: dict[str, str]) -> dict[str, str]:
    """Return the topics of the camera and what they are renamed to."""
    topics = {topic: given[name] for name, (topic, _) in IMAGES.items()}
    return topics | {"image/compressed": f"{given['image']}/compressed"}


def listener(executable: str, given: dict[str, str], topics: dict[str, str]) -> Node:
    """Describe a process that hears what the node says; `topics` are those of its own that have other names."""
    chosen: dict[str, Any] = {"estimator_node": given["name"]}
    if given["use_sim_time"]:
        chosen["use_sim_time"] = truth("use_sim_time", given["use_sim_time"])
    return Node(
        package=PACKAGE,
        executable=executable,
        namespace=given["namespace"],
        output="screen",
        respawn=truth("respawn", given["respawn"]),
        parameters=[given[f"{executable}_params"], chosen],
        remappings=[*topics.items()],
    )


# Processes that hear what the node says, by the argument that starts them; NAME_params is their file of parameters.
LISTENERS = {"overlay": overlay, "viewer": viewer, "igtl_bridge": igtl_bridge}


def processes(context: LaunchContext) -> list[Node]:
    """Describe the processes from the arguments as given; whatever is wrong is said before one of them starts."""
    names = (
        *PARAMETERS,
        *TOPICS,
        *IMAGES,
        *MASKS,
        "params",
        "namespace",
        "name",
        "log_level",
        "respawn",
        "rviz",
    )
    names = (*names, *LISTENERS, *(f"{name}_params" for name in LISTENERS))
    given = {name: LaunchConfiguration(name).perform(context) for name in names}
    for name in ("params", *(f"{name}_params" for name in LISTENERS)):
        if not Path(given[name]).is_file():
            raise InvalidInputError(
                f"argument {name}: expected a file of parameters, found none at {given[name]}"
            )
    described: list[Node] = [
        LifecycleNode(
            package=PACKAGE,
            executable="node",
            name=given["name"],
            namespace=given["namespace"],
            output="screen",
            respawn=truth("respawn", given["respawn"]),
            parameters=[given["params"], chosen_parameters(given)],
            remappings=[(topic, given[name]) for name, (topic, _) in TOPICS.items()],
            arguments=["--ros-args", "--log-level", f"{given['name']}:={given['log_level']}"],
        )
    ]
    described += [describe(given) for name, describe in LISTENERS.items() if truth(name, given[name])]
    if truth("rviz", given["rviz"]):
        try:
            get_package_prefix("rviz2")
        except PackageNotFoundError:
            raise InvalidInputError("argument rviz: expected rviz2 to be installed, got none") from None
        configuration = str(rviz_configuration(given))
        described.append(
            Node(package="rviz2", executable="rviz2", name="rviz2", arguments=["-d", configuration])
        )
    return described


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments, and the processes that follow from them."""
    # Large clouds need a transport profile at both ends; the node sets it for itself, RViz does not.
    use_profile()
    actions = [DeclareLaunchArgument(n, default_value="", description=text) for n, text in PARAMETERS.items()]
    actions += [
        DeclareLaunchArgument(name, default_value=topic, description=text)
        for name, (topic, text) in (TOPICS | IMAGES | MASKS).items()
    ]
    others = {
        "params": (str(share() / "config" / "softtissue_estimator.yaml"), "YAML file of parameters"),
        "namespace": ("", "namespace of the node and its topics"),
        "name": (PACKAGE, "name of the node"),
        "log_level": ("info", "debug, info, warn, error or fatal"),
        "respawn": ("false", "start the node again when it ends"),
        "rviz": ("false", "start RViz too"),
        "overlay": ("false", "start the overlay too"),
        "overlay_params": (
            str(share() / "config" / "softtissue_overlay.yaml"),
            "YAML file of the overlay's parameters",
        ),
        "viewer": ("false", "start the viewer too: a live page at http://127.0.0.1:8080"),
        "viewer_params": (
            str(share() / "config" / "softtissue_viewer.yaml"),
            "YAML file of the viewer's parameters",
        ),
        "igtl_bridge": ("false", "start the bridge to 3D Slicer too: OpenIGTLink on port 18944"),
        "igtl_bridge_params": (
            str(share() / "config" / "softtissue_igtl_bridge.yaml"),
            "YAML file of the bridge's parameters",
        ),
    }
    actions += [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in others.items()
    ]
    return LaunchDescription([*actions, OpaqueFunction(function=processes)])
