"""Tetrahedra that do not lock when the material is nearly incompressible: volumetric strain averaged at the vertices.

Constant strain in each of many tetrahedra cannot keep the volume of every one of them and still bend; stiffness grows
with lambda and not with the shape. Here the term of lambda in the energy sees one volumetric strain a vertex, the mean
over the elements around it, weighted by volume (Bonet and Burton 1998):

    Pi(u) = sum_e V_e W_shear(F_e) + sum_n V_n lambda/2 theta_n^2,
    V_n = sum_e V_e / 4,    V_n theta_n = sum_e V_e / 4 theta(F_e),    e over the elements of vertex n.

Its derivative is a stress P(F_e) in which p_e, the mean of lambda theta_n over the vertices of e, stands for lambda
theta_e. Its second derivative couples all vertices of neighbouring elements; with the unknowns q_n = lambda d theta_n
beside the displacement it has the sparsity of the mesh and stays symmetric:

    [ K(p)    B        ] [ du ]   [ r ]
    [ B^T  -V / lambda ] [ q  ] = [ 0 ],    B_an = sum_e V_e / 4 d theta_e / d u_a.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.physics.block_system import PAIR_FIRST, PAIR_SECOND, BlockSystem
from softtissue_training.physics.body import Body
from softtissue_training.physics.material import Material

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


class AveragedBody(Body):
    """A `Body` whose volumetric strain is averaged at the vertices.

    Raises
    ------
    InvalidInputError
        Poisson's ratio is not positive.
    """

    def __init__(self, vertices: FloatArray, tets: IntArray, fixed: BoolArray, material: Material) -> None:
        self._lam, mu = material.lame_pa
        if self._lam <= 0.0:
            raise InvalidInputError(
                f"averaging needs a Poisson's ratio above zero, got {material.poisson_ratio}"
            )
        super().__init__(vertices, tets, fixed, material)
        count = len(self.tets)
        self._share = sparse.csr_matrix(
            (np.repeat(self.volume / 4.0, 4), (self.tets.ravel(), np.repeat(np.arange(count), 4))),
            shape=(len(vertices), count),
        )
        self._vertex_volume = np.asarray(self._share.sum(axis=1)).ravel()
        # Pressures are scaled so that the system's two diagonals are alike.
        self._scale = np.sqrt(self._lam * mu * self._vertex_volume ** (-2.0 / 3.0))

    def energy(self, displacement: FloatArray) -> float:
        """Elastic energy, joules; infinite if an element is inverted."""
        gradient = self.deformation_gradient(displacement)
        shear = float(np.sum(self.volume * self.material.shear_energy(gradient)))
        strain = self._average(self.material.volumetric_strain(gradient))
        return shear + 0.5 * self._lam * float(np.sum(self._vertex_volume * strain**2))

    def internal_force(self, displacement: FloatArray) -> FloatArray:
        """Return the derivative of the elastic energy, (n, 3) newtons."""
        gradient = self.deformation_gradient(displacement)
        return self._divergence(self.material.stress(gradient, self._pressure(gradient)))

    def solve_tangent(
        self,
        displacement: FloatArray,
        right_hand_side: FloatArray,
        *,
        projected: bool,
        load_stiffness: FloatArray | None = None,
    ) -> FloatArray:
        """Solve K(u) x = b on the free degrees of freedom; see `Body.solve_tangent`."""
        gradient = self.deformation_gradient(displacement)
        blocks = np.moveaxis(np.zeros((4, 4, len(PAIR_FIRST), len(self.tets))), (2, 3), (1, 0))
        blocks[..., :3, :3] = self._blocks(gradient, self._pressure(gradient), projected=projected)
        if load_stiffness is not None:
            blocks[..., :3, :3] -= load_stiffness
        normal = self.material.volumetric_gradient(gradient)[:, None]
        share = self.volume[:, None] / 4.0
        first, second = self._scale[self.tets[:, PAIR_FIRST]], self._scale[self.tets[:, PAIR_SECOND]]
        blocks[..., :3, 3] = (share * second)[..., None] * np.einsum("epJ,epiJ->epi", self._first, normal)
        blocks[..., 3, :3] = (share * first)[..., None] * np.einsum("epJ,epiJ->epi", self._second, normal)
        same = PAIR_FIRST == PAIR_SECOND
        blocks[:, same, 3, 3] = -share / self._lam * first[:, same] ** 2
        extended = np.column_stack([right_hand_side, np.zeros(len(right_hand_side))])
        return np.ascontiguousarray(self._system.solve(blocks, extended)[:, :3])

    def stiffness_times(self, displacement: FloatArray, direction: FloatArray) -> FloatArray:
        """K(u) times a displacement, (n, 3) newtons, over all degrees of freedom."""
        gradient = self.deformation_gradient(displacement)
        change = np.moveaxis(self._gradient(direction), -1, 0)
        normal = self.material.volumetric_gradient(gradient)
        tangent = self.material.tangent(gradient, self._pressure(gradient))
        gain = self._to_elements(self._lam * self._average(np.einsum("eiJ,eiJ->e", normal, change)))
        stress = np.einsum("eiJkL,ekL->eiJ", tangent, change) + gain[:, None, None] * normal
        return self._divergence(stress)

    def _make_system(self) -> BlockSystem:
        free = np.column_stack([self.free, np.ones(len(self.free), dtype=bool)])
        return BlockSystem(self.tets, free)

    def _pressure(self, gradient: FloatArray) -> FloatArray:
        """Return p_e, (t,) Pa."""
        return self._to_elements(self._lam * self._average(self.material.volumetric_strain(gradient)))

    def _average(self, values: FloatArray) -> FloatArray:
        """Return the mean at each vertex, (n,), of values of the elements, (t,)."""
        result: FloatArray = np.asarray(self._share @ values) / self._vertex_volume
        return result

    def _to_elements(self, values: FloatArray) -> FloatArray:
        """Return the mean over each element's vertices, (t,), of values of the vertices, (n,)."""
        result: FloatArray = values[self.tets].mean(axis=1)
        return result
