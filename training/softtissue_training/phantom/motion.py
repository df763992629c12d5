"""The organ's motion: a sequence of equilibria under a changing push, and what lies between them in time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from softtissue_training.errors import SolverDivergedError
from softtissue_training.phantom.anatomy import Anatomy
from softtissue_training.phantom.filled_shape import fill
from softtissue_training.phantom.mooney_rivlin import mooney_rivlin
from softtissue_training.phantom.quadratic_mesh import Interpolator, QuadraticMesh, to_quadratic
from softtissue_training.phantom.spec import PhantomSpec, Push
from softtissue_training.phantom.statics import Body, Equilibrium

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """A motion that can be asked for any time and place.

    Attributes
    ----------
    times
        (s,) s, of the computed equilibria; the first is the undeformed state.
    displacement
        (s, n, 3) m at the nodes.
    interpolator
        From nodes to points of the undeformed organ.
    equilibria
        One for each time but the first.
    forces
        (s, 3) N, total applied force.
    """

    times: Array
    displacement: Array
    interpolator: Interpolator
    equilibria: tuple[Equilibrium, ...]
    forces: Array

    def nodal(self, time: float) -> Array:
        """Nodal displacement ``(n, 3)`` m at a time (s), by a cubic spline through the equilibria."""
        return np.asarray(self._spline(time))

    def at(self, weights: sparse.csr_array, time: float) -> Array:
        """Displacement ``(k, 3)`` m at the points of an interpolation matrix and a time (s)."""
        return np.asarray(weights @ self.nodal(time))

    @property
    def peak_time(self) -> float:
        """Time (s) of the computed state with the largest mean nodal displacement."""
        mean = np.linalg.norm(self.displacement, axis=2).mean(axis=1)
        return float(self.times[int(np.argmax(mean))])

    @property
    def worst_residual(self) -> float:
        """Largest relative residual of all equilibria."""
        return max(state.residual for state in self.equilibria)

    @property
    def worst_imbalance(self) -> float:
        """Largest distance (N) between the attachment's reaction and minus the applied force."""
        reactions = np.array([state.reaction for state in self.equilibria])
        return float(np.linalg.norm(reactions + self.forces[1:], axis=1).max())

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.times, self.displacement)


def simulate(anatomy: Anatomy, spec: PhantomSpec, progress: Callable[[str], None] = lambda _: None) -> Motion:
    """Push the organ and follow its equilibria through time.

    Raises
    ------
    SolverDivergedError
        If an equilibrium is not found.
    MeshError
        If the organ cannot be filled with elements.
    """
    held = hold(anatomy, spec)
    share = held.shares(spec.push)
    times = np.linspace(0.0, spec.duration, spec.states)
    forces = np.stack([push_force(spec.push, time / spec.duration) for time in times])
    return follow(held, times, [share[:, None] * force for force in forces], progress)


@dataclass(frozen=True)
class HeldOrgan:
    """The organ as finite elements that are held where it is attached.

    Attributes
    ----------
    mesh
        n nodes.
    body
        Finds equilibria under forces at the nodes.
    attached
        (n,) bool.
    """

    mesh: QuadraticMesh
    body: Body
    attached: NDArray[np.bool_]

    def shares(self, push: Push) -> Array:
        """Share ``(n,)`` of a push that each node carries; attached ones carry nothing."""
        share = push_shares(self.mesh, push)
        share[self.attached] = 0.0
        share /= share.sum()
        return share


def hold(anatomy: Anatomy, spec: PhantomSpec) -> HeldOrgan:
    """Fill an organ with elements of the phantom's tissue and hold it where it is attached.

    Raises
    ------
    MeshError
        If the organ cannot be filled with elements.
    """
    mesh = to_quadratic(fill(anatomy.shape, spec.element_size))
    attached = attached_nodes(mesh, anatomy)
    body = Body(mesh, mooney_rivlin(spec.youngs_modulus_pa, spec.poisson_ratio), attached)
    return HeldOrgan(mesh, body, attached)


