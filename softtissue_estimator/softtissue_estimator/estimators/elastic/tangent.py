"""An organ made linear about a deformation, and the stiffness that it has there."""

from dataclasses import dataclass, field

from torch import Tensor

from softtissue_estimator.estimators.elastic.layered_cholesky import LayeredFactor


@dataclass(frozen=True, eq=False)
class Stiffness:
    """The factorised stiffness of a deformed body, which may have been turned since.

    Parameters
    ----------
    factor : LayeredFactor
        float32.
    rotation : (3, 3) float64 or None
        By which the body was turned as a whole.
    """

    factor: LayeredFactor
    rotation: Tensor | None = None

    def displacement(self, force: Tensor) -> Tensor:
        """Return what nodal forces (n, 3) move the nodes by, (n, 3) float64 m."""
        turned = force if self.rotation is None else force @ self.rotation
        moved = self.factor.solve(turned.float().reshape(-1, 1)).double().reshape(-1, 3)
        return moved if self.rotation is None else moved @ self.rotation.T


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
    stiffness : Stiffness
        K, of this state or of one a little earlier.
    """

    state: Tensor
    offset: Tensor
    response: Tensor
    stiffness: Stiffness
    _powers: list[tuple[Tensor, Tensor]] = field(default_factory=list, init=False)

    def powers(self, nodes: Tensor) -> Tensor:
        """Return the mean square of what each load moves nodes (s,) by, of its three components together, (p,) m^2.

        Asked of the same nodes several times a step, and computed once.
        """
        for asked, known in self._powers:
            if asked is nodes:
                return known
        response = self.response.view(len(self.state), 3, -1).index_select(0, nodes).flatten(0, 1)
        found = response.square_().sum(dim=0).view(-1, 3).sum(dim=1) / len(nodes)
        self._powers[:] = [(nodes, found)]
        return found

    def largest_powers(self) -> Tensor:
        """Return the mean square, as in `powers`, of what each load moves one node by, the farthest, (p,) m^2."""
        by_node = self.response.view(len(self.state), 3, -1, 3)
        return by_node.square().sum(dim=(1, 3)).max(dim=0).values
