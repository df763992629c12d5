"""Our solver beside other programs: the same answers, counted failures, a readable table."""

import numpy as np
import pytest

from softtissue_training.comparison.compare import Case, Program, compare, programs, table
from softtissue_training.errors import SolverDivergedError
from softtissue_training.physics.material import LAWS, Material
from verification.blocks import lattice


def _bar(law):
    vertices, tets = lattice((6, 2, 2), (0.20, 0.06, 0.06))
    force = np.zeros_like(vertices)
    force[vertices[:, 0] == 0.2] = [0.001, 0.0005, 0.004]
    return Case(vertices, tets, vertices[:, 0] == 0.0, force, Material(law))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("law", LAWS)
def test_every_installed_program_gives_our_displacement(law):
    candidates = programs(law)
    assert len(candidates) > 1
    scores = compare(iter([_bar(law)]), candidates)
    for program in candidates:
        assert scores[program.name].failed == 0
        assert scores[program.name].relative[0] < 1e-5, program.name


def test_differences_and_failures_are_counted():
    case = _bar("neo_hookean")
    reference = np.zeros_like(case.vertices)
    reference[3] = [0.0, 0.03, 0.04]

    def fails(_):
        raise SolverDivergedError("no")

    candidates = [
        Program("ours", "A", lambda _: reference),
        Program("close", "B", lambda _: 1.1 * reference),
        Program("fails", "C", fails),
    ]
    scores = compare(iter([case, case]), candidates)
    assert scores["close"].difference_m == pytest.approx([0.005, 0.005])
    assert scores["close"].relative == pytest.approx([0.1, 0.1])
    assert (scores["fails"].failed, scores["fails"].seconds) == (2, [])
    lines = table(scores, candidates).splitlines()
    assert lines[3].startswith("| close | B | 2 of 2 |") and lines[3].endswith("| 5.0e+00 | 1.0e-01 |")
    assert lines[4] == "| fails | C | 0 of 2 | | | | |"
