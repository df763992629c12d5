"""Make the bundled phantom: `python -m softtissue_training.phantom --seed 1 --out DIR`."""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

from softtissue_estimator.errors import SoftTissueError
from softtissue_training.phantom.build import build_phantom, describe
from softtissue_training.phantom.message_writer import folder_digest
from softtissue_training.phantom.spec import PhantomSpec


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 2 with one sentence where the phantom cannot be made."""
    parser = argparse.ArgumentParser(prog="python -m softtissue_training.phantom", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="of every random choice (default 1)")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder that gets organs/phantom_liver and bags/phantom"
    )
    parser.add_argument(
        "--element-size",
        type=float,
        default=1e3 * PhantomSpec.element_size,
        metavar="MM",
        help="edge length of the finite elements, mm (default %(default)g)",
    )
    options = parser.parse_args(arguments)
    spec = replace(PhantomSpec(), seed=options.seed, element_size=1e-3 * options.element_size)
    start = time.monotonic()

    def progress(text: str) -> None:
        print(f"[{time.monotonic() - start:6.1f} s] {text}", file=sys.stderr, flush=True)

    try:
        phantom = build_phantom(spec, options.out, progress)
    except SoftTissueError as error:
        print(f"phantom: {error}", file=sys.stderr)
        return 2
    print(describe(phantom, spec))
    for part in ("organs", "bags"):
        print(f"sha256 of {part}: {folder_digest(options.out / part)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
