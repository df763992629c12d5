"""The same simulation gives the same bits in other processes, with other numbers of threads and other memory."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from softtissue_training.physics.material import LAWS, Material
from softtissue_training.physics.solver import solve
from verification.blocks import block


def digest(law):
    """Hash of the bits of a strongly bent bar."""
    vertices, tets = block(cells=8)
    vertices = vertices * [0.3, 0.1, 0.1]
    force = np.zeros_like(vertices)
    force[vertices[:, 0] == 0.3] = [0.0, 0.0, 0.004]
    solution = solve(vertices, tets, vertices[:, 0] == 0.0, force, Material(law))
    assert solution.displacement[:, 2].max() > 0.02
    return hashlib.sha256(solution.displacement.tobytes() + solution.reaction.tobytes()).hexdigest()


@pytest.mark.parametrize("law", LAWS)
def test_other_processes_give_the_same_bits(law):
    script = (
        "import sys; padding = bytearray(int(sys.argv[2]));"
        "from verification.test_reproducibility import digest; print(digest(sys.argv[1]))"
    )
    found = set()
    for threads, padding in (("1", "1"), ("2", "100003")):
        environment = os.environ | {"OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
        environment["PYTHONPATH"] = os.pathsep.join(sys.path)
        command = [sys.executable, "-c", script, law, padding]
        found.add(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
    assert found == {digest(law) + "\n"}
