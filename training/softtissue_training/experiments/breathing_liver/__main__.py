"""Make the breathing liver: `python -m softtissue_training.experiments.breathing_liver --seed 2 --out DIR`."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

from softtissue_estimator.errors import SoftTissueError
from softtissue_training.experiments.breathing_liver.build import build_case, describe
from softtissue_training.experiments.breathing_liver.spec import BreathingSpec
from softtissue_training.phantom.message_writer import folder_digest


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 2 with one sentence where the case cannot be made."""
    parser = argparse.ArgumentParser(
        prog="python -m softtissue_training.experiments.breathing_liver", description=__doc__
    )
    parser.add_argument(
        "--seed", type=int, default=BreathingSpec.seed, help="of every random choice (default %(default)s)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the case")
    options = parser.parse_args(arguments)
    spec = replace(BreathingSpec(), seed=options.seed)
    start = time.monotonic()

    def progress(text: str) -> None:
        print(f"[{time.monotonic() - start:6.1f} s] {text}", file=sys.stderr, flush=True)

    try:
        made = build_case(spec, options.out, progress)
    except SoftTissueError as error:
        print(f"breathing liver: {error}", file=sys.stderr)
        return 2
    print(describe(made, spec))
    print(f"sha256: {folder_digest(options.out)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
