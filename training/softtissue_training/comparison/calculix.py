"""CalculiX (program `ccx`, GPL-2) run on a body of four-node tetrahedra.

Its `*ELASTIC` with `NLGEOM` is St Venant-Kirchhoff. Its user material `CIARLET_EL`,

    W = mu/2 (tr C - 3) - (mu + lambda/2) ln J + lambda/4 (J^2 - 1),

is our neo-Hookean law at a Poisson's ratio of zero, where lambda is; above that it has none of ours.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.errors import SolverDivergedError
from softtissue_training.physics.material import Material
from softtissue_training.physics.pressure import SurfacePressure

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_FACES = ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3))  # P1 to P4 of CalculiX's tetrahedra, corners sorted
_JOB = "body"


def calculix_program() -> str | None:
    """Return the path of `ccx`, or None where it is not installed."""
    return shutil.which("ccx")


def solve_with_calculix(
    vertices: FloatArray,
    tets: IntArray,
    fixed: BoolArray,
    force: FloatArray,
    material: Material,
    *,
    pressure: SurfacePressure | None = None,
    increment: float = 0.2,
) -> tuple[FloatArray, FloatArray]:
    """Solve for the equilibrium under dead forces and pressure that follows the surface.

    Parameters
    ----------
    vertices, tets, fixed, force, material, pressure
        As in `physics.solver.solve`; the material is St Venant-Kirchhoff, or neo-Hookean with a Poisson's
        ratio of zero.
    increment
        Share of the load in each increment, as long as they converge. CalculiX lets pressure follow the surface from
        one to the next.

    Returns
    -------
    FloatArray
        (n, 3) metres, displacement, to seven digits.
    FloatArray
        (n, 3) newtons, internal forces at the fixed vertices, to seven digits: the reactions where no pressure acts.

    Raises
    ------
    InvalidInputError
        CalculiX has no such material, or is not installed.
    SolverDivergedError
        CalculiX stopped before the full load.
    """
    program = calculix_program()
    if program is None:
        raise InvalidInputError("CalculiX is not installed: apt-get install calculix-ccx")
    if fixed.ndim == 1:
        fixed = np.repeat(fixed[:, None], 3, axis=1)
    deck = _deck(vertices, tets, fixed, force, material, pressure, increment)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / f"{_JOB}.inp").write_text(deck)
        done = subprocess.run([program, _JOB], cwd=folder, capture_output=True, text=True, check=False)
        output = folder / f"{_JOB}.dat"
        if done.returncode != 0 or "*ERROR" in done.stdout or not output.exists():
            reason = [line for line in done.stdout.splitlines() if "*ERROR" in line][:1]
            raise SolverDivergedError(f"CalculiX stopped with code {done.returncode}: {' '.join(reason)}")
        tables = _tables(output.read_text(), len(vertices))
    displacement, internal = tables["displacements"], tables["forces"]
    return displacement, np.where(fixed, internal, 0.0)


def _deck(
    vertices: FloatArray,
    tets: IntArray,
    fixed: BoolArray,
    force: FloatArray,
    material: Material,
    pressure: SurfacePressure | None,
    increment: float,
) -> str:
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{i},{x:.12e},{y:.12e},{z:.12e}" for i, (x, y, z) in enumerate(vertices.tolist(), 1)]
    lines += ["*ELEMENT, TYPE=C3D4, ELSET=BODY"]
    lines += [f"{i},{a},{b},{c},{d}" for i, (a, b, c, d) in enumerate((tets + 1).tolist(), 1)]
    lines += [*_material_cards(material), "*BOUNDARY"]
    lines += [f"{vertex + 1},{component + 1}" for vertex, component in np.argwhere(fixed).tolist()]
    lines += ["*STEP, NLGEOM, INC=1000", "*STATIC", f"{increment},1.,1e-5,{increment}"]
    lines += ["*CONTROLS, PARAMETERS=FIELD", "1e-7,1e-7"]
    loaded = np.argwhere((force != 0.0) & ~fixed)
    if len(loaded):
        lines += ["*CLOAD"]
        lines += [f"{i + 1},{k + 1},{force[i, k]:.12e}" for i, k in loaded.tolist()]
    if pressure is not None:
        lines += ["*DLOAD", *_pressure_cards(pressure, tets)]
    lines += ["*NODE PRINT, NSET=ALL, FREQUENCY=100000", "U,RF", "*END STEP", ""]
    return "\n".join(lines)


def _material_cards(material: Material) -> list[str]:
    constants = f"{material.youngs_modulus_pa:.12e},{material.poisson_ratio:.12e}"
    if material.law == "st_venant_kirchhoff":
        name, cards = "TISSUE", ["*ELASTIC", constants]
    elif material.poisson_ratio == 0.0:
        name, cards = "CIARLET_EL", ["*USER MATERIAL, CONSTANTS=2", constants]
    else:
        raise InvalidInputError(
            "CalculiX has our neo-Hookean law for a Poisson's ratio of 0 only, "
            f"got {material.poisson_ratio}; compare St Venant-Kirchhoff"
        )
    return [f"*MATERIAL, NAME={name}", *cards, f"*SOLID SECTION, ELSET=BODY, MATERIAL={name}"]


def _pressure_cards(pressure: SurfacePressure, tets: IntArray) -> list[str]:
    label = {
        tuple(sorted(tet[corner] for corner in corners)): f"{element},P{side}"
        for element, tet in enumerate(tets.tolist(), 1)
        for side, corners in enumerate(_FACES, 1)
    }
    return [
        f"{label[tuple(sorted(face))]},{value:.12e}"
        for face, value in zip(pressure.faces.tolist(), pressure.pressure_pa.tolist(), strict=True)
        if value
    ]


def _tables(text: str, count: int) -> dict[str, FloatArray]:
    """Return the last table of each quantity, (n, 3), by the first word of its heading."""
    found: dict[str, FloatArray] = {}
    blocks = text.split("\n\n")
    for heading, table in pairwise(blocks):
        words = heading.split()
        if not words or words[0] not in ("displacements", "forces"):
            continue
        rows = np.array([line.split() for line in table.splitlines()], dtype=np.float64)
        values = np.zeros((count, 3))
        values[rows[:, 0].astype(np.int64) - 1] = rows[:, 1:]
        if float(words[-1]) == 1.0:
            found[words[0]] = values
    if found.keys() != {"displacements", "forces"}:
        raise SolverDivergedError("CalculiX did not reach the full load")
    return found
