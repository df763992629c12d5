"""Neo-Hookean tetrahedra: internal forces of a deformed organ, and the organ made linear about that deformation.

W = mu/2 (tr F^T F - 3) - mu ln J + lambda/2 (ln J)^2, J = det F, the law that the simulations of `softtissue_training`
use by default. Elements that are crushed, or turned inside out by an extrapolation, follow the corotated linear law
W = mu |S - I|^2 + lambda/2 tr(S - I)^2, F = R S, instead: it is finite everywhere and leads them back.

Everything runs on one torch device. Forces are in double precision; the stiffness, which only decides how fast the
iteration converges, in single.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.elasticity import lame_constants, shape_gradients
from softtissue_estimator.errors import OrganError
from softtissue_estimator.mesh import FloatArray
from softtissue_estimator.volume_mesh import VolumeMesh

_CRUSHED = 0.2  # det F below which an element follows the corotated law
_SMALLEST_STEP = 0.05


@dataclass(frozen=True, eq=False)
class Tangent:
    """An organ made linear about a deformation: displacement = offset + response a for loads B a.

    Parameters
    ----------
    state : (n, 3) float64 m
        Displacement about which it is linear.
    offset : (n, 3) float64 m
        Displacement without loads, to first order.
    response : (3 n, 3 p) float32
        K^-1 (B (x) I_3): displacement by unit loads; component a of node i is row 3 i + a.
    """

    state: Tensor
    offset: Tensor
    response: Tensor


class HyperelasticBody:
    """Tetrahedra with Young's modulus one, held by springs between its nodes and places in space.

    Parameters
    ----------
    mesh : VolumeMesh
    poisson_ratio : float
        From 0 to below 0.5.
    springs : (n, n) 1/m
        Stiffness of the springs over Young's modulus, symmetric; they act on each component alike.
    loads : (n, p)
        B: nodal forces of unit loads, for each component.
    device : torch.device
    """

    def __init__(
        self,
        mesh: VolumeMesh,
        poisson_ratio: float,
        springs: FloatArray,
        loads: FloatArray,
        device: torch.device,
    ) -> None:
        self._lame, self._shear = lame_constants(poisson_ratio)
        self.count = len(mesh.nodes)
        self._device = device
        self._nodes = torch.from_numpy(mesh.nodes).to(device)
        self._tets = torch.from_numpy(mesh.tets).to(device)
        self._gradients = torch.from_numpy(shape_gradients(mesh)).to(device)  # (m, 4, 3)
        self._volumes = torch.from_numpy(mesh.volumes).to(device)
        self._springs = torch.from_numpy(np.ascontiguousarray(springs)).to(device)
        self._loads = torch.kron(torch.from_numpy(loads).float(), torch.eye(3)).to(device)
        self._identity = torch.eye(3, dtype=torch.float64, device=device)
        dof = 3 * self._tets[:, :, None] + torch.arange(3, device=device)  # (m, 4, 3)
        self._entry = (dof[:, :, :, None, None] * (3 * self.count) + dof[:, None, None]).reshape(-1)
        # What every tangent shares: mu V g_i . g_j on the diagonal of each block, and the springs.
        weighted = self._gradients * (self._shear * self._volumes)[:, None, None]
        dots = torch.einsum("eia,eja->eij", weighted, self._gradients)
        shared = torch.einsum("eij,ab->eiajb", dots, self._identity).float().reshape(-1)
        self._shared = torch.kron(self._springs.float(), torch.eye(3, device=device)).contiguous()
        self._shared.view(-1).index_add_(0, self._entry, shared)

    def deformation_gradient(self, displacement: Tensor) -> Tensor:
        """F of every tetrahedron, (m, 3, 3), for nodal displacement (n, 3) m."""
        return torch.einsum("eia,eib->eab", (self._nodes + displacement)[self._tets], self._gradients)

    @cached_property
    def _at_rest(self) -> tuple[Tensor, Tensor]:
        """Cholesky factor of the stiffness at rest, (3 n, 3 n), and the response to unit loads, (3 n, 3 p)."""
        unmoved = torch.zeros_like(self._nodes)
        _, spatial, coefficient = self._neo_hookean(self.deformation_gradient(unmoved))
        factor = self._factor(spatial, coefficient)
        if factor is None:
            raise OrganError("elastic model: expected a stiffness that can be factorised, got a singular one")
        return factor, torch.cholesky_solve(self._loads, factor)

    def linearise_moved(self, rotation: Tensor, state: Tensor, rest: Tensor) -> Tangent:
        """Make the organ linear about a rigid motion, without a factorisation; else like `linearise`.

        The stiffness of a body that is turned is the turned stiffness. Loads are turned with it.

        Parameters
        ----------
        rotation : (3, 3) float64
        state : (n, 3) float64 m
            Displacement by the motion.
        rest : (n, 3) float64 m
        """
        factor, response = self._at_rest
        force = (self._springs @ (state - rest)) @ rotation
        step = torch.cholesky_solve(force.float().reshape(-1, 1), factor)
        offset = state - step.double().reshape(-1, 3) @ rotation.T
        by_node = response.view(self.count, 3, -1)
        turned = torch.einsum("ab,nbk->nak", rotation.float(), by_node).reshape(response.shape)
        return Tangent(state, offset, turned)

    def linearise(self, state: Tensor, rest: Tensor) -> Tangent:
        """Make the organ linear about a displacement.

        Parameters
        ----------
        state : (n, 3) float64 m
        rest : (n, 3) float64 m
            Displacement at which the springs are at rest.

        Raises
        ------
        OrganError
            If no stiffness of this body can be factorised, which springs that hold it prevent.
        """
        gradient = self.deformation_gradient(state)
        stress, spatial, coefficient = self._neo_hookean(gradient)
        force = self._nodal_force(stress) + self._springs @ (state - rest)
        factor = self._factor(spatial, coefficient)
        if factor is None:
            # Compressed or overstretched so far that it would buckle; the corotated stiffness is always positive.
            _, spatial, coefficient = self._corotated(gradient)
            factor = self._factor(spatial, coefficient)
        if factor is None:
            raise OrganError("elastic model: expected a stiffness that can be factorised, got a singular one")
        right = torch.cat([force.reshape(-1, 1).float(), self._loads], dim=1)
        solved = torch.cholesky_solve(right, factor)
        offset = state - solved[:, 0].double().reshape(-1, 3)
        return Tangent(state, offset, solved[:, 1:])

    def guarded(self, start: Tensor, end: Tensor) -> Tensor:
        """Go from one displacement (n, 3) m towards another, as far as no sound element is crushed on the way."""
        before = torch.linalg.det(self.deformation_gradient(start))
        sound = before > _CRUSHED
        share = 1.0
        while share > _SMALLEST_STEP:
            state = start + share * (end - start)
            after = torch.linalg.det(self.deformation_gradient(state))
            if not bool((sound & (after < 0.5 * _CRUSHED)).any()):
                return state
            share *= 0.7
        return start + share * (end - start)

    def _neo_hookean(self, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """First Piola-Kirchhoff stress (m, 3, 3), shape gradients in space (m, 4, 3) and coefficient c (m,).

        The stiffness between corners i and j is V (lambda a_i a_j^T + c a_j a_i^T + mu g_i . g_j I), a = F^-T g.
        """
        crushed = torch.linalg.det(gradient) < _CRUSHED
        sound = torch.where(crushed[:, None, None], self._identity, gradient)
        inverse = torch.linalg.inv(sound)
        logarithm = torch.log(torch.linalg.det(sound))
        coefficient = self._shear - self._lame * logarithm
        stress = self._shear * sound - coefficient[:, None, None] * inverse.transpose(1, 2)
        spatial = self._gradients @ inverse
        if bool(crushed.any()):
            stress[crushed], spatial[crushed], coefficient[crushed] = self._corotated(
                gradient[crushed], self._gradients[crushed]
            )
        return stress, spatial, coefficient

    def _corotated(
        self, gradient: Tensor, shape_gradient: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Do as `_neo_hookean` for the corotated law, the change of the rotation left out of the stiffness."""
        shape_gradient = self._gradients if shape_gradient is None else shape_gradient
        left, _, right = torch.linalg.svd(gradient)
        # A rotation, not a reflection: the direction that is compressed most is turned.
        left[:, :, 2] *= torch.linalg.det(left @ right)[:, None]
        turn = left @ right
        strain = turn.transpose(1, 2) @ gradient - self._identity
        strain = 0.5 * (strain + strain.transpose(1, 2))
        trace = strain.diagonal(dim1=1, dim2=2).sum(dim=1)
        inner = 2.0 * self._shear * strain + (self._lame * trace)[:, None, None] * self._identity
        return turn @ inner, shape_gradient @ turn.transpose(1, 2), torch.full_like(trace, self._shear)

    def _nodal_force(self, stress: Tensor) -> Tensor:
        corner = torch.einsum("eab,eib->eia", stress * self._volumes[:, None, None], self._gradients)
        force = torch.zeros_like(self._nodes)
        return force.index_add_(0, self._tets.reshape(-1), corner.reshape(-1, 3))

    def _factor(self, spatial: Tensor, coefficient: Tensor) -> Tensor | None:
        factor, failed = torch.linalg.cholesky_ex(self._stiffness(spatial, coefficient))
        return None if bool(failed) else factor

    def _stiffness(self, spatial: Tensor, coefficient: Tensor) -> Tensor:
        first = (spatial * self._volumes[:, None, None]).float()
        products = torch.einsum("eia,ejb->eiajb", first, spatial.float())
        entries = self._lame * products
        entries += products.permute(0, 1, 4, 3, 2) * coefficient.float()[:, None, None, None, None]
        stiffness = self._shared.clone()
        stiffness.view(-1).index_add_(0, self._entry, entries.reshape(-1))
        return stiffness


def to_tensor(values: FloatArray, device: torch.device) -> Tensor:
    """Copy an array to a device, in double precision."""
    return torch.from_numpy(np.array(values, dtype=np.float64)).to(device)