def follow(
    held: HeldOrgan, times: Array, loads: Sequence[Array], progress: Callable[[str], None] = lambda _: None
) -> Motion:
    """Follow an organ's equilibria from the undeformed state through changing loads.

    Parameters
    ----------
    held : the organ, n nodes
    times : (s,) s; the organ is undeformed at the first one
    loads : (n, 3) N for each of the times; the first is taken to be none

    Raises
    ------
    SolverDivergedError
        If an equilibrium is not found.
    """
    states = [np.zeros_like(held.mesh.nodes)]
    equilibria = []
    forces = np.stack([load.sum(axis=0) for load in loads])
    for number in range(1, len(times)):
        equilibria.append(_advance(held.body, loads[number - 1], loads[number], states[-1]))
        states.append(equilibria[-1].displacement)
        progress(
            f"equilibrium {number} of {len(times) - 1}: {np.linalg.norm(forces[number]):.2f} N, "
            f"{equilibria[-1].iterations} iterations, residual {equilibria[-1].residual:.0e}"
        )
    return Motion(times, np.stack(states), Interpolator(held.mesh), tuple(equilibria), forces)


def _advance(body: Body, before: Array, now: Array, start: Array, halvings: int = 3) -> Equilibrium:
    """Follow the equilibrium from one load ``(n, 3)`` N to the next, by way of half the change where that is needed."""
    try:
        return body.solve(now, start)
    except SolverDivergedError:
        if halvings == 0:
            raise
    middle = 0.5 * (before + now)
    half_way = _advance(body, before, middle, start, halvings - 1)
    return _advance(body, middle, now, half_way.displacement, halvings - 1)


def attached_nodes(mesh: QuadraticMesh, anatomy: Anatomy) -> NDArray[np.bool_]:
    """Nodes ``(n,)`` of the boundary, corners and midsides, whose nearest surface vertex is attached.

    Asking each node for itself keeps the attached share that of the organ's surface, whatever the element size.
    """
    boundary = np.unique(np.concatenate([mesh.faces, mesh.face_midsides]))
    attached = np.zeros(len(mesh.nodes), dtype=bool)
    nearest = cKDTree(anatomy.surface.vertices).query(mesh.nodes[boundary])[1]
    attached[boundary] = anatomy.attached[nearest]
    return attached


def push_shares(mesh: QuadraticMesh, push: Push) -> Array:
    """Share ``(n,)`` of the force that each node carries: a bell over the surface around the pushed point.

    A constant load on a straight-edged quadratic triangle goes to its midside nodes, a third of the area to each;
    a smooth one is taken at those nodes.
    """
    corners = mesh.nodes[mesh.faces]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    used = np.unique(mesh.faces)
    centre = mesh.nodes[used[int(cKDTree(mesh.nodes[used]).query(np.array(push.point))[1])]]
    distance = np.linalg.norm(mesh.nodes[mesh.face_midsides] - centre, axis=2)
    load = np.exp(-0.5 * (distance / push.radius) ** 2) * area[:, None] / 3.0
    share = np.bincount(mesh.face_midsides.ravel(), weights=load.ravel(), minlength=len(mesh.nodes))
    result: Array = share / share.sum()
    return result


def push_force(push: Push, phase: float) -> Array:
    """Force ``(3,)`` N at a phase of the recording, 0 to 1: it rises, sways to the sides and is half released."""
    direction = np.array(push.direction) / np.linalg.norm(push.direction)
    sway = np.array(push.sway) / np.linalg.norm(push.sway)
    along = _smooth_step(phase / 0.4) - 0.55 * _smooth_step((phase - 0.72) / 0.26)
    window = _smooth_step((phase - 0.3) / 0.15) * (1.0 - _smooth_step((phase - 0.65) / 0.2))
    across = 0.15 * window * np.sin(2.0 * np.pi * (phase - 0.3) / 0.3)
    force: Array = push.peak_n * (along * direction + across * sway)
    return force


def _smooth_step(x: float) -> float:
    """Rise from 0 to 1 between x = 0 and x = 1 with two continuous derivatives."""
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
