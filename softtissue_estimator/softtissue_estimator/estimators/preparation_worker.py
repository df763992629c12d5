"""Program that prepares an organ for another process; prints a line whenever something slow begins."""

import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import NoReturn

from softtissue_estimator.support import leftovers

_NICENESS = 5  # answers come first


def main(source: str, target: str) -> None:
    """Read the request from one file and write the result into another."""
    # So that half a file of the cache goes with it.
    signal.signal(signal.SIGTERM, _end)
    os.nice(_NICENESS)
    from softtissue_estimator.estimators.preparation import serve

    serve(Path(source), Path(target), lambda sentence: print(sentence, flush=True))
    sys.stdout.flush()
    os._exit(0)  # at the interpreter's end torch takes its time


def _end(_number: int, _frame: FrameType | None) -> NoReturn:
    leftovers.clear()
    os._exit(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
