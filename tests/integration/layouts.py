"""What the layouts of RViz and Foxglove show: topics with the types that each display takes, and fields of messages."""

import json
import re
from pathlib import Path

import yaml

PACKAGE = Path(__file__).parents[2] / "softtissue_estimator"
CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
POSE, IMAGE = "geometry_msgs/msg/PoseWithCovarianceStamped", "sensor_msgs/msg/Image"
RVIZ = {"MarkerArray": {MARKERS}, "PointCloud2": {CLOUD}, "PoseWithCovariance": {POSE}}
ANY_3D = {MARKERS, CLOUD, POSE}
_PATH = re.compile(r"(?P<topic>(?:/\w+)+)\.(?P<field>\w+)(?P<all>\[:\])?")


def rviz_layout():
    """Return the part of RViz's configuration that says what is shown."""
    return yaml.safe_load((PACKAGE / "rviz" / "softtissue.rviz").read_text())["Visualization Manager"]


def foxglove_layout():
    return json.loads((PACKAGE / "foxglove" / "softtissue.json").read_text())


def rviz_topics():
    """Return the types that the displays take of each topic."""
    shown = (display for display in rviz_layout()["Displays"] if "Topic" in display)
    return {one["Topic"]["Value"]: RVIZ[one["Class"].removeprefix("rviz_default_plugins/")] for one in shown}


def foxglove_topics():
    """Return the types that the panels take of each topic, and the fields (topic, name, whether all elements)."""
    topics, fields = {}, []
    for name, panel in foxglove_layout()["configById"].items():
        match name.split("!")[0]:
            case "3D":
                topics |= dict.fromkeys(panel["topics"], ANY_3D)
            case "Image":
                topics[panel["imageMode"]["imageTopic"]] = {IMAGE}
            case "Plot" | "StateTransitions":
                fields += [path["value"] for path in panel["paths"]]
            case "RawMessages":
                fields.append(panel["topicPath"])
            case "DiagnosticSummary":
                topics[panel["topicToRender"]] = {"diagnostic_msgs/msg/DiagnosticArray"}
            case other:
                raise AssertionError(f"unknown panel {other}")
    found = [_PATH.fullmatch(field) for field in fields]
    assert all(found), fields
    return topics, [(one["topic"], one["field"], bool(one["all"])) for one in found]


def placed_panels(layout):
    """Return the panels that a layout of Foxglove has a place for."""
    if isinstance(layout, str):
        return [layout]
    assert layout["direction"] in ("row", "column") and 0 < layout["splitPercentage"] < 100
    return placed_panels(layout["first"]) + placed_panels(layout["second"])
