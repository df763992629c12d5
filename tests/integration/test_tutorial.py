"""The commands of docs/tutorials/train_your_own.md, run as they stand there."""

import csv
import itertools
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "docs" / "tutorials" / "train_your_own.md"
BLOCKS = re.findall(r"^```bash\n(.*?)^```", TUTORIAL.read_text(), re.MULTILINE | re.DOTALL)
COMMANDS = [line for line in "".join(BLOCKS).replace("\\\n", "").splitlines() if line]
NODE = "ros2 run softtissue_estimator node"


def _rows(path):
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """Folder in which everything up to the node has been done, and what the commands printed, by their lines."""
    folder = tmp_path_factory.mktemp("tutorial")
    tools = tmp_path_factory.mktemp("bin")
    command = tools / "softtissue-train"
    command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m softtissue_training "$@"\n')
    command.chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(sys.path),
        "OMP_NUM_THREADS": "1",
        "XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache")),
    }
    printed = {}
    for line in COMMANDS:
        if line.startswith(NODE):
            continue
        done = subprocess.run(
            ["bash", "-euc", line], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        printed[line] = done.stdout
    return folder, printed


@pytest.mark.timeout(600)
def test_commands_lead_to_weights_and_their_evaluation(followed):
    folder, printed = followed
    assert [line.split()[1] for line in printed] == [
        "generate", "digest", "pack", "train", "train", "generate", "evaluate", "export"
    ]  # fmt: skip
    steps = [int(row["step"]) for row in _rows(folder / "run" / "loss.csv")]
    assert steps == list(range(1, 31))
    exported = load_checkpoint(folder / "paper.safetensors")
    assert exported.provenance["config"]["name"] == "tiny"
    trained = "".join(text for line, text in printed.items() if " train " in line)
    assert f"{exported.provenance['validation_error_mm']:.2f} mm" in trained
    names = {row["estimator"] for row in _rows(folder / "evaluation" / "samples.csv")}
    assert {"zero", "rigid"} < names


@pytest.mark.timeout(600)
def test_node_answers_with_the_trained_weights(followed, tmp_path, domain):
    pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
    pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")
    from integration.harness import Client, NodeProcess, executable, write_organ
    from integration.scene import Scene, read_answer
    from softtissue_estimator.config import EstimatorConfig
    from softtissue_estimator.estimators.estimator import create_estimator
    from softtissue_estimator.observation.observation import make_observation

    folder, _ = followed
    [line] = [line for line in COMMANDS if line.startswith(NODE)]
    command = [word.replace("$PWD", str(folder)) for word in shlex.split(line.removeprefix(NODE))]
    organ = write_organ(tmp_path / "organ")
    scene = Scene(organ)
    parameters = {"organ": organ, "device": "cpu", "minimum_visible_fraction": 0.01, "frame_budget_s": 60.0}
    stamp = next(itertools.count(1_700_000_000_000_000_000))
    program = [executable("node"), *command]
    with NodeProcess(domain, tmp_path, parameters, program) as node, Client(domain) as client:
        client.wait_until_connected()
        client.clouds.publish(scene.cloud(stamp))
        points = read_answer(client.answer_of(stamp))
        assert client.status_of(stamp).estimator == "paper"
        assert node.stop() == 0
    config = EstimatorConfig(estimator="paper", checkpoint=str(folder / "paper.safetensors"), device="cpu")
    estimator = create_estimator(config)
    estimator.load_organ(scene.organ)
    observation, _ = make_observation(scene.points, scene.reference, None, scene.organ, config)
    expected = estimator.estimate(observation).displacement[: len(points)]
    assert np.abs(expected).max() > 1e-4
    np.testing.assert_allclose(points["dx"], expected[:, 0], atol=1e-5)
