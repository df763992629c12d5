"""The exported file: the same network in half the size, and no path of the machine it was trained on."""

import torch

from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint, save_checkpoint
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_training.cli import main


def test_export_halves_the_file_and_strips_paths(tmp_path, capsys):
    spec = NetworkSpec(architecture=UNetArchitecture(widths=(4, 4, 4, 8)))
    source, target = tmp_path / "best.safetensors", tmp_path / "shipped.safetensors"
    provenance = {"command": f"softtissue-train train --data {tmp_path}/sims", "validation_error_mm": 4.25}
    save_checkpoint(source, UNet(spec.architecture), spec, provenance)
    assert main(["export", str(tmp_path), str(target)]) == 0
    assert "validation error 4.25 mm" in capsys.readouterr().out
    assert target.stat().st_size < 0.6 * source.stat().st_size
    assert str(tmp_path).encode() not in target.read_bytes()
    before, after = load_checkpoint(source), load_checkpoint(target)
    assert after.spec == spec
    assert after.provenance["command"] == "softtissue-train train --data sims"
    for name, weight in before.network.state_dict().items():
        torch.testing.assert_close(after.network.state_dict()[name], weight, atol=1e-3, rtol=1e-3)


def test_a_missing_run_ends_with_one_sentence(tmp_path, capsys):
    assert main(["export", str(tmp_path / "none"), str(tmp_path / "out.safetensors")]) == 2
    message = capsys.readouterr().err
    assert "does not exist" in message and "Traceback" not in message
