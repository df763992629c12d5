"""Change one digit of one vertex of an OBJ, many times, and count what is said of it.

As a program: `python tests/fuzz/wrong_digits.py 1500`.
"""

import argparse
import random
import sys
import tempfile
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    root = Path(__file__).parents[2]
    sys.path[:0] = [str(root / part) for part in ("tests", "softtissue_estimator")]

from estimator.shapes import ellipsoid
from fuzz.mesh_templates import organ_yaml
from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.support.log_lines import log_lines

_FAR_MM, _LARGE_SHARE = 20.0, 0.05
_ORGAN = ellipsoid((90.0, 60.0, 50.0), 3)


def another_digit(rng: random.Random, line: str) -> tuple[str, float]:
    """Replace a digit of a line `v x y z`; return how far the vertex moves, too."""
    at = rng.choice([i for i, sign in enumerate(line) if sign.isdigit()])
    changed = line[:at] + rng.choice([d for d in "0123456789" if d != line[at]]) + line[at + 1 :]
    before, after = (np.array(text.split()[1:], dtype=np.float64) for text in (line, changed))
    return changed, float(np.linalg.norm(after - before))


def count(files: int, folder: Path) -> dict[str, int]:
    """Count files, those with a vertex moved far, those of which that is said, and large changes that nobody says."""
    vertices = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in _ORGAN.vertices]
    faces = [f"f {a} {b} {c}" for a, b, c in _ORGAN.faces + 1]
    (folder / "organ.yaml").write_text(organ_yaml("organ.obj"))
    volume, rng = 1e-9 * enclosed_volume(_ORGAN), random.Random(1)
    found = {"files": files, "moved far": 0, "of these said": 0, "volume changed in silence": 0}
    for _ in range(files):
        lines, number = list(vertices), rng.randrange(len(vertices))
        lines[number], moved_mm = another_digit(rng, lines[number])
        (folder / "organ.obj").write_text("\n".join(lines + faces))
        said: list[str] = []
        try:
            with log_lines(said.append):
                change = abs(enclosed_volume(load_organ(folder).surface) / volume - 1.0)
        except SoftTissueError as error:
            said.append(f"stray: {error}")
            change = 0.0
        named = any("stray" in line for line in said)
        found["moved far"] += moved_mm >= _FAR_MM
        found["of these said"] += moved_mm >= _FAR_MM and named
        found["volume changed in silence"] += change > _LARGE_SHARE and not named
    return found


def main() -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=int)
    with tempfile.TemporaryDirectory() as folder:
        for what, number in count(parser.parse_args().files, Path(folder)).items():
            print(f"{what}: {number}")


if __name__ == "__main__":
    main()
