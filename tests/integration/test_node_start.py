"""What is wrong when the node starts is said in one sentence, and ends it with exit code 2."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import NodeProcess, write_organ


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"))


def damaged_organ(folder: Path, case: str) -> Path:
    if case == "no folder":
        return folder / "nowhere"
    write_organ(folder)
    (folder / "surface.ply").write_bytes(b"not a mesh")
    return folder


@pytest.mark.parametrize(
    ("case", "words"),
    [
        # Of what can be wrong with an organ (tests/estimator/organ) one when it is described, and one when it is read.
        ("no folder", ["nowhere", "organ.yaml"]),
        ("damaged mesh", ["surface.ply"]),
    ],
)
def test_wrong_organ_at_start_is_one_sentence_and_exit_code_2(tmp_path, case, words, domain):
    organ = damaged_organ(tmp_path / "organ", case)
    with NodeProcess(domain, tmp_path, {"organ": organ, "estimator": "elastic"}) as node:
        assert node.wait(60.0) == 2
        errors = [line for line in node.text.splitlines() if "[INFO]" not in line]
        assert len(errors) == 1, node.text
        assert all(word in errors[0] for word in [*words, "expected"]), errors


def write_checkpoint_of_another_architecture(path):
    from softtissue_estimator.estimators.paper.checkpoint import save_checkpoint
    from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
    from softtissue_estimator.estimators.paper.network_spec import NetworkSpec

    promised = NetworkSpec(architecture=UNetArchitecture(widths=(4, 4, 4, 8)))
    save_checkpoint(path, UNet(UNetArchitecture(widths=(4, 4, 6, 8))), promised, {})


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"estimator": "magic"}, ["estimator", "'magic'", "elastic"]),
        ({"frame_budget_s": -1.0}, ["frame_budget_s", "-1"]),
        ({"minimum_points": "many"}, ["minimum_points", "many"]),
        (
            {"qos_overrides./surface_points.subscription.reliability": "sure"},
            ["surface_points", "best_effort, reliable", "'sure'"],
        ),
        (
            {"estimator": "paper", "checkpoint": "{tmp}/other.safetensors"},
            ["other.safetensors", "architecture"],
        ),
    ],
    ids=["estimator", "range", "type", "quality of service", "other architecture"],
)
def test_wrong_parameter_at_start_is_one_sentence_and_exit_code_2(
    folder, tmp_path, parameters, words, domain
):
    write_checkpoint_of_another_architecture(tmp_path / "other.safetensors")
    given = {name: str(value).format(tmp=tmp_path) for name, value in parameters.items()}
    with NodeProcess(domain, tmp_path, {"organ": folder} | given) as node:
        assert node.wait(60.0) == 2
        errors = [line for line in node.text.splitlines() if "[INFO]" not in line]
        assert len(errors) == 1, node.text
        assert all(word in errors[0] for word in words), errors
