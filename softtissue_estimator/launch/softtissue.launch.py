"""Start the estimator, and RViz if asked, on a full ROS 2 installation.

ros2 launch softtissue_estimator softtissue.launch.py organ:=/data/my_liver points:=/tracker/points rviz:=true
"""

import os
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node

from launch import LaunchContext, LaunchDescription

PACKAGE = "softtissue_estimator"
# Parameters of the node: empty means as in the file of parameters.
PARAMETERS = {
    "organ": "organ folder",
    "estimator": "elastic or paper",
    "checkpoint": "network weights (safetensors)",
    "device": "auto, cuda or cpu",
    "autostart": "true or false: configure and activate without being asked",
}
TOPICS = {
    "surface_points": "tracked points of the surface",
    "correspondences": "where they were on the preoperative surface",
    "registration": "rigid pose of the organ",
    "registration_with_covariance": "the same with its covariance",
}


def share() -> Path:
    """Return the package's share folder."""
    return Path(get_package_share_directory(PACKAGE))


def estimator(context: LaunchContext) -> list[LifecycleNode]:
    """Describe the node from the arguments as given."""
    given = {
        name: LaunchConfiguration(name).perform(context)
        for name in (*PARAMETERS, *TOPICS, "params", "namespace")
    }
    chosen = {name: given[name] for name in PARAMETERS if given[name]}
    if "autostart" in chosen:
        chosen["autostart"] = chosen["autostart"].lower() == "true"
    return [
        LifecycleNode(
            package=PACKAGE,
            executable="node",
            name=PACKAGE,
            namespace=given["namespace"],
            output="screen",
            parameters=[given["params"], chosen],
            remappings=[(topic, given[topic]) for topic in TOPICS],
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the processes and their arguments."""
    actions = [DeclareLaunchArgument(n, default_value="", description=text) for n, text in PARAMETERS.items()]
    actions += [DeclareLaunchArgument(n, default_value=n, description=text) for n, text in TOPICS.items()]
    actions += [
        DeclareLaunchArgument(
            "params",
            default_value=str(share() / "config" / "softtissue_estimator.yaml"),
            description="YAML file of parameters",
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="namespace of the node and its topics"
        ),
        DeclareLaunchArgument("rviz", default_value="false", description="start RViz too"),
    ]
    if not os.environ.get("FASTDDS_DEFAULT_PROFILES_FILE"):
        # Large clouds need it at both ends; the node sets it for itself, RViz does not.
        profile = str(share() / "config" / "fastdds_profile.xml")
        actions.append(SetEnvironmentVariable("FASTDDS_DEFAULT_PROFILES_FILE", profile))
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        name="rviz2",
        arguments=["-d", str(share() / "rviz" / "softtissue.rviz")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*actions, OpaqueFunction(function=estimator), rviz])
