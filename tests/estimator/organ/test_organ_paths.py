"""Paths of an organ folder, whatever they are: one sentence, nothing of a foreign file, nothing outside the roots."""

import os
import shutil
import subprocess
import sys

import pytest

from estimator.organ_folders import describe
from softtissue_estimator.errors import OrganError, SoftTissueError
from softtissue_estimator.organ.organ import load_organ

NAMES = [
    "x" * 300,
    "a/" * 3000 + "b",
    "~nosuchuser/organ",
    "~nosuchuser",
    "zero\0byte",
    "/proc/1/mem",
    "/dev/zero",
    ".",
]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("key", ["surface", "vertices", "structure", "touching", "tetrahedra"])
def test_name_of_any_file_is_a_sentence(folder, name, key):
    changes = {
        "surface": {"surface": name},
        "vertices": {"attached": {"vertices": name}},
        "structure": {"structures": [{"name": "x", "mesh": name}]},
        "touching": {"attached": {"touching": {"mesh": name, "distance": 1}}},
        "tetrahedra": {"tetrahedra": name},
    }[key]
    with pytest.raises(SoftTissueError, match="expected"):
        load_organ(describe(folder, **changes))


@pytest.mark.parametrize("name", NAMES)
def test_folder_of_any_name_is_a_sentence(folder, name):
    with pytest.raises(OrganError, match="expected a folder"):
        load_organ(folder / name / "more")


@pytest.mark.parametrize(
    "indices", ["1 2 secret", "secret", "1\n" + 20 * "9", "0x10", "1_0", "٣", "1.5", "-1 2", "10000"]
)
def test_list_of_indices_tells_nothing_of_a_foreign_file(folder, indices):
    (folder / "list.txt").write_text(indices)
    with pytest.raises(OrganError, match="expected") as caught:
        load_organ(describe(folder, attached={"vertices": "list.txt"}))
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("index", [10**20, 10**17, -(10**17), True, 1.5, None, [1]])
def test_index_of_any_size_is_a_sentence(folder, index):
    with pytest.raises(OrganError, match="expected"):
        load_organ(describe(folder, attached={"vertices": [1, index]}))


def test_nothing_outside_the_roots_is_read(folder, tmp_path_factory):
    roots = (describe(folder).parent,)
    inside = load_organ(folder, roots)
    assert inside.digest == load_organ(folder).digest
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    with pytest.raises(OrganError, match="expected a folder in one of organ_root .*, got one elsewhere"):
        load_organ(folder, (elsewhere,))
    with pytest.raises(OrganError, match="got one elsewhere"):
        load_organ(folder, ())
    link = elsewhere / "link"
    link.symlink_to(folder)
    load_organ(link, roots)  # what counts is where it leads
    with pytest.raises(OrganError, match="got one elsewhere"):
        load_organ(link, (elsewhere,))


@pytest.mark.parametrize("how", ["absolute", "dots", "link", "home", "missing"])
@pytest.mark.parametrize("key", ["surface", "vertices", "structure", "touching", "tetrahedra"])
def test_no_file_outside_the_roots_is_read(folder, tmp_path_factory, monkeypatch, how, key):
    outside = tmp_path_factory.mktemp("outside") / "secret.ply"
    shutil.copy(next(folder.glob("*.ply")), outside)
    monkeypatch.setenv("HOME", str(outside.parent))
    (folder / "link.ply").symlink_to(outside)
    name = {
        "absolute": str(outside),
        "dots": os.path.relpath(outside, folder),
        "link": "link.ply",
        "home": "~/secret.ply",
        "missing": str(outside.parent / "none.ply"),  # nor is said whether a file is there
    }[how]
    changes = {
        "surface": {"surface": name},
        "vertices": {"attached": {"vertices": name}},
        "structure": {"structures": [{"name": "x", "mesh": name}]},
        "touching": {"attached": {"touching": {"mesh": name, "distance": 1}}},
        "tetrahedra": {"tetrahedra": name},
    }[key]
    with pytest.raises(OrganError, match="expected a file in one of organ_root .*, got one elsewhere"):
        load_organ(describe(folder, **changes), (folder,))


@pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("setpriv") is None, reason="only root may give that right away"
)
@pytest.mark.parametrize("closed", ["folder", "organ.yaml", "surface"])
def test_file_without_permission_is_a_sentence(folder, closed):
    describe(folder)
    path = {"folder": folder, "organ.yaml": folder / "organ.yaml", "surface": folder / "liver.ply"}[closed]
    path.chmod(0o000)
    os.chown(path, 4321, 4321)
    rights = "-dac_override,-dac_read_search"
    command = ["setpriv", f"--bounding-set={rights}", f"--inh-caps={rights}", sys.executable]
    command += ["-m", "softtissue_estimator.organ.check_organ", "--no-tetrahedra", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert done.returncode == 2, done.stderr
    assert "expected" in done.stderr and "Traceback" not in done.stderr
