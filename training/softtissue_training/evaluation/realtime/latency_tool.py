"""Runs the estimator's executable `latency`, through which this package measures the node without importing ROS."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError, SoftTissueError


def find_latency_tool() -> Path:
    """Return the installed executable.

    Raises
    ------
    InvalidInputError
        If this process does not run in a built workspace.
    """
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "lib" / "softtissue_estimator" / "latency"
        if prefix and path.is_file():
            return path
    raise InvalidInputError(
        "executable latency: expected a built and sourced workspace (make bench sets it up), got none"
    )


def run_latency_tool(arguments: Sequence[str], out: Path) -> dict[str, Any]:
    """Run it; its lines go to the terminal. Returns what it wrote to `out`.

    Raises
    ------
    SoftTissueError
        If it failed.
    """
    # What an earlier run wrote must not pass for this one's.
    out.unlink(missing_ok=True)
    command = [str(find_latency_tool()), *arguments, "--out", str(out)]
    done = subprocess.run(command, check=False)
    # 1 says that clouds got lost on the way; the figures say how many.
    if done.returncode not in (0, 1) or not out.is_file():
        raise SoftTissueError(f"latency: expected figures in {out}, got exit code {done.returncode}")
    report: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    return report
