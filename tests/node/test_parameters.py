"""Parameters: one list of them, with unit and range; which may change while the node runs."""

import dataclasses
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.parameter import Parameter

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.igtl.settings import BridgeSettings
from softtissue_estimator.overlay.settings import OverlaySettings
from softtissue_estimator.ros import parameters
from softtissue_estimator.viewer.settings import ViewerSettings

PACKAGE = Path(__file__).parents[2] / "softtissue_estimator"


def test_parameter_file_has_every_parameter_with_its_default():
    text = (PACKAGE / "config" / "softtissue_estimator.yaml").read_text()
    listed = yaml.safe_load(text)["/**"]["ros__parameters"]
    defaults = dataclasses.asdict(EstimatorConfig()) | parameters.NODE_DEFAULTS
    defaults |= {name: list(value) for name, value in defaults.items() if isinstance(value, tuple)}
    assert listed == defaults
    # ROS is strict: 1 is not a double.
    assert {n: type(v) for n, v in listed.items()} == {n: type(v) for n, v in defaults.items()}


@pytest.mark.parametrize(
    ("name", "settings"),
    [("overlay", OverlaySettings), ("viewer", ViewerSettings), ("igtl_bridge", BridgeSettings)],
)
def test_parameter_files_of_other_nodes_have_every_parameter_with_its_default(name, settings):
    text = (PACKAGE / "config" / f"softtissue_{name}.yaml").read_text()
    listed, defaults = yaml.safe_load(text)["/**"]["ros__parameters"], dataclasses.asdict(settings())
    assert listed == defaults
    assert {n: type(v) for n, v in listed.items()} == {n: type(v) for n, v in defaults.items()}
    for field in dataclasses.fields(settings):
        assert field.metadata["description"] in text


def test_descriptors_tell_type_unit_and_range():
    for field in dataclasses.fields(EstimatorConfig):
        described = parameters.descriptor(field)
        assert described.name == field.name
        assert field.metadata["description"] in described.description
        assert field.metadata["unit"] in described.description
        if field.metadata["range"] is not None:
            limits = (described.floating_point_range or described.integer_range)[0]
            assert (limits.from_value, limits.to_value) == field.metadata["range"]
        # What only the start looks at cannot seem to change afterwards.
        assert described.read_only == (field.name in {"autostart", "organ_root", "use_tf"})


def test_live_parameters_change_and_others_only_when_unconfigured():
    config = EstimatorConfig()
    live = [Parameter("frame_budget_s", value=0.5)]
    assert parameters.changed_config(config, live, configured=True).frame_budget_s == 0.5
    device = [Parameter("device", value="cpu")]
    assert parameters.changed_config(config, device, configured=False).device == "cpu"
    with pytest.raises(InvalidInputError, match="device: can only be changed while the node is unconfigured"):
        parameters.changed_config(config, device, configured=True)
    with pytest.raises(InvalidInputError, match="one of auto, cuda, cpu"):
        parameters.changed_config(config, [Parameter("device", value="tpu")], configured=False)
    with pytest.raises(InvalidInputError, match="elastic, paper.*'elastik'"):
        parameters.changed_config(config, [Parameter("estimator", value="elastik")], configured=False)
    assert frozenset(f.name for f in dataclasses.fields(EstimatorConfig)) >= parameters.LIVE
