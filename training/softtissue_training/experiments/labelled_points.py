"""Points with names, as markers and landmarks are: a value, and pairs of the same name."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import FloatArray


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """Points with a label each, in the order of their file.

    Parameters
    ----------
    labels : tuple of str
        Need not differ from each other.
    points : (n, 3) float64
        m.

    Raises
    ------
    InvalidInputError
        The shapes do not fit or a coordinate is not finite.
    """

    labels: tuple[str, ...]
    points: FloatArray

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points, dtype=np.float64)
        if points.shape != (len(self.labels), 3):
            raise InvalidInputError(
                f"labelled points: expected shape ({len(self.labels)}, 3), one row a label, got {points.shape}"
            )
        if not np.isfinite(points).all():
            bad = [
                label
                for label, point in zip(self.labels, points, strict=True)
                if not np.isfinite(point).all()
            ]
            raise InvalidInputError(
                f"labelled points: expected finite coordinates, got others at {', '.join(bad)}"
            )
        object.__setattr__(self, "points", points)

    def __len__(self) -> int:
        return len(self.labels)


def match_labels(
    first: LabelledPoints, second: LabelledPoints, what: str = "points"
) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Pair the points of two lists that bear the same label.

    Parameters
    ----------
    first, second : LabelledPoints
        For example markers before and after a deformation; their order may differ.
    what : str
        What the points are, for messages.

    Returns
    -------
    labels : tuple of str
        In the order of `first`.
    first_points, second_points : (n, 3) float64
        m, row by row of the same label.

    Raises
    ------
    InvalidInputError
        A label occurs twice in a list or in one list only.
    """
    for name, points in (("first", first), ("second", second)):
        twice = sorted(label for label, count in Counter(points.labels).items() if count > 1)
        if twice:
            raise InvalidInputError(
                f"{what}: expected every label once in the {name} list, got {', '.join(twice)} more than once"
            )
    row = {label: i for i, label in enumerate(second.labels)}
    alone = sorted(set(first.labels) ^ set(second.labels))
    if alone:
        raise InvalidInputError(
            f"{what}: expected the same labels in both lists, got {', '.join(alone)} in one of them only"
        )
    return first.labels, first.points, second.points[[row[label] for label in first.labels]]
