"""Draw the rooms of the estimator's package on their floors, with the imports that the sources really have.

Usage: scripts/draw_rooms.py [FILE]          (default docs/images/rooms.svg)

Floors are those of [tool.softtissue] in pyproject.toml, sentences the docstrings of the packages. An arrow that
follows from others (from A to C, where A has one to B and B one to C) is left out.
"""

import ast
import sys
import textwrap
import tomllib
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).parents[1]
CORE = ROOT / "softtissue_estimator" / "softtissue_estimator"
TRAINING = ROOT / "training" / "softtissue_training"

# Pixels.
BOX_WIDTH, BOX_HEIGHT, LANE_WIDTH, GAP, FLOOR_HEIGHT, MARGIN = 226, 88, 6, 16, 122, 14
LETTERS_A_LINE = 30
# Colour of a room by the first part of its name.
COLOURS = {"estimators": "#dfecfb", "ros": "#e3f4de", "softtissue_training": "#fdf0dc"}
PLAIN, EDGE, ARROW = "#f2f3f5", "#8a97a6", "#6b7a8c"


@dataclass(eq=False)
class Place:
    """Something on a floor: a room, or (without a name) a lane in which an arrow passes the rooms of the floor."""

    name: str
    floor: int
    x: float = 0.0  # of its middle, pixels
    above: list["Place"] = field(default_factory=list)
    below: list["Place"] = field(default_factory=list)

    @property
    def width(self) -> float:
        """Width in pixels."""
        return BOX_WIDTH if self.name else LANE_WIDTH


def sources(package: Path) -> dict[str, Path]:
    """Modules of a package by their dotted names below it; the package itself left out."""
    paths = {path.relative_to(package).with_suffix("").parts: path for path in sorted(package.rglob("*.py"))}
    names = {
        ".".join(parts[:-1] if parts[-1] == "__init__" else parts): path for parts, path in paths.items()
    }
    return {name: path for name, path in names.items() if name}


def imported_modules(path: Path, package: Path) -> set[str]:
    """Dotted names, below the estimator's package, of all that a file imports, also inside functions."""
    inside = (package.name, *path.relative_to(package).parts[:-1])
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = inside[: len(inside) - node.level + 1] if node.level else ()
            origin = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{origin}.{alias.name}" for alias in node.names}
    return {name.removeprefix(f"{CORE.name}.") for name in found if name.startswith(f"{CORE.name}.")}


def smallest_room(module: str, rooms: list[str]) -> str:
    """Room in which a module lies; '' for what is in none, such as a name of the package itself."""
    return max((room for room in rooms if f"{module}.".startswith(f"{room}.")), key=len, default="")


def imports_between(rooms: list[str]) -> dict[str, set[str]]:
    """Rooms that each room imports, and those that the training package imports."""
    found: dict[str, set[str]] = {room: set() for room in [*rooms, TRAINING.name]}
    for package in (CORE, TRAINING):
        for module, path in sources(package).items():
            room = smallest_room(module, rooms) if package is CORE else TRAINING.name
            if room:
                imported = {smallest_room(name, rooms) for name in imported_modules(path, package)}
                found[room] |= imported - {room, ""}
    return found


def without_what_follows(arrows: dict[str, set[str]]) -> dict[str, set[str]]:
    """Leave out each arrow that a longer way of arrows implies."""

    def reached(room: str) -> set[str]:
        return arrows[room].union(*(reached(other) for other in arrows[room]))

    return {
        room: {other for other in others if not any(other in reached(via) for via in others - {other})}
        for room, others in arrows.items()
    }


def docstring(room: str) -> str:
    """First line of a room's docstring, without the signs that format it."""
    path = TRAINING if room == TRAINING.name else CORE.joinpath(*room.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0].replace("`", "").removesuffix(".")


def put_on_floors(floors: list[list[str]], arrows: dict[str, set[str]]) -> list[list[Place]]:
    """Rooms on their floors and, where an arrow passes a floor, a lane."""
    rows = [[Place(name, number) for name in names] for number, names in enumerate(floors)]
    rooms = {place.name: place for row in rows for place in row}
    for upper in rooms.values():
        for lower in (rooms[name] for name in sorted(arrows[upper.name])):
            start = upper
            for number in range(upper.floor - 1, lower.floor, -1):
                lane = Place("", number)
                rows[number].append(lane)
                connect(start, lane)
                start = lane
            connect(start, lower)
    return rows


def connect(upper: Place, lower: Place) -> None:
    """Let an arrow lead from one place to one on the floor below."""
    upper.below.append(lower)
    lower.above.append(upper)


def mean_x(places: list[Place], otherwise: float) -> float:
    """Mean of where places are; another number if there are none."""
    return sum(place.x for place in places) / len(places) if places else otherwise


def number_in_order(row: list[Place]) -> None:
    """Give the places of a floor coordinates of one distance, in their order."""
    for number, place in enumerate(row):
        place.x = (number - (len(row) - 1) / 2) * BOX_WIDTH


def crossings(rows: list[list[Place]]) -> int:
    """How often arrows cross, for places in order."""
    total = 0
    for row in rows:
        ends = [end for place in row for end in sorted(lower.x for lower in place.below)]
        total += sum(left > right for number, left in enumerate(ends) for right in ends[number + 1 :])
    return total


