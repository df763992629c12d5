"""Neo-Hookean tetrahedra: internal forces of a deformed organ, and the organ made linear about that deformation.

The law of the elements is in `neo_hookean`. The volumetric strain is averaged at the nodes (`averaged_volume`), which
coarse elements of a nearly incompressible organ need.

Everything runs on one torch device. Forces are in double precision; the stiffness, which only decides how fast the
iteration converges, in single.
"""

import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from softtissue_estimator.errors import OrganError
from softtissue_estimator.estimators.elastic.averaged_volume import AveragedVolume
from softtissue_estimator.estimators.elastic.elasticity import lame_constants, shape_gradients
from softtissue_estimator.estimators.elastic.layered_cholesky import (
    LayeredFactor,
    Layers,
    factorise,
    layers_of,
)
from softtissue_estimator.estimators.elastic.neo_hookean import (
    COLLAPSED_VOLUME_RATIO,
    ElementResponse,
    NeoHookeanElements,
    determinant,
)
from softtissue_estimator.estimators.elastic.outer_products import OuterProducts
from softtissue_estimator.estimators.elastic.tangent import Stiffness, Tangent
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.volume_mesh import VolumeMesh

_SMALLEST_STEP_SHARE = 0.05  # of a step that would collapse an element; where even this would, it is made
_SHORTER_STEP = 0.7  # over the step tried before
_LARGEST_CHANGE_SHARE = 0.5  # of how far the nodes moved: what forces change of a displacement to first order
_NO_CHANGE_M = 1e-12


@dataclass(frozen=True, eq=False)
class RestingBody:
    """A body at rest made linear, and so about every rigid motion: the stiffness of a body that is turned is turned.

    Parameters
    ----------
    springs : (n, n) float64
        As in `HyperelasticBody`.
    factor : LayeredFactor
        Of the stiffness, float32.
    response : (3 n, 3 p) float32
        Displacement by unit loads.
    """

    springs: Tensor
    factor: LayeredFactor
    response: Tensor

    @property
    def usual_displacement(self) -> float:
        """Root mean square of a component of the nodes' displacement by all loads, each N(0, 1), m."""
        count = len(self.springs)
        return float(self.response.view(3 * count, -1).square().sum(dim=1).mean().sqrt())

    def linearise_moved(self, rotation: Tensor, state: Tensor, rest: Tensor) -> Tangent:
        """Make the body linear about a rigid motion, without a factorisation. Loads are turned with it.

        Parameters
        ----------
        rotation : (3, 3) float64
        state : (n, 3) float64 m
            Displacement by the motion.
        rest : (n, 3) float64 m
            Displacement at which the springs are at rest.
        """
        count = len(state)
        stiffness = Stiffness(self.factor, rotation)
        offset = state - stiffness.displacement(self.springs @ (state - rest))
        by_node = self.response.view(count, 3, -1)
        turned = torch.einsum("ab,nbk->nak", rotation.float(), by_node).reshape(3 * count, -1)
        return Tangent(state, offset, turned, stiffness)


