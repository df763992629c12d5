"""The node's parameters, derived from `EstimatorConfig`: one place for names, types, ranges and descriptions."""

import dataclasses
import sys
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import check_estimator
from softtissue_estimator.ros.command_line import NODE, Program, check_parameters, given_directly
from softtissue_estimator.ros.inputs.topic_quality import check_quality

# Read anew for every cloud, so they may change while the node works. Everything else goes into what is loaded.
LIVE = frozenset(
    {
        "matching",
        "organ_label",
        "viewpoint",
        "default_sigma_m",
        "max_displacement_m",
        "max_reference_distance_m",
        "minimum_points",
        "minimum_visible_fraction",
        "maximum_rejected_fraction",
        "maximum_sigma_m",
        "frame_budget_s",
        "no_data_timeout_s",
        "registration_source",
        "tf_timeout_s",
        "registration_max_age_s",
    }
)

# Given at the start by whoever starts the node, and by nobody on the ROS graph.
FIXED = frozenset({"autostart", "organ_root", "use_tf"})

# A node answers a stream, a library one observation at a time.
NODE_DEFAULTS = {"tracking": True}


def descriptor(field: "dataclasses.Field[Any]") -> ParameterDescriptor:
    """Describe one field of `EstimatorConfig` as ROS tools show it."""
    message = described(field, read_only=field.name in FIXED)
    if field.name not in LIVE | FIXED:
        message.description += " Can only be changed while the node is unconfigured."
    return message


def described(field: "dataclasses.Field[Any]", read_only: bool) -> ParameterDescriptor:
    """Describe one field of settings: its meaning, unit, choices and range."""
    unit, choices, limits = (field.metadata[key] for key in ("unit", "choices", "range"))
    text = field.metadata["description"]
    text += f" Unit: {unit}." if unit else ""
    message = ParameterDescriptor(name=field.name, description=text, read_only=read_only)
    message.type = Parameter.Type.from_parameter_value(_as_ros(field.default)).value
    if choices is not None:
        message.additional_constraints = f"One of: {', '.join(choices)}"
    if limits is not None and isinstance(field.default, int):
        message.integer_range = [IntegerRange(from_value=int(limits[0]), to_value=int(limits[1]), step=1)]
    elif limits is not None:
        message.floating_point_range = [
            FloatingPointRange(from_value=float(limits[0]), to_value=float(limits[1]), step=0.0)
        ]
    return message


def declare_parameters(node: Node) -> None:
    """Declare a parameter for every field of `EstimatorConfig`.

    Raises
    ------
    InvalidInputError
        If a value given at the start is of the wrong type or outside its range, or of a parameter that is misspelt.
    """
    warn_of_unknown(node, NODE)
    given = {name: parameter.value for name, parameter in node._parameter_overrides.items()}
    check_quality(given, node.resolve_topic_name, given_directly(sys.argv))
    for field in dataclasses.fields(EstimatorConfig):
        declare(node, NODE_DEFAULTS.get(field.name, field.default), descriptor(field))


def warn_of_unknown(node: Node, program: Program) -> None:
    """Log a warning for each parameter given at the start that the node does not have.

    Raises
    ------
    InvalidInputError
        If one is misspelt.
    """
    for sentence in check_parameters(node._parameter_overrides, sys.argv, program):
        node.get_logger().warning(sentence)


def declare(node: Node, default: Any, described_as: ParameterDescriptor) -> None:
    """Declare a parameter.

    Raises
    ------
    InvalidInputError
        If the value given at the start is of the wrong type or outside its range.
    """
    try:
        node.declare_parameter(described_as.name, _as_ros(default), described_as)
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        # rclpy's sentences say what was expected and what was given.
        raise InvalidInputError(f"parameter {described_as.name}: {error}") from None


def read_config(node: Node) -> EstimatorConfig:
    """Read the parameters as one checked value.

    Raises
    ------
    InvalidInputError
        If a value cannot be used.
    """
    names = [field.name for field in dataclasses.fields(EstimatorConfig)]
    return EstimatorConfig(**{name: _from_ros(node.get_parameter(name).value) for name in names})


def _as_ros(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _from_ros(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def changed_config(config: EstimatorConfig, changes: list[Parameter], configured: bool) -> EstimatorConfig:
    """Return the configuration after a change of parameters.

    Raises
    ------
    InvalidInputError
        If a value cannot be used, or cannot be changed because the node is configured.
    """
    known = {field.name for field in dataclasses.fields(EstimatorConfig)}
    values = {change.name: _from_ros(change.value) for change in changes if change.name in known}
    for name, value in values.items():
        if configured and name not in LIVE and value != getattr(config, name):
            hint = "call ~/load_organ, or " if name == "organ" else ""
            raise InvalidInputError(
                f"parameter {name}: can only be changed while the node is unconfigured; {hint}clean the node up"
                " (lifecycle transitions deactivate, cleanup), set it, then configure and activate again"
            )
    if "estimator" in values:
        check_estimator(str(values["estimator"]))
    return dataclasses.replace(config, **values)


def accepted() -> SetParametersResult:
    """Answer to a change of parameters that is taken."""
    return SetParametersResult(successful=True)


def refused(sentence: str) -> SetParametersResult:
    """Answer to a change of parameters that is not taken."""
    return SetParametersResult(successful=False, reason=sentence)
