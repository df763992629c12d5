"""Two equilibria of the liver, exhaled and inhaled, under what surrounds it.

Exhaled, the liver hangs on the vena cava and rests on a soft bed of other organs, held in front by the falciform
ligament, under the part of its weight that its neighbours do not carry. Inhaled, the diaphragm has moved down as
well: it is a stiff foundation on the upper surface that acts across the surface alone, so that the liver slides along
it. The preoperative state is the exhaled equilibrium, not the body at rest; it has stresses of its own that no
estimator knows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.experiments.breathing_liver.exponential_tissue import exponential_tissue
from softtissue_training.experiments.breathing_liver.liver import Anatomy
from softtissue_training.experiments.breathing_liver.spec import BreathingSpec
from softtissue_training.organs.tetrahedralise import signed_volumes, tetrahedralise
from softtissue_training.phantom.isosurface import isosurface
from softtissue_training.phantom.quadratic_mesh import Interpolator, QuadraticMesh, to_quadratic
from softtissue_training.phantom.statics import Body, Equilibrium
from softtissue_training.physics.load_stepping import apply_load

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

CAVA_REACH_M = 0.005
"""Surface closer than this to the vena cava is attached to it."""
_DENSITY_KG_M3 = 1060.0
_STANDARD_GRAVITY_M_S2 = 9.81
_DIAPHRAGM_DIRECTION = np.array([0.0, -0.2, 1.0]) / np.linalg.norm([0.0, -0.2, 1.0])
_LIGAMENT_X_M = (0.028, 0.044)  # the strip between the lobes where the falciform ligament begins


@dataclass(frozen=True)
class Breath:
    """What was simulated.

    Attributes
    ----------
    interpolator
        From nodes to points of the body at rest.
    exhaled, inhaled
        (n, 3) m, displacement of the nodes from rest.
    equilibria
        All that were computed on the way.
    nodes
        Number of nodes.
    """

    interpolator: Interpolator
    exhaled: FloatArray
    inhaled: FloatArray
    equilibria: tuple[Equilibrium, ...]
    nodes: int

    def states(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions of points ``(k, 3)`` m of the body at rest: exhaled and inhaled, ``(k, 3)`` m each."""
        weights = self.interpolator.weights(points)
        return points + weights @ self.exhaled, points + weights @ self.inhaled


@dataclass(frozen=True)
class Surroundings:
    """What acts on the nodes.

    Attributes
    ----------
    attached
        (n,) bool, nodes on the vena cava.
    springs
        (n, 3, 3) N/m.
    weight, breath
        (n, 3) N: gravity; what the diaphragm adds when it has moved down.
    """

    attached: BoolArray
    springs: FloatArray
    weight: FloatArray
    breath: FloatArray


def simulate(
    anatomy: Anatomy, spec: BreathingSpec, progress: Callable[[str], None] = lambda _: None
) -> Breath:
    """Find the exhaled and the inhaled equilibrium.

    Raises
    ------
    SolverDivergedError
        If an equilibrium is not found.
    MeshError
        If the organ cannot be filled with elements.
    """
    mesh = _fill(anatomy, spec.element_size)
    around = surroundings(mesh, anatomy, spec)
    tissue = exponential_tissue(spec.youngs_modulus_pa, spec.poisson_ratio, spec.stiffening)
    body = Body(mesh, tissue, around.attached, around.springs)
    found: list[Equilibrium] = []

    def follow(start: FloatArray, before: FloatArray, after: FloatArray, name: str) -> FloatArray:
        def advance(displacement: FloatArray, share: float) -> tuple[FloatArray, int]:
            state = body.solve(before + share * (after - before), displacement)
            found.append(state)
            progress(f"{name}, {100 * share:.0f} %: {state.iterations} iterations")
            return state.displacement, state.iterations

        return apply_load(advance, start)[0]

    nothing = np.zeros_like(mesh.nodes)
    exhaled = follow(nothing, nothing, around.weight, "exhaled")
    inhaled = follow(exhaled, around.weight, around.weight + around.breath, "inhaled")
    return Breath(Interpolator(mesh), exhaled, inhaled, tuple(found), len(mesh.nodes))


