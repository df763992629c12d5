"""Program that runs another one and ends with the process that started it, even if that is killed.

Knows nothing but Python's own library: arguments are the number of that process, a script, and the script's arguments.
"""

import ctypes
import os
import runpy
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the script."""
    parent = int(sys.argv[1])
    sys.argv = sys.argv[2:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before that
            sys.exit(1)
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
