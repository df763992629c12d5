"""Times of the networks alone: every row, what is left out and why, and differences that mean millimetres."""

import dataclasses

import pytest
import torch

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.support.resources import bundled_checkpoint, bundled_organ
from softtissue_training.evaluation import network_timing, other_runtimes
from softtissue_training.evaluation.network_cases import paper_case
from softtissue_training.evaluation.network_timing import OURS, main, table, time_networks

CONFIG = EstimatorConfig(device="cpu")


@pytest.fixture(scope="module")
def organ():
    return load_organ(bundled_organ())


@pytest.fixture
def absent(monkeypatch):
    """Other runtimes are not installed."""
    monkeypatch.setattr(other_runtimes, "find_spec", lambda name: None)


def test_every_network_is_timed_in_every_way_that_there_is(organ, absent, monkeypatch):
    monkeypatch.setattr(network_timing, "_CUBE", (16, 16, 16))
    said = []
    rows = time_networks(organ, CONFIG, 2, said.append)
    box = [32, 16, 24]
    assert {row["network"] for row in rows} == {"paper"}
    plain = [row for row in rows if row["runtime"] == "torch, plain"]
    assert [(row["shape"], row["precision"]) for row in plain] == [
        ([16, 16, 16], "float32"),
        (box, "float32"),
    ]
    ours = {(row["precision"], row["threads"]): row for row in rows if row["runtime"] == OURS}
    assert ours["float32", 1]["difference_mm"] < 1e-3
    assert all(row["shape"] == box and row["difference_mm"] < 0.3 for row in ours.values())
    assert any("paper: no rows for OpenVINO, which needs the packages openvino" in text for text in said)
    assert all(0.0 < row["min_ms"] <= row["p50_ms"] <= row["p95_ms"] for row in rows)
    shown = table(rows)
    assert "| paper | torch, plain | float32 |" in shown and "| 32 x 16 x 24 |" in shown
    assert len(shown.splitlines()) == len(rows) + 2


class Plain:
    """A network as it is, in place of one that is prepared."""

    def __init__(self, network, shape, device, dtype, progress):
        self.run, self.description = network, str(dtype)

    def __call__(self, inputs):
        return self.run(inputs)


def test_another_runtime_has_its_rows_where_it_is_installed(organ, monkeypatch):
    def slower_and_wrong(network, example, precision, threads):
        return lambda inputs: network(inputs) + 0.01

    monkeypatch.setattr(network_timing, "_CUBE", (16, 16, 16))
    monkeypatch.setattr(network_timing, "RUNTIMES", {"OpenVINO": slower_and_wrong})
    monkeypatch.setattr(network_timing, "missing_packages", lambda name: [])
    monkeypatch.setattr(network_timing, "NetworkRuntime", Plain)  # ours are timed above
    case = paper_case(organ, CONFIG)
    network = torch.nn.Conv3d(case.inputs.shape[1], case.network(case.inputs).shape[1], 1)
    case = dataclasses.replace(case, network=network)  # with its own input and meaning of a difference
    monkeypatch.setattr(network_timing, "paper_case", lambda organ, config: case)
    rows = [row for row in time_networks(organ, CONFIG, 1, lambda _: None) if row["runtime"] == "OpenVINO"]
    assert {row["precision"] for row in rows} == {"float32", "bfloat16", "float16"}
    # 0.01 of each component's unit.
    unit_mm = 1e3 * load_checkpoint(bundled_checkpoint()).spec.output_scale
    assert rows[0]["difference_mm"] == pytest.approx(0.01 * unit_mm * 3**0.5, abs=1e-3)


def test_a_case_is_a_real_input_and_its_differences_are_of_answers(organ):
    case = paper_case(organ, CONFIG)
    with torch.inference_mode():
        outputs = case.network(case.inputs)
    assert case.difference_mm(outputs, outputs) == 0.0
    assert 0.0 < case.difference_mm(outputs, outputs + 0.001) < case.difference_mm(outputs, outputs + 0.1)
    assert torch.isfinite(case.inputs).all() and float(case.inputs.std()) > 0.1


def test_a_runtime_is_there_with_all_its_packages(monkeypatch):
    monkeypatch.setattr(other_runtimes, "find_spec", lambda name: None if name == "onnx" else "there")
    assert other_runtimes.missing_packages("ONNX Runtime") == ["onnx"]
    assert other_runtimes.missing_packages("OpenVINO") == []


def test_wrong_arguments_are_said_in_one_sentence(organ, tmp_path, capsys):
    with pytest.raises(InvalidInputError, match="repeats: expected at least 1, got 0"):
        time_networks(organ, CONFIG, 0, lambda _: None)
    assert main(["--organ", str(tmp_path / "nowhere")]) == 2
    shown = capsys.readouterr()
    assert shown.err.startswith("error: ") and "nowhere" in shown.err and shown.out == ""


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_on_a_gpu(organ):
    rows = time_networks(organ, EstimatorConfig(device="cuda"), 3, lambda _: None)
    assert {row["threads"] for row in rows} == {0}
    assert all(row["difference_mm"] < 0.05 for row in rows if row["precision"] == "float16")
