"""On what an evaluation ran."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import psutil

_LOAD_SAMPLE_S = 1.0


def machine() -> dict[str, Any]:
    """Return the processor's name, the cores that this process may use, and the operating system."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def busy_cores() -> float:
    """Return how many cores programs keep busy, over the next second; 0 is an idle machine."""
    return float(psutil.cpu_percent(interval=_LOAD_SAMPLE_S)) / 100.0 * (os.cpu_count() or 1)


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"
