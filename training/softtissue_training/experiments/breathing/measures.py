"""What is measured of one answer: how far the deformed structures are off, and the true error where there is one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.experiments.breathing.case import INSIDE, SURFACE, BreathingCase
from softtissue_training.experiments.breathing.tree_distance import (
    DilatedSolid,
    DirectedDistance,
    dice,
    dilate,
    directed_distance,
    symmetric_distance,
)

FloatArray = NDArray[np.float64]

VESSEL = "vessel"
"""Kind of the structures that make up the vessel tree."""


@dataclass(frozen=True, eq=False)
class Question:
    """Which points estimators are asked for, and the answers, all in the organ's frame, m.

    Attributes
    ----------
    points
        (k, 3): vertices of the compared structures in order, then the points of the truth.
    before
        Structures before, by name.
    after
        The same where they were found in the other scan, by name.
    vessels
        Names of those that make up the tree.
    true_after
        (t, 3) where the points of the truth went; (0, 3) without one.
    part
        (t,) which part of the organ they belong to.
    """

    points: FloatArray
    before: dict[str, SurfaceMesh]
    after: dict[str, SurfaceMesh]
    vessels: tuple[str, ...]
    true_after: FloatArray
    part: NDArray[np.str_]

    @cached_property
    def dilated_after(self) -> dict[str, DilatedSolid]:
        """The structures in the other scan, dilated, by name."""
        return {name: dilate(mesh) for name, mesh in self.after.items()}

    def deformed(self, displacement: FloatArray) -> dict[str, SurfaceMesh]:
        """Displace the structures by an answer at `points`, (k, 3) m."""
        found, start = {}, 0
        for name, mesh in self.before.items():
            end = start + len(mesh.vertices)
            found[name] = SurfaceMesh(mesh.vertices + displacement[start:end], mesh.faces)
            start = end
        return found


def make_question(case: BreathingCase, motion: RigidMotion) -> Question:
    """Ask for all that can be compared, when `motion` takes the deformed frame to the organ's."""
    before = {structure.name: structure.mesh for structure in case.compared}
    after = {
        name: SurfaceMesh(motion.apply(case.structures[name].vertices), case.structures[name].faces)
        for name in before
    }
    vessels = tuple(structure.name for structure in case.compared if structure.kind == VESSEL)
    truth = case.truth
    points = [mesh.vertices for mesh in before.values()]
    return Question(
        points=np.concatenate([*points, np.empty((0, 3)) if truth is None else truth.before]),
        before=before,
        after=after,
        # Without a vessel, all that there is to compare takes the tree's place.
        vessels=vessels or tuple(before),
        true_after=np.empty((0, 3)) if truth is None else motion.apply(truth.after),
        part=np.empty(0, dtype=np.str_) if truth is None else truth.part,
    )


def measure(question: Question, displacement: FloatArray) -> dict[str, Any]:
    """Measure an answer, mm.

    Parameters
    ----------
    displacement
        (k, 3) m at the question's points.

    Returns
    -------
    dict
        `vessel_mean_mm`, `vessel_p95_mm`, `vessel_max_mm` and `dice` of the whole tree, each vessel compared with its
        own counterpart; `structures` with the same for each structure; with a truth also `true_mean_mm`,
        `true_p95_mm` and `true_max_mm` inside the organ, and `true_by_part`.
    """
    result: dict[str, Any] = {}
    if question.before:
        compared = {
            name: _Compared(
                directed_distance(mesh, question.after[name]),
                directed_distance(question.after[name], mesh),
                dilate(mesh),
                question.dilated_after[name],
            )
            for name, mesh in question.deformed(displacement).items()
        }
        tree = _summary([compared[name] for name in question.vessels])
        result |= {f"vessel_{name}": tree[name] for name in ("mean_mm", "p95_mm", "max_mm")}
        result["dice"] = tree["dice"]
        result["structures"] = {name: _summary([one]) for name, one in compared.items()}
    if len(question.part):
        count = len(question.part)
        moved = question.points[-count:] + displacement[-count:]
        error = 1e3 * np.linalg.norm(moved - question.true_after, axis=1)
        parts = {str(part): _statistics(error[question.part == part]) for part in np.unique(question.part)}
        # Without points of the inside, everything but the surface is.
        inside = question.part == INSIDE if INSIDE in parts else question.part != SURFACE
        whole = _statistics(error[inside] if inside.any() else error)
        result |= {f"true_{name}": value for name, value in whole.items()}
        result["true_by_part"] = parts
    return result


@dataclass(frozen=True, eq=False)
class _Compared:
    """An estimated structure and the one that was found."""

    there: DirectedDistance
    back: DirectedDistance
    estimated: DilatedSolid
    found: DilatedSolid


def _summary(compared: list[_Compared]) -> dict[str, float]:
    distance = symmetric_distance([one.there for one in compared], [one.back for one in compared])
    return {
        "mean_mm": 1e3 * distance.mean_m,
        "p95_mm": 1e3 * distance.p95_m,
        "max_mm": 1e3 * distance.max_m,
        "dice": dice([one.estimated for one in compared], [one.found for one in compared]),
    }


def _statistics(error_mm: FloatArray) -> dict[str, float]:
    return {
        "mean_mm": float(error_mm.mean()),
        "p95_mm": float(np.percentile(error_mm, 95)),
        "max_mm": float(error_mm.max()),
    }
