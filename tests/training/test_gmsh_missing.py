"""Gmsh's library is linked to those of a window; a machine without them is told so in one sentence."""

import subprocess
import sys

from test_dependencies import CORE, TRAINING

WITHOUT_WINDOW = """
import sys

class NoWindow:
    def find_spec(self, name, path=None, target=None):
        if name == "gmsh":
            raise OSError("libGLU.so.1: cannot open shared object file: No such file or directory")

sys.meta_path.insert(0, NoWindow())
from softtissue_training.__main__ import main
sys.exit(main())
"""


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_WINDOW, *arguments],
        env={"PYTHONPATH": f"{CORE.parent}:{TRAINING.parent}"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_command_says_which_library_is_missing_and_what_to_install(tmp_path):
    result = run("generate", "--count", "1", "--seed", "1", "--out", tmp_path / "sims")
    assert result.returncode == 2
    assert result.stderr == (
        "softtissue-train: Gmsh: expected the libraries that it is linked to, got 'libGLU.so.1: cannot open shared "
        "object file: No such file or directory'; on Debian and Ubuntu, install libglu1-mesa libxcursor1 libxft2 "
        "libxinerama1\n"
    )


def test_help_needs_no_gmsh():
    result = run("--help")
    assert (result.returncode, result.stderr) == (0, "")
