import pytest
import torch

from softtissue_estimator.checkpoint import load_checkpoint
from softtissue_training.archive import list_records
from softtissue_training.cli import main


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert all(command in shown for command in ("generate", "pack", "train", "export"))


def test_pack_train_and_export(data_folder, tmp_path, capsys):
    packed = tmp_path / "sims.pack"
    assert main(["pack", str(data_folder), str(packed)]) == 0
    arguments = ["train", "--data", str(packed), "--out", str(tmp_path / "run"), "--config", "tiny"]
    assert main([*arguments, "--time-limit", "0.01", "--threads", "1"]) == 0
    assert (tmp_path / "run" / "best.safetensors").is_file()
    assert "validation error" in capsys.readouterr().out
    exported = tmp_path / "paper.safetensors"
    assert main(["export", str(tmp_path / "run"), str(exported)]) == 0
    weights = load_checkpoint(exported).network.state_dict()
    for name, kept in load_checkpoint(tmp_path / "run" / "best.safetensors").network.state_dict().items():
        torch.testing.assert_close(weights[name], kept, rtol=1e-3, atol=1e-6)
    assert main([*arguments, "--time-limit", "0.01"]) == 2
    assert "add --resume to go on" in capsys.readouterr().err


def test_wrong_data_ends_with_code_2_and_one_sentence(tmp_path, capsys):
    missing = tmp_path / "nothing"
    arguments = ["train", "--data", str(missing), "--out", str(tmp_path / "run"), "--time-limit", "1"]
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert str(missing) in message
    assert "Traceback" not in message
    assert main(["pack", str(missing), str(tmp_path / "file")]) == 2


def test_generate_simulates_in_worker_processes(data_folder, tmp_path, capsys):
    arguments = ["generate", "--count", "2", "--seed", "3", "--workers", "2", "--element-size", "20"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    assert "2 simulations" in capsys.readouterr().out
    for name in list_records(tmp_path):
        assert (tmp_path / name).read_bytes() == (data_folder / name).read_bytes()
