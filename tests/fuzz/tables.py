"""Damaged tables of points: CSV, .fcsv and .mrk.json."""

import json
import random
from pathlib import Path

import numpy as np

from fuzz.damage import damaged_text, damaged_tree, rewritten_text
from fuzz.kind import Kind, expect
from softtissue_training.experiments.fcsv import write_fcsv
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.markups_json import write_markups_json
from softtissue_training.experiments.paired_points import read_table_of_pairs
from softtissue_training.experiments.point_lists import read_points

MM = 1e-3
POINTS = LabelledPoints(
    ("A1", "tip, left", "3", "d"), np.array([[10, 20.5, -3], [1, 2, 3], [-7, 0, 99.125], [4, 5, 6]]) * MM
)
_FARTHEST_M = 1e300
_SAME = "same-"


class Tables(Kind):
    """What `read_points` and `read_table_of_pairs` read."""

    name = "tables"
    share = 14

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._templates = _templates(folder)

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        name = rng.choice(sorted(self._templates))
        content = self._templates[name]
        if name.endswith("csv") and not name.endswith(".fcsv") and rng.random() < 0.05:
            return _SAME + name, _rewritten(rng, content)
        if name.endswith(".json") and rng.random() < 0.5:
            tree = damaged_tree(rng, json.loads(content))
            return name, json.dumps(tree, skipkeys=True, default=str).encode()
        return name, damaged_text(rng, content)

    def run(self, name: str, content: bytes) -> str:
        found = self._read(name, content)
        expect(
            bool(np.isfinite(found).all()) and found.ndim == 2 and found.shape[1] == 3, "points that are none"
        )
        expect(len(found) > 0, "no points")
        if name.startswith(_SAME):
            expect(found.shape == POINTS.points.shape and np.allclose(found, POINTS.points), "other points")
            return "the same"
        return "read"

    def check_good(self) -> None:
        for name, content in self._templates.items():
            found = self._read(name, content)
            expect(
                found.shape == POINTS.points.shape and np.allclose(found, POINTS.points),
                f"{name}: other points",
            )

    def _read(self, name: str, content: bytes) -> np.ndarray:
        file = self.folder / name
        file.write_bytes(content)
        if "pairs" in name:
            pairs = read_table_of_pairs(file, MM, "LPS", "pairs")
            expect(len(pairs.after) == len(pairs.before), "pairs of unequal number")
            return np.asarray(pairs.before)
        return read_points(file, MM, "LPS").points


def _templates(folder: Path) -> dict[str, bytes]:
    rows = [(label, *point) for label, point in zip(POINTS.labels, POINTS.points / MM, strict=True)]
    plain = [f'"{label}",{x},{y},{z}' for label, x, y, z in rows]
    commas = [f"{label};{x};{y};{z}".replace(".", ",") for label, x, y, z in rows]
    tabs = [f"{x}\t{y}\t{z}\t{label}\t1" for label, x, y, z in rows]
    pairs = [f"{x},{y},{z},{x + 1},{y},{z}" for _, x, y, z in rows]
    found = {
        "comma.csv": ["label,x,y,z", *plain],
        "semicolon.csv": ["# label;l;p;s", "label;l;p;s", *commas],
        "bare.csv": plain,
        "tab.tsv": ["x\ty\tz\tlabel\tdefined", *tabs],
        "pairs.csv": ["x,y,z,x_after,y_after,z_after", *pairs],
    }
    contents = {name: ("\n".join(lines) + "\n").encode() for name, lines in found.items()}
    write_fcsv(folder / "points.fcsv", POINTS, "LPS")
    write_markups_json(folder / "points.mrk.json", POINTS, "LPS")
    return contents | {name: (folder / name).read_bytes() for name in ("points.fcsv", "points.mrk.json")}


def _rewritten(rng: random.Random, content: bytes) -> bytes:
    if rng.random() < 0.5:
        return (
            rewritten_text(rng, content) if b"tip, left" not in content else content.replace(b"\n", b"\r\n")
        )
    return content.decode().encode(rng.choice(("utf-16", "utf-8-sig", "utf-32")))
