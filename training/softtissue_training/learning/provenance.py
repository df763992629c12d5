"""What a run was made with: commit of the source tree and versions of the packages."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

_PACKAGES = ("softtissue-training", "softtissue-estimator", "torch", "numpy", "scipy")


def commit() -> str | None:
    """Return the commit that this package's source is checked out at, '+changes' appended where it differs from it.

    None where the package is installed, or there is no git.
    """
    folder = Path(__file__).parent
    try:
        # A package installed somewhere inside another repository is no part of it.
        _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", ".")
        return _git(folder, "rev-parse", "HEAD") + ("+changes" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that shape a training run."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "source tree"
    return found


def hardware(device: str) -> str:
    """Name the kind of processor or GPU that a run computes on, and how many threads it uses.

    Parameters
    ----------
    device
        Torch device.
    """
    if device.startswith("cuda"):
        return str(torch.cuda.get_device_name(torch.device(device)))
    return f"{platform.machine()} processor, {torch.get_num_threads()} threads"


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True, timeout=10
    )
    return done.stdout.strip()
