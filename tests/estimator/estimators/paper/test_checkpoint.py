"""Checkpoints: what is stored comes back, and what does not fit is refused in one sentence."""

import dataclasses
import json
import time
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from softtissue_estimator.errors import CheckpointError
from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint, read_provenance, save_checkpoint
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
from softtissue_estimator.estimators.paper.network_spec import CHANNELS, NetworkSpec, rigid_spec
from softtissue_estimator.estimators.paper.rigid_frame import ORGAN, RIGID

SPEC = NetworkSpec(spacing=0.006, margin_cells=3, architecture=UNetArchitecture(widths=(4, 4, 4, 8)))


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    torch.manual_seed(1)
    path = tmp_path / "weights.safetensors"
    save_checkpoint(path, UNet(SPEC.architecture), SPEC, {"command": "train", "validation_mm": 3.5})
    return path


def _rewrite(path: Path, **changes: str) -> None:
    tensors = load_file(path)
    metadata = {
        "format": "softtissue-checkpoint",
        "version": "1",
        "spec": json.dumps(
            {"architecture": {"widths": [4, 4, 4, 8]}, "channels": ["a"] * 5, "input_scales": [1] * 5}
        ),
        "provenance": "{}",
    }
    save_file(tensors, path, metadata=metadata | changes)


def test_round_trip(stored: Path) -> None:
    checkpoint = load_checkpoint(stored)
    torch.manual_seed(1)
    expected = UNet(SPEC.architecture)
    for name, weight in expected.state_dict().items():
        assert torch.equal(weight, checkpoint.network.state_dict()[name])
    assert checkpoint.spec == SPEC
    assert checkpoint.provenance == {"command": "train", "validation_mm": 3.5}