def order(rows: list[list[Place]]) -> None:
    """Order the places of every floor so that few arrows cross (means of neighbours, downwards and upwards in turn)."""
    best: list[list[Place]] = []
    fewest = None
    for row in rows:
        number_in_order(row)
    for sweep in range(24):
        for row in rows if sweep % 2 else reversed(rows):
            row.sort(key=lambda place: mean_x(place.below if sweep % 2 else place.above, place.x))
            number_in_order(row)
        if fewest is None or crossings(rows) < fewest:
            fewest, best = crossings(rows), [list(row) for row in rows]
    rows[:] = best


def spread(row: list[Place]) -> None:
    """Move the places of a floor, which are in order, apart where they overlap."""
    for _ in range(80):
        for left, right in pairwise(row):
            overlap = left.x + (left.width + right.width) / 2 + GAP - right.x
            if overlap > 0:
                left.x -= overlap / 2
                right.x += overlap / 2


def align(rows: list[list[Place]]) -> None:
    """Put what belongs together one above the other; lanes of one arrow most of all, so that it is straight."""
    for _ in range(200):
        for row in rows:
            for place in row:
                weight = {
                    other: (1 if place.name else 12) * (1 if other.name else 12)
                    for other in place.above + place.below
                }
                total = sum(weight.values())
                place.x = (
                    sum(other.x * share for other, share in weight.items()) / total if total else place.x
                )
            spread(row)


def box(room: Place, x: float, y: float) -> list[str]:
    """Box of a room about a point: its name, and what it is for."""
    colour = COLOURS.get(room.name.partition(".")[0], PLAIN)
    lines = textwrap.wrap(docstring(room.name), LETTERS_A_LINE)
    top = y - 8 * len(lines) + 6
    return [
        f'<rect x="{x - BOX_WIDTH / 2:.0f}" y="{y - BOX_HEIGHT / 2:.0f}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" '
        f'rx="6" fill="{colour}" stroke="{EDGE}"/>',
        f'<text x="{x:.0f}" y="{top:.0f}" font-size="15" font-weight="bold">{escape(room.name)}</text>',
        *(
            f'<text x="{x:.0f}" y="{top + 16 * (number + 1):.0f}" font-size="12.5">{escape(line)}</text>'
            for number, line in enumerate(lines)
        ),
    ]


def arrow(points: list[tuple[float, float]]) -> str:
    """Curve through points from above to below that enters and leaves each of them vertically."""
    path = f"M{points[0][0]:.0f},{points[0][1]:.0f}"
    for (x, y), (next_x, next_y) in pairwise(points):
        half = (y + next_y) / 2
        path += f" C{x:.0f},{half:.0f} {next_x:.0f},{half:.0f} {next_x:.0f},{next_y:.0f}"
    return f'<path d="{path}" fill="none" stroke="{ARROW}" stroke-width="1.4" marker-end="url(#head)"/>'


def port(place: Place, neighbours: list[Place], neighbour: Place) -> float:
    """Where on a place's edge the arrow to or from a neighbour is, so that arrows do not fall upon each other."""
    if not place.name:
        return place.x
    ordered = sorted(neighbours, key=lambda other: other.x)
    return place.x + (ordered.index(neighbour) - (len(ordered) - 1) / 2) * min(40, 180 / len(ordered))


def arrows_of(room: Place, ground: float) -> list[str]:
    """All arrows that leave a room."""

    def edge(place: Place, down: float) -> float:
        return ground - place.floor * FLOOR_HEIGHT + down * BOX_HEIGHT / 2

    drawn = []
    for first in room.below:
        points, upper, lower = [(port(room, room.below, first), edge(room, 1))], room, first
        while not lower.name:
            points += [(lower.x, edge(lower, -1)), (lower.x, edge(lower, 1))]
            upper, [lower] = lower, lower.below
        drawn.append(arrow([*points, (port(lower, lower.above, upper), edge(lower, -1))]))
    return drawn


def draw(floors: list[list[str]], arrows: dict[str, set[str]]) -> str:
    """Return the picture as SVG."""
    rows = put_on_floors(floors, arrows)
    order(rows)
    align(rows)
    places = [place for row in rows for place in row]
    shift = MARGIN - min(place.x - place.width / 2 for place in places)
    for place in places:
        place.x += shift
    width = round(max(place.x + place.width / 2 for place in places) + MARGIN)
    height = (len(rows) - 1) * FLOOR_HEIGHT + BOX_HEIGHT + 2 * MARGIN
    ground = height - MARGIN - BOX_HEIGHT / 2
    rooms = [place for place in places if place.name]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
            'font-family="DejaVu Sans, Verdana, Arial, sans-serif" text-anchor="middle" fill="#1d2733">',
            "<title>Rooms of softtissue_estimator on their floors; an arrow is an import</title>",
            '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" '
            f'orient="auto"><path d="M0,0 L8,4 L0,8 z" fill="{ARROW}"/></marker></defs>',
            f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
            *(line for room in rooms for line in arrows_of(room, ground)),
            *(line for room in rooms for line in box(room, room.x, ground - room.floor * FLOOR_HEIGHT)),
            "</svg>",
            "",
        ]
    )


def floors_of_core() -> list[list[str]]:
    """Rooms on each floor, from the ground up."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["softtissue"]
    return [list(rooms) for rooms in settings["floors"]]


def picture_of_rooms() -> str:
    """Draw the rooms as they are now, and the training package above them."""
    floors = floors_of_core()
    arrows = imports_between([room for rooms in floors for room in rooms])
    floors[-1].append(TRAINING.name)
    return draw(floors, without_what_follows(arrows))


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images" / "rooms.svg"
    target.write_text(picture_of_rooms(), encoding="utf-8")
