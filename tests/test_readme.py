"""The lines of Python in the README, run as they stand there, where no ROS is."""

import os
import re
import subprocess
import sys

from matplotlib.image import imread

from test_dependencies import ROOT, ROS_PACKAGES

# Runs a file in an interpreter that finds no ROS package, as one does into whose environment none was installed.
WITHOUT_ROS = f"""
import runpy, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted(ROS_PACKAGES)!r}:
            raise ModuleNotFoundError(f"{{name}} is not installed here", name=name)

sys.meta_path.insert(0, NoRos())
runpy.run_path(sys.argv[1], run_name="__main__")
"""


def lines_of_python() -> str:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    section = text.partition("\n## Python, without ROS\n")[2].partition("\n## ")[0]
    blocks = re.findall(r"^```python\n(.*?)^```$", section, flags=re.DOTALL | re.MULTILINE)
    assert len(blocks) == 1
    return blocks[0]


def test_lines_of_python_are_ten_and_their_imports():
    lines = [line for line in lines_of_python().splitlines() if line.strip()]
    assert len([line for line in lines if not line.startswith(("import ", "from "))]) <= 10


def test_lines_of_python_run_without_ros(tmp_path):
    script = tmp_path / "lines.py"
    script.write_text(lines_of_python(), encoding="utf-8")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("AMENT_", "ROS_"))}
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_ROS, script],
        env={**kept, "PYTHONPATH": str(ROOT / "softtissue_estimator")},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stderr) == (0, "")
    said = re.fullmatch(
        r"tumour moved by \[(.+)\] mm, each component \+- ([\d.]+)\n", result.stdout, flags=re.DOTALL
    )
    x, y, z = (float(number) for number in said[1].split())
    # The right end is lifted by 16 mm; the tumour, 25 mm further in, by about half of that, as its front is.
    assert 5.0 < z < 10.0 and abs(x) < 2.0 and abs(y) < 2.0
    assert 0.05 < float(said[2]) < 3.0
    rows, columns, _ = imread(tmp_path / "estimate.png").shape
    assert columns > 2.5 * rows > 1000
