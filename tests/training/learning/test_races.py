"""Races: the same data for all variants, and a row for each."""

import pytest

from softtissue_training.learning.races import VARIANTS, main
from softtissue_training.learning.training_config import get_config


def test_every_variant_is_another_configuration():
    config = get_config("paper-coarse")
    changed = {name: change(config) for name, change in VARIANTS.items()}
    assert changed.pop("as configured") == config
    assert len({repr(one) for one in [config, *changed.values()]}) == 1 + len(changed)
    assert changed["without the channel of what was observed"].spec.architecture.in_channels == 5
    assert changed["without a standard deviation"].spec.architecture.out_channels == 3
    assert {one.spec.spacing for one in changed.values()} == {config.spec.spacing}


def test_a_race_leaves_a_row_for_each_variant(data_folder, tmp_path, capsys):
    names = ["as configured", "squared distance"]
    options = ["--data", str(data_folder), "--out", str(tmp_path), "--config", "tiny", "--minutes", "0.005"]
    assert main([*options, "--variants", *names]) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")][2:]
    assert [row[0].removeprefix("| ") for row in rows] == names
    assert all(0.0 < float(row[1]) < 50.0 and int(row[3].removesuffix(" |")) >= 1 for row in rows)
    assert rows[0][2] == rows[1][2]  # the same held-out views


def test_data_that_are_not_there_are_a_sentence(tmp_path, capsys):
    assert main(["--data", str(tmp_path / "none"), "--out", str(tmp_path), "--minutes", "0.01"]) == 2
    assert "races:" in capsys.readouterr().err


def test_an_unknown_variant_is_refused():
    with pytest.raises(SystemExit):
        main(["--data", "x", "--out", "y", "--variants", "faster"])
