"""Our solver beside other programs on the same random organs and loads: differences and processor time."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from softtissue_training.comparison.calculix import calculix_program, solve_with_calculix
from softtissue_training.comparison.felupe_solver import solve_with_felupe
from softtissue_training.comparison.scikit_fem import solve_with_scikit_fem
from softtissue_training.comparison.torch_fem import solve_with_torch_fem
from softtissue_training.errors import SolverDivergedError
from softtissue_training.physics.material import Law, Material
from softtissue_training.physics.solver import solve
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.simulate import simulate

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Case:
    """One body and its load, as the arguments of `softtissue_training.physics.solver.solve`."""

    vertices: FloatArray
    tets: IntArray
    fixed: BoolArray
    force: FloatArray
    material: Material


@dataclass(frozen=True)
class Program:
    """A program that solves cases.

    Attributes
    ----------
    name
        With its version.
    licence
        SPDX identifier.
    solve
        Returns the displacement, (n, 3) metres.
    """

    name: str
    licence: str
    solve: Callable[[Case], FloatArray]


@dataclass
class Score:
    """What one program did.

    Attributes
    ----------
    seconds
        Processor time of each case that was solved, seconds.
    difference_m
        Largest difference to our displacement in each case, metres.
    relative
        The same over the case's largest displacement.
    failed
        Cases without an answer.
    """

    seconds: list[float] = field(default_factory=list)
    difference_m: list[float] = field(default_factory=list)
    relative: list[float] = field(default_factory=list)
    failed: int = 0


def random_cases(count: int, seed: int, law: Law) -> Iterator[Case]:
    """Draw organs and loads of the paper's recipe for which our solver finds an equilibrium."""
    for number in range(count):
        sample = simulate(seed, number, Recipe(laws=(law,))).simulations[0]
        fixed = np.zeros(len(sample.vertices), dtype=bool)
        fixed[sample.attached] = True
        yield Case(
            sample.vertices.astype(np.float64),
            sample.tets.astype(np.int64),
            fixed,
            sample.force.astype(np.float64),
            sample.material,
        )


def programs(law: Law) -> list[Program]:
    """Return our solver and the others that are installed and have the law."""
    found = [Program("softtissue-training", "Apache-2.0", _ours)]
    if find_spec("torchfem") is not None:
        found.append(Program(f"torch-fem {version('torch-fem')}", "MIT", _adapt(solve_with_torch_fem)))
    if find_spec("felupe") is not None:
        found.append(Program(f"FElupe {version('felupe')}", "GPL-3.0-or-later", _adapt(solve_with_felupe)))
    if find_spec("skfem") is not None:
        name = f"scikit-fem {version('scikit-fem')}"
        found.append(Program(name, "BSD-3-Clause", _adapt(solve_with_scikit_fem)))
    if law == "st_venant_kirchhoff" and calculix_program() is not None:
        found.append(Program("CalculiX", "GPL-2.0-or-later", _calculix))
    return found


def compare(cases: Iterator[Case], candidates: list[Program]) -> dict[str, Score]:
    """Solve every case with every program; the first is what the others are compared with.

    Each program solves the first case once before its time is taken, so that loading it does not count.
    """
    scores = {program.name: Score() for program in candidates}
    for number, case in enumerate(cases):
        reference = candidates[0].solve(case)
        largest = float(np.linalg.norm(reference, axis=1).max())
        for program in candidates:
            score = scores[program.name]
            try:
                if number == 0:
                    program.solve(case)
                start = _processor_seconds()
                answer = program.solve(case)
                score.seconds.append(_processor_seconds() - start)
            except SolverDivergedError:
                score.failed += 1
                continue
            difference = float(np.linalg.norm(answer - reference, axis=1).max())
            score.difference_m.append(difference)
            score.relative.append(difference / largest)
    return scores


def table(scores: dict[str, Score], candidates: list[Program]) -> str:
    """Return a Markdown table of the scores."""
    lines = [
        "| program | licence | solved | CPU s, mean | median | largest difference, mm | of the displacement |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for program in candidates:
        score = scores[program.name]
        solved = len(score.seconds)
        if not solved:
            lines.append(f"| {program.name} | {program.licence} | 0 of {score.failed} | | | | |")
            continue
        lines.append(
            f"| {program.name} | {program.licence} | {solved} of {solved + score.failed} "
            f"| {np.mean(score.seconds):.2f} | {np.median(score.seconds):.2f} "
            f"| {1e3 * max(score.difference_m):.1e} | {max(score.relative):.1e} |"
        )
    return "\n".join(lines)


def _ours(case: Case) -> FloatArray:
    return solve(case.vertices, case.tets, case.fixed, case.force, case.material).displacement


def _calculix(case: Case) -> FloatArray:
    return solve_with_calculix(case.vertices, case.tets, case.fixed, case.force, case.material)[0]


def _adapt(function: Callable[..., FloatArray]) -> Callable[[Case], FloatArray]:
    return lambda case: function(case.vertices, case.tets, case.fixed, case.force, case.material)


def _processor_seconds() -> float:
    """User and system time of this process and of the programs it has waited for."""
    mine, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return mine.ru_utime + mine.ru_stime + children.ru_utime + children.ru_stime
