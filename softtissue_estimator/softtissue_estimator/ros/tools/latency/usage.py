"""What a process uses: processor time and memory from /proc, memory of the GPU from nvidia-smi."""

import os
import shutil
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

_GPU_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class Usage:
    """At one moment.

    Attributes
    ----------
    time_s : float
        Monotonic clock.
    cpu_s : float
        Processor time used so far by all threads.
    rss_mb : float
        Resident memory, 10^6 bytes.
    """

    time_s: float
    cpu_s: float
    rss_mb: float


def usage_of(pid: int) -> Usage:
    """Read what a process has used until now.

    Raises
    ------
    FileNotFoundError
        If there is no such process.
    """
    # The name of the program, in brackets, may hold spaces.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = int(fields[11]) + int(fields[12])
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return Usage(
        time.monotonic(), ticks / os.sysconf("SC_CLK_TCK"), 1e-6 * pages * os.sysconf("SC_PAGE_SIZE")
    )


def cpu_share(before: Usage, after: Usage) -> float:
    """Return the processor time used between two moments, as a share of one core."""
    return (after.cpu_s - before.cpu_s) / max(after.time_s - before.time_s, 1e-9)


def gpu_memory_mb(pid: int) -> float | None:
    """Return the GPU memory that a process holds, 10^6 bytes.

    Inside a container the driver may not know the process by this number; then it is all that is in use. None without
    a GPU.
    """
    found = _ask_gpu("--query-compute-apps=pid,used_memory")
    own = [row[1] for row in found if row[0] == str(pid)]
    rows = own or [row[0] for row in _ask_gpu("--query-gpu=memory.used")]
    mebibytes = [float(text) for text in rows if text.replace(".", "", 1).isdigit()]
    return 1.048576 * sum(mebibytes) if mebibytes else None


def _ask_gpu(query: str) -> list[list[str]]:
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return []
    command = [tool, query, "--format=csv,noheader,nounits"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=_GPU_TIMEOUT_S)
    except (OSError, subprocess.SubprocessError):
        return []
    return [[cell.strip() for cell in line.split(",")] for line in done.stdout.splitlines() if line.strip()]
