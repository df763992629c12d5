"""What the node's command line refuses, and its hints."""

import dataclasses

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.command_line import check_parameters, parse_arguments


def test_help_names_every_parameter(capsys):
    with pytest.raises(SystemExit) as ended:
        parse_arguments(["--help"])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert "--ros-args" in said
    for field in dataclasses.fields(EstimatorConfig):
        assert f"  {field.name} (" in said


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["organ:=/data/liver"], "did you mean --ros-args -p organ:=/data/liver?"),
        (["-p", "organ:=/data/liver"], "did you mean --ros-args -p organ:=/data/liver?"),
        (["surface_points:=/tracker/points"], "did you mean --ros-args -r surface_points:=/tracker/points?"),
        (["--ros-args", "-r", "a:=b", "--", "--gpu"], "got --gpu; `node --help` shows how"),
        (["--organ", "/data/liver"], "`node --help` shows how"),
    ],
)
def test_other_arguments_are_refused_with_a_hint(arguments, hint):
    with pytest.raises(InvalidInputError, match="got") as refused:
        parse_arguments(arguments)
    assert hint in str(refused.value)


def test_nothing_is_no_mistake():
    parse_arguments([])
    assert check_parameters(["organ", "use_sim_time", "qos_overrides./tf.subscription.depth"], []) == []


def test_misspelt_parameter_is_refused_wherever_it_stands():
    with pytest.raises(InvalidInputError, match="estimater.*did you mean estimator"):
        check_parameters(["estimater"], [])


def test_unknown_parameter_is_refused_unless_it_may_be_of_another_node():
    with pytest.raises(InvalidInputError, match="gain.*--help"):
        check_parameters(["gain"], ["node", "--ros-args", "-p", "gain:=2"])
    (left,) = check_parameters(["gain"], ["node", "--ros-args", "--params-file", "all.yaml"])
    assert "gain" in left and "left out" in left
