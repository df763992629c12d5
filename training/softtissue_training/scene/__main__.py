"""Make the bundled scene: `python -m softtissue_training.scene --seed 1 --out DIR`."""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

from softtissue_estimator.errors import SoftTissueError
from softtissue_training.phantom.message_writer import folder_digest
from softtissue_training.scene.build import BAG_NAME, build_scene
from softtissue_training.scene.report import describe
from softtissue_training.scene.spec import SceneSpec


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 2 with one sentence where the scene cannot be made."""
    parser = argparse.ArgumentParser(prog="python -m softtissue_training.scene", description=__doc__)
    parser.add_argument(
        "--seed", type=int, default=1, help="of every random choice; the organ is the phantom's (default 1)"
    )
    parser.add_argument("--out", type=Path, required=True, help=f"folder that gets bags/{BAG_NAME}")
    options = parser.parse_args(arguments)
    spec = SceneSpec()
    spec = replace(spec, phantom=replace(spec.phantom, seed=options.seed))
    start = time.monotonic()

    def progress(text: str) -> None:
        print(f"[{time.monotonic() - start:6.1f} s] {text}", file=sys.stderr, flush=True)

    try:
        scene, figures = build_scene(spec, options.out, progress)
    except SoftTissueError as error:
        print(f"scene: {error}", file=sys.stderr)
        return 2
    print(describe(scene, figures, spec))
    bag = options.out / "bags" / BAG_NAME
    size = sum(path.stat().st_size for path in bag.iterdir())
    print(f"bag: {size / 1e6:.1f} MB, sha256 {folder_digest(bag)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
