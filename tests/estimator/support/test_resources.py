import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.support import resources

SOURCE = Path(resources.__file__).parents[1]
FIND = "from softtissue_estimator.support.resources import resource; print(resource('organs', 'mine'))"


def find(*python_path: Path) -> Path:
    done = subprocess.run(
        [sys.executable, "-c", FIND],
        env={"PYTHONPATH": ":".join(map(str, python_path))},
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )
    return Path(done.stdout.strip())


def copy_package(target: Path) -> None:
    (target / "support").mkdir(parents=True)
    names = (
        "__init__.py",
        "errors.py",
        "support/__init__.py",
        "support/resources.py",
        "support/sentences.py",
    )
    for name in names:
        shutil.copy(SOURCE / name, target / name)


def test_found_in_an_installation(tmp_path):
    packages = tmp_path / "lib" / "python3.11" / "site-packages"
    copy_package(packages / "softtissue_estimator")
    organ = tmp_path / "share" / "softtissue_estimator" / "organs" / "mine"
    organ.mkdir(parents=True)
    assert find(packages) == organ


def test_found_in_the_source_tree(tmp_path):
    copy_package(tmp_path / "softtissue_estimator" / "softtissue_estimator")
    organ = tmp_path / "softtissue_estimator" / "organs" / "mine"
    organ.mkdir(parents=True)
    assert find(tmp_path / "softtissue_estimator") == organ


def test_found_through_a_link_as_colcon_makes_them(tmp_path):
    copy_package(tmp_path / "source" / "softtissue_estimator")
    organ = tmp_path / "source" / "organs" / "mine"
    organ.mkdir(parents=True)
    (tmp_path / "install").mkdir()
    (tmp_path / "install" / "softtissue_estimator").symlink_to(tmp_path / "source" / "softtissue_estimator")
    assert find(tmp_path / "install").resolve() == organ


def test_missing_one_is_a_sentence():
    with pytest.raises(
        InvalidInputError, match=r"bundled organs/nothing: expected it in share/softtissue_estimator"
    ):
        resources.resource("organs", "nothing")
