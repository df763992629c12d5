"""Program that has VTK and meshio loaded and branches off a process for each file that is to be read.

Knows `cells_worker` and the libraries alone, so that little has to be copied. Takes a line of JSON for each file (the
arguments of `cells_worker`, a file for what it prints, the limit of time in s) and answers with the exit code, or with
"late". Two requests never overlap.
"""

import json
import os
import runpy
import signal
import sys
import time
from typing import Any


def main() -> None:
    """Answer requests until there are none."""
    import meshio.gmsh  # noqa: F401
    import vtkmodules.util.numpy_support
    import vtkmodules.vtkFiltersCore
    import vtkmodules.vtkIOLegacy
    import vtkmodules.vtkIOXML  # noqa: F401

    # As a function rather than as a program: the libraries are loaded once.
    worker = runpy.run_path(sys.argv[1], run_name="cells_worker")["main"]
    for line in sys.stdin:
        arguments, printed, limit_s = json.loads(line)
        print(branch_off(worker, arguments, printed, limit_s), flush=True)


def branch_off(worker: Any, arguments: list[str], printed: str, limit_s: float) -> int | str:
    """Run the worker in a process of its own; return its exit code."""
    child = os.fork()
    if child == 0:
        code = 70
        try:
            os.dup2(os.open(printed, os.O_CREAT | os.O_WRONLY), 2)
            os.dup2(2, 1)
            sys.argv = arguments
            code = worker()
        finally:
            sys.stderr.flush()
            os._exit(code)
    end, pause_s = time.monotonic() + limit_s, 0.0005
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "late"
        time.sleep(pause_s)
        pause_s = min(0.01, 1.3 * pause_s)


if __name__ == "__main__":
    main()