class HyperelasticBody:
    """Tetrahedra with Young's modulus one, held by springs between its nodes and places in space.

    Poisson's ratio is said with every question, because it need not be known.

    Parameters
    ----------
    mesh : VolumeMesh
    springs : (n, n) 1/m
        Stiffness of the springs over Young's modulus, symmetric; they act on each component alike.
    loads : (n, p)
        B: nodal forces of unit loads, for each component.
    device : torch.device

    Attributes
    ----------
    count : int
        Nodes, n.
    volumes : (m,) float64 m^3
        Of the tetrahedra at rest.
    """

    def __init__(
        self, mesh: VolumeMesh, springs: FloatArray, loads: FloatArray, device: torch.device
    ) -> None:
        self.count = len(mesh.nodes)
        self._nodes = torch.from_numpy(mesh.nodes).to(device)
        self._corners = torch.from_numpy(mesh.tets.reshape(-1)).to(device)  # (4 m,)
        self._gradients = torch.from_numpy(shape_gradients(mesh)).to(device)  # (m, 4, 3)
        self.volumes = torch.from_numpy(mesh.volumes).to(device)
        self._weighted = self._gradients * self.volumes[:, None, None]
        self._springs = torch.from_numpy(np.ascontiguousarray(springs)).to(device)
        self._loads = _by_component(loads, device)
        self._layers = _layers(mesh, springs)
        self._averaged = AveragedVolume(mesh, self._layers, device)
        self._elements = NeoHookeanElements(self._gradients, self._averaged)
        corners = np.arange(mesh.tets.size).reshape(-1, 1, 4).repeat(4, axis=1)
        first, second = corners.transpose(0, 2, 1).reshape(-1), corners.reshape(-1)
        dof = 3 * mesh.tets.reshape(-1, 1) + np.arange(3)
        self._blocks = OuterProducts(first, second, dof[first], dof[second], self._layers, device)
        # What every tangent shares: the springs, and mu times V g_i . g_j on the diagonal of each block.
        gradients = shape_gradients(mesh)
        dots = np.zeros((self.count, self.count))
        each = (gradients * mesh.volumes[:, None, None]) @ gradients.transpose(0, 2, 1)
        np.add.at(dots, (mesh.tets[:, :, None], mesh.tets[:, None, :]), each)
        self._held, self._sheared = (
            torch.from_numpy(self._layers.store(np.asarray(np.kron(nodal, np.eye(3)), np.float64)))
            .float()
            .to(device)
            for nodal in (springs, dots)
        )

    def with_more_loads(
        self, resting: RestingBody, loads: FloatArray
    ) -> tuple["HyperelasticBody", RestingBody]:
        """Return the same body with further unit loads (n, q), and it at rest, without another factorisation.

        Parameters
        ----------
        resting : RestingBody
            This body at rest.
        loads : (n, q)
            Nodal forces of the further loads, for each component.
        """
        further = _by_component(loads, self._loads.device)
        more = copy.copy(self)
        more._loads = torch.cat([self._loads, further], dim=1)
        response = torch.cat([resting.response, resting.factor.solve(further)], dim=1)
        return more, replace(resting, response=response)

    def deformation_gradient(self, displacement: Tensor) -> Tensor:
        """F of every tetrahedron, (m, 3, 3), for nodal displacement (n, 3) m."""
        corners = (self._nodes + displacement).index_select(0, self._corners).view(-1, 4, 3)
        return corners.transpose(1, 2) @ self._gradients

    def at_rest(self, poisson_ratio: float) -> RestingBody:
        """Make the body linear about rest.

        Parameters
        ----------
        poisson_ratio : float
            From 0 to below 0.5.

        Raises
        ------
        InvalidInputError
            For another Poisson's ratio.
        OrganError
            If the stiffness cannot be factorised: nothing holds the body.
        """
        law = lame_constants(poisson_ratio)
        elements = self._elements.response(self.deformation_gradient(torch.zeros_like(self._nodes)), *law)
        factor = self._factor(elements, *law)
        if factor is None:
            raise OrganError("elastic model: expected a stiffness that can be factorised, got a singular one")
        return RestingBody(self._springs, factor, factor.solve(self._loads))

    def linearise(self, state: Tensor, rest: Tensor, poisson_ratio: float) -> Tangent:
        """Make the body linear about a displacement.

        Parameters
        ----------
        state : (n, 3) float64 m
        rest : (n, 3) float64 m
            Displacement at which the springs are at rest.
        poisson_ratio : float
            From 0 to below 0.5.

        Raises
        ------
        InvalidInputError
            For another Poisson's ratio.
        OrganError
            If no stiffness of this body can be factorised, which springs that hold it prevent.
        """
        law = lame_constants(poisson_ratio)
        gradient = self.deformation_gradient(state)
        elements = self._elements.response(gradient, *law)
        force = self._force(elements.stress, state, rest)
        factor = self._factor(elements, *law)
        if factor is None:
            # Compressed or overstretched so far that it would buckle; the corotated stiffness is always positive.
            factor = self._factor(self._elements.corotated(gradient, *law), *law)
        if factor is None:
            raise OrganError("elastic model: expected a stiffness that can be factorised, got a singular one")
        stiffness = Stiffness(factor)
        offset = state - stiffness.displacement(force)
        return Tangent(state, offset, factor.solve(self._loads), stiffness)

    def linearise_on(self, tangent: Tangent, state: Tensor, rest: Tensor, poisson_ratio: float) -> Tangent:
        """Make the body linear about a displacement with the stiffness that it had about one nearby.

        A step of the modified Newton method: the forces are those of the new state, which takes no factorisation.

        Parameters
        ----------
        tangent : Tangent
            About the other displacement, with the same Poisson's ratio.
        state : (n, 3) float64 m
            Towards which it goes, as far as no sound element collapses on the way.
        rest, poisson_ratio
            As of `linearise`, which says what it raises, too.
        """
        state, gradient = self._guarded(tangent.state, state)
        stress = self._elements.stress(gradient, *lame_constants(poisson_ratio))
        offset = state - tangent.stiffness.displacement(self._force(stress, state, rest))
        # With the stiffness of a state far away such steps may lead further and further away.
        change = offset - tangent.offset
        most = _LARGEST_CHANGE_SHARE * float((state - tangent.state).abs().max())
        change *= min(1.0, most / max(float(change.abs().max()), most, _NO_CHANGE_M))
        return replace(tangent, state=state, offset=tangent.offset + change)

    def guarded(self, start: Tensor, end: Tensor) -> Tensor:
        """Go from one displacement (n, 3) m towards another, as far as no sound element collapses on the way."""
        return self._guarded(start, end)[0]

    def _guarded(self, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Return where `guarded` ends, and the deformation gradients there, (m, 3, 3)."""
        share, sound = 1.0, None
        while True:
            state = start + share * (end - start)
            gradient = self.deformation_gradient(state)
            flat = determinant(gradient) < 0.5 * COLLAPSED_VOLUME_RATIO
            if sound is None and bool(flat.any()):
                sound = determinant(self.deformation_gradient(start)) > COLLAPSED_VOLUME_RATIO
            if sound is None or not bool((sound & flat).any()) or share <= _SMALLEST_STEP_SHARE:
                return state, gradient
            share *= _SHORTER_STEP

    def _force(self, stress: Tensor, state: Tensor, rest: Tensor) -> Tensor:
        """Nodal forces by which elements and springs resist a displacement, (n, 3)."""
        corner = self._weighted @ stress.transpose(1, 2)
        force = self._springs @ (state - rest)
        return force.index_add_(0, self._corners, corner.reshape(-1, 3))

    def _factor(self, elements: ElementResponse, lame: float, shear: float) -> LayeredFactor | None:
        return factorise(self._layers, self._stiffness(elements, lame, shear))

    def _stiffness(self, elements: ElementResponse, lame: float, shear: float) -> Tensor:
        spatial = elements.spatial.float()
        weighted = spatial * self.volumes.float()[:, None, None]
        stiffness = torch.add(self._held, self._sheared, alpha=shear)
        scaled = weighted * elements.coefficient.float()[:, None, None]
        self._blocks.add(stiffness, scaled.view(-1, 3), spatial.view(-1, 3), crossed=True)
        own = elements.own
        if bool(own.any()):
            alone = weighted * own[:, None, None]
            self._blocks.add(stiffness, alone.view(-1, 3), spatial.view(-1, 3), lame)
            weighted[own] = 0.0
        self._averaged.add_stiffness(stiffness, weighted, lame)
        return stiffness


def _layers(mesh: VolumeMesh, springs: FloatArray) -> Layers:
    """Order the nodes for the stiffness, which joins all nodes around a node."""
    rows, columns = np.repeat(mesh.tets, 4, axis=1).reshape(-1), np.tile(mesh.tets, (1, 4)).reshape(-1)
    around = csr_array((np.ones(len(rows)), (rows, columns)), shape=springs.shape)
    return layers_of(csr_array(around @ around + csr_array(np.abs(springs))), 3)


def _by_component(loads: FloatArray, device: torch.device) -> Tensor:
    return torch.kron(torch.from_numpy(loads).float(), torch.eye(3)).to(device)


def to_tensor(values: FloatArray, device: torch.device) -> Tensor:
    """Copy an array to a device, in double precision."""
    return torch.from_numpy(np.array(values, dtype=np.float64)).to(device)