def test_half_precision_is_half_the_size_and_close(stored: Path, tmp_path: Path) -> None:
    full = load_checkpoint(stored)
    half_path = tmp_path / "half.safetensors"
    save_checkpoint(half_path, full.network, full.spec, {}, half=True)
    half = load_checkpoint(half_path)
    assert half_path.stat().st_size < 0.6 * stored.stat().st_size
    inputs = torch.randn(1, 5, 16, 16, 16, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(full.network(inputs), half.network(inputs), atol=2e-3, rtol=0.0)


def test_weights_of_another_estimator_are_refused_in_one_sentence(stored: Path) -> None:
    _rewrite(stored, kind="another", provenance='{"command": "train it"}')
    with pytest.raises(
        CheckpointError, match="expected weights of 'paper', got weights of 'another'"
    ) as told:
        load_checkpoint(stored)
    assert "\n" not in str(told.value)
    assert read_provenance(stored) == {"command": "train it"}


def test_missing_file() -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        load_checkpoint(Path("nowhere.safetensors"))


def test_truncated_file(stored: Path) -> None:
    stored.write_bytes(stored.read_bytes()[:2000])
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(stored)


def test_pickle_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    torch.save({"a": torch.zeros(1)}, path)
    with pytest.raises(CheckpointError, match="damaged or not a safetensors file"):
        load_checkpoint(path)


def test_other_architecture(stored: Path) -> None:
    wider = {"architecture": {"widths": [4, 4, 6, 8]}, "channels": ["a"] * 5, "input_scales": [1] * 5}
    _rewrite(stored, spec=json.dumps(wider))
    with pytest.raises(CheckpointError, match="another architecture: expected .* got"):
        load_checkpoint(stored)


def test_other_software(stored: Path) -> None:
    _rewrite(stored, format="something else")
    with pytest.raises(CheckpointError, match="not written by this software.*something else"):
        load_checkpoint(stored)


def test_unknown_version(stored: Path) -> None:
    _rewrite(stored, version="99")
    with pytest.raises(CheckpointError, match="version 99, expected 1"):
        load_checkpoint(stored)


def test_unreadable_metadata(stored: Path) -> None:
    _rewrite(stored, spec="{")
    with pytest.raises(CheckpointError, match="unreadable metadata"):
        load_checkpoint(stored)


def test_channels_must_fit(stored: Path) -> None:
    spec = {"architecture": {"widths": [4, 4, 4, 8]}, "channels": ["a"] * 4, "input_scales": [1] * 4}
    _rewrite(stored, spec=json.dumps(spec))
    with pytest.raises(CheckpointError, match="4 channels"):
        load_checkpoint(stored)


def test_values_that_are_not_finite(tmp_path: Path) -> None:
    network = UNet(SPEC.architecture)
    with torch.no_grad():
        next(network.parameters())[0] = float("nan")
    path = tmp_path / "nan.safetensors"
    save_checkpoint(path, network, SPEC, {})
    with pytest.raises(CheckpointError, match="not finite"):
        load_checkpoint(path)


def test_failed_write_keeps_the_old_file(stored: Path) -> None:
    before = stored.read_bytes()
    with pytest.raises(TypeError):
        save_checkpoint(stored, UNet(SPEC.architecture), SPEC, {"unwritable": object()})
    assert stored.read_bytes() == before


def test_checkpoints_without_a_frame_are_of_the_organs(stored: Path) -> None:
    """As written before networks had frames and standard deviations."""
    fields = dataclasses.asdict(SPEC)
    assert (fields.pop("frame"), fields.pop("sigma_scale")) == ("organ", 1.0)
    _rewrite(stored, spec=json.dumps(fields))
    checkpoint = load_checkpoint(stored)
    assert checkpoint.spec == SPEC
    assert checkpoint.spec.frame == ORGAN and not checkpoint.spec.gives_sigma
    assert checkpoint.spec.channels == CHANNELS


def test_frame_and_scale_of_the_deviation_come_back(tmp_path: Path) -> None:
    spec = rigid_spec(0.006, widths=(4, 4, 4, 8), sigma_scale=0.6)
    save_checkpoint(tmp_path / "rigid.safetensors", UNet(spec.architecture), spec, {})
    stored = load_checkpoint(tmp_path / "rigid.safetensors").spec
    assert stored == spec
    assert stored.frame == RIGID and stored.gives_sigma and stored.sigma_scale == 0.6


ABSURD = [
    {"architecture": {"widths": [10**9, 4, 4, 8]}},
    {"architecture": {"widths": [4] * 60}},
    {"architecture": {"widths": []}},
    {"architecture": {"widths": [4.5, 4, 4, 8]}},
    {"architecture": {"widths": [4, 4, 4, -8]}},
    {"architecture": {"widths": [4, 4, 4, 8], "encoder_convolutions": 10**12}},
    {"architecture": {"widths": [4, 4, 4, 8], "bottleneck_convolutions": 10**6}},
    {"architecture": {"widths": [4, 4, 4, 8], "decoder_convolutions": -1}},
    {"architecture": {"widths": [4, 4, 4, 8], "out_channels": 10**10}},
    {"architecture": {"widths": [4, 4, 4, 8], "out_channels": True}},
    {"spacing": 1e-9},
    {"spacing": float("nan")},
    {"spacing": 1e300},
    {"spacing": "near"},
    {"margin_cells": 10**9},
    {"margin_cells": -3},
    {"output_scale": float("inf")},
    {"input_scales": [1.0, 1.0, "x", 1.0, 1.0]},
    {"frame": 7},
]


@pytest.mark.parametrize("changes", ABSURD, ids=str)
def test_absurd_sizes_are_refused_before_anything_is_built(stored: Path, changes: dict) -> None:
    fields = dataclasses.asdict(SPEC)
    _rewrite(stored, spec=json.dumps(fields | changes))
    began = time.monotonic()
    with pytest.raises(CheckpointError, match="expected"):
        load_checkpoint(stored)
    assert time.monotonic() - began < 5.0


def test_tensors_of_a_large_empty_shape_are_refused(stored: Path) -> None:
    tensors = load_file(stored)
    with safe_open(stored, framework="pt") as file:
        metadata = file.metadata()
    tensors["heads.0.bias"] = torch.empty(10**9, 0)
    save_file(tensors, stored, metadata=metadata)
    with pytest.raises(CheckpointError, match="another architecture"):
        load_checkpoint(stored)


@pytest.mark.parametrize("name", ["x" * 300, "zero\0byte", "/dev/zero"])
def test_name_of_any_file_is_a_sentence(name: str) -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        load_checkpoint(Path(name))