def surroundings(mesh: QuadraticMesh, anatomy: Anatomy, spec: BreathingSpec) -> Surroundings:
    """Work out what surrounds the body at rest."""
    normal, area = _face_normals(mesh)
    middle = mesh.nodes[mesh.face_midsides].mean(axis=1)
    diaphragm = _smooth_step((normal @ _DIAPHRAGM_DIRECTION - 0.25) / 0.25)
    strip = (middle[:, 0] > _LIGAMENT_X_M[0]) & (middle[:, 0] < _LIGAMENT_X_M[1]) & (normal[:, 1] < -0.2)
    across = normal[:, :, None] * normal[:, None, :]
    # Gallbladder, stomach, colon, kidney and abdominal wall where there is no diaphragm.
    everyway = spec.bed_pa_m * (1.0 - diaphragm) + spec.ligament_pa_m * strip
    per_area = spec.diaphragm_pa_m * diaphragm[:, None, None] * across + everyway[:, None, None] * np.eye(3)
    moved = np.zeros_like(middle)
    moved[:, 2] = -spec.breath_m * _excursion(middle)
    pulled = spec.diaphragm_pa_m * diaphragm[:, None] * np.einsum("fij,fj->fi", across, moved)
    attached = attached_nodes(mesh, anatomy.cava)
    return Surroundings(
        attached,
        _to_nodes(mesh, area[:, None, None] * per_area),
        _weight(mesh, np.array([0.0, spec.gravity * _DENSITY_KG_M3 * _STANDARD_GRAVITY_M_S2, 0.0])),
        _to_nodes(mesh, area[:, None] * pulled),
    )


def attached_nodes(mesh: QuadraticMesh, cava: SurfaceMesh) -> BoolArray:
    """Nodes ``(n,)`` of the boundary within `CAVA_REACH_M` of the vena cava."""
    boundary = np.unique(np.concatenate([mesh.faces, mesh.face_midsides]))
    squared = igl.point_mesh_squared_distance(mesh.nodes[boundary], cava.vertices, cava.faces)[0]
    attached = np.zeros(len(mesh.nodes), dtype=bool)
    attached[boundary] = np.asarray(squared) <= CAVA_REACH_M**2
    return attached


def _fill(anatomy: Anatomy, size: float) -> QuadraticMesh:
    """Fill the organ with elements of about `size` (m); a little smaller ones where some would be too flat."""
    for factor in (1.0, 0.96, 0.92, 0.88):
        try:
            surface = isosurface(anatomy.shape, *anatomy.shape.box, factor * size)
            return to_quadratic(tetrahedralise(surface, 1.2 * factor * size))
        except MeshError as error:
            problem = error
    raise problem


def _excursion(points: FloatArray) -> FloatArray:
    """Share of the diaphragm's motion ``(n,)`` at points ``(n, 3)`` m: most at the right and behind."""
    return np.clip(0.8 - 4.0 * points[:, 0] + 2.0 * points[:, 1], 0.4, 1.0)


def _face_normals(mesh: QuadraticMesh) -> tuple[FloatArray, FloatArray]:
    """Outward unit normals ``(f, 3)`` and areas ``(f,)`` m^2 of the boundary."""
    corners = mesh.nodes[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    return cross / length[:, None], 0.5 * length


def _to_nodes(mesh: QuadraticMesh, of_face: FloatArray) -> FloatArray:
    """Share what acts on each face, ``(f, ...)``, among nodes, ``(n, ...)``.

    A constant load on a straight-edged quadratic triangle goes to its midside nodes, a third to each.
    """
    count = len(of_face)
    share = sparse.csr_array(
        (np.full(3 * count, 1.0 / 3.0), (mesh.face_midsides.ravel(), np.repeat(np.arange(count), 3))),
        shape=(len(mesh.nodes), count),
    )
    return np.asarray(share @ of_face.reshape(count, -1)).reshape(len(mesh.nodes), *of_face.shape[1:])


def _weight(mesh: QuadraticMesh, per_volume: FloatArray) -> FloatArray:
    """Nodal forces ``(n, 3)`` N of a constant force on the volume, ``(3,)`` N/m^3.

    The integral of a corner's shape function over a straight-edged ten-node tetrahedron is -1/20 of its volume, that of
    a midside's 1/5.
    """
    volume = signed_volumes(mesh.nodes, mesh.elements[:, :4])
    share = np.concatenate([np.full(4, -0.05), np.full(6, 0.2)])
    of_node = np.bincount(
        mesh.elements.ravel(), weights=(volume[:, None] * share).ravel(), minlength=len(mesh.nodes)
    )
    return of_node[:, None] * per_volume


def _smooth_step(x: FloatArray) -> FloatArray:
    """Rise from 0 to 1 between x = 0 and x = 1."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
