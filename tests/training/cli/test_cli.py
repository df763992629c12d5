import os
import subprocess
import sys

import pytest
import torch
from matplotlib.image import imread

from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_training.cli import _MODULES, main
from softtissue_training.simulation.archive import list_records


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    commands = ("generate", "show", "digest", "pack", "convert", "train", "evaluate", "export")
    assert all(command in shown for command in commands)


def test_every_command_has_its_help(capsys):
    for name in _MODULES:
        with pytest.raises(SystemExit) as ended:
            main([name, "--help"])
        assert ended.value.code == 0
        assert capsys.readouterr().out.startswith(f"usage: softtissue-train {name} ")


def test_a_command_starts_without_what_others_need(data_folder):
    script = (
        "import sys; from softtissue_training.cli import _MODULES, main; assert main(sys.argv[1:]) == 0; "
        "assert 'torch' not in sys.modules"
    )
    command = [sys.executable, "-c", script, "digest", str(data_folder)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


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


def test_digest_and_convert(data_folder, tmp_path, capsys):
    assert main(["digest", str(data_folder)]) == 0
    value, count = capsys.readouterr().out.split()[:2]
    assert (len(value), count) == (64, "6")
    assert main(["convert", str(data_folder), str(tmp_path), "--count", "2"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "organ_000000_case_0.vtu",
        "organ_000001_case_0.vtu",
    ]
    assert main(["digest", str(tmp_path)]) == 2
    assert "must hold simulations, got none" in capsys.readouterr().err


def test_show_draws_a_picture(tmp_path, capsys):
    file = tmp_path / "pictures" / "seed_3.png"
    assert main(["show", "3", "--organs", "2", "--element-size", "20", "--out", str(file)]) == 0
    assert str(file) in capsys.readouterr().out
    rows, columns, _ = imread(file).shape
    assert columns > rows > 300
    assert imread(file).std() > 0.05


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--count", "3", "--load-cases", "2"], "--count must be a multiple of --load-cases, got 3 and 2"),
        (["--count", "1", "--poisson-ratio", "0.3", "0.6"], "poisson_ratio must be a range within 0 to 0.49"),
        (["--count", "1", "--force", "0", "1", "2"], "--force must be one value or the two ends"),
        (["--count", "1", "--element-size", "1"], "element size must be 4 to 50 mm, got 1 mm"),
    ],
)
def test_impossible_settings_end_with_code_2_and_one_sentence(options, message, tmp_path, capsys):
    assert main(["generate", "--seed", "1", "--out", str(tmp_path / "sims"), *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "sims").exists()


def test_generate_simulates_in_worker_processes(data_folder, tmp_path, capsys):
    arguments = ["generate", "--count", "2", "--seed", "3", "--workers", "2", "--element-size", "20"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    assert "2 simulations" in capsys.readouterr().out
    for name in list_records(tmp_path):
        assert (tmp_path / name).read_bytes() == (data_folder / name).read_bytes()


def test_without_the_estimator_one_sentence_says_what_to_do():
    program = (
        "import sys; sys.modules['softtissue_estimator'] = None\n"
        "from softtissue_training.__main__ import main; sys.exit(main())"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.count("\n") == 1 and "scripts/run softtissue-train" in ended.stderr
