"""Program that finds poses for another process: a line of its input names the files of a question and of its answer."""

import os
import select
import sys
from pathlib import Path

_NICENESS = 5  # answers come first
_IDLE_S = 60.0  # after which it ends: what it has prepared takes memory


def main() -> None:
    """Answer questions until none comes any more."""
    os.nice(_NICENESS)
    from softtissue_estimator.registration.pose_process import Server

    server = Server()
    while select.select([sys.stdin], [], [], _IDLE_S)[0]:
        line = os.read(sys.stdin.fileno(), 65_536).decode()  # one question at a time
        if not line:
            return
        source, target = line.rstrip("\n").split("\t")
        server.serve(Path(source), Path(target))
        os.write(sys.stdout.fileno(), b"!")


if __name__ == "__main__":
    main()
