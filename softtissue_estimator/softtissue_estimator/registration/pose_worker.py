"""Program that finds a pose for another process."""

import os
import sys
from pathlib import Path

_NICENESS = 5  # answers come first


def main(source: str, target: str) -> None:
    """Read the question from one file and write the answer into another."""
    os.nice(_NICENESS)
    from softtissue_estimator.registration.pose_process import serve

    serve(Path(source), Path(target))


if __name__ == "__main__":
    main(*sys.argv[1:])
