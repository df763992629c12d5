"""The picture of the rooms is that of the sources, and its arrows point downwards."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from scripts.loading import load_script

ROOT = Path(__file__).parents[2]
draw_rooms = load_script("draw_rooms")


def test_committed_picture_is_the_one_that_the_command_draws():
    committed = (ROOT / "docs" / "images" / "rooms.svg").read_text(encoding="utf-8")
    assert committed == draw_rooms.picture_of_rooms(), "run scripts/draw_rooms.py"


def test_imports_are_those_of_the_sources(tmp_path):
    package = tmp_path / "softtissue_estimator"
    (package / "organ").mkdir(parents=True)
    source = package / "organ" / "mesh.py"
    source.write_text(
        "import numpy, softtissue_estimator.errors\n"
        "from softtissue_estimator.support import cache\n"
        "from . import organ\n"
        "def late():\n    from ..view.picture import draw\n"
    )
    assert draw_rooms.imported_modules(source, package) == {
        "errors",
        "support.cache",
        "organ.organ",
        "view.picture.draw",
    }


def test_module_belongs_to_the_smallest_room_around_it():
    rooms = ["estimators", "estimators.elastic", "ros"]
    assert draw_rooms.smallest_room("estimators.elastic.solver", rooms) == "estimators.elastic"
    assert draw_rooms.smallest_room("estimators.estimator", rooms) == "estimators"
    assert draw_rooms.smallest_room("ros", rooms) == "ros"
    assert draw_rooms.smallest_room("rosbag", rooms) == ""


def test_arrow_that_follows_from_others_is_left_out():
    arrows = {"a": {"b", "c", "d"}, "b": {"c"}, "c": set(), "d": set()}
    assert draw_rooms.without_what_follows(arrows) == {"a": {"b", "d"}, "b": {"c"}, "c": set(), "d": set()}


def test_every_arrow_points_down_and_ends_at_a_room(monkeypatch):
    floors = [["ground"], ["left", "right"], ["top"]]
    arrows = {"ground": set(), "left": {"ground"}, "right": set(), "top": {"ground", "left"}}
    monkeypatch.setattr(draw_rooms, "docstring", lambda room: f"What {room} & co do")
    picture = ElementTree.fromstring(draw_rooms.draw(floors, arrows))
    space = "{http://www.w3.org/2000/svg}"
    boxes = [element for element in picture.iter(f"{space}rect") if element.get("rx")]
    tops = {float(box.get("y")): box for box in boxes}
    paths = [path.get("d") for path in picture.iter(f"{space}path") if path.get("marker-end")]
    assert (len(boxes), len(paths)) == (4, 3)
    for path in paths:
        heights = [float(y) for _, y in re.findall(r"(-?\d+),(-?\d+)", path)]
        assert heights == sorted(heights) and heights[0] < heights[-1]
        assert heights[-1] in tops
