"""What is supposed of the loads before anything is observed."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from softtissue_estimator.estimators.elastic.linear_gaussian import equal_variances
from softtissue_estimator.estimators.elastic.tangent import Tangent

LEAST_START_SHARE = 1e-2
"""Of a load's variance before any observation, with which a step begins that goes on from earlier ones: an organ at
rest leaves none, and without any nothing could move it again."""
_HELD_SHARE = 1e-9
"""Of the variance of a load that pushes: with it what holds the organ stays where it is."""


@dataclass(frozen=True)
class LoadsPrior:
    """Standard deviation of what loads do, and which of them there may be.

    Parameters
    ----------
    sigma_m : float
        Of each component of a node's displacement.
    pushing : int
        How many of the loads push; those behind move what the organ is attached to.
    attachment_moves : bool
        Whether that may move. Few organs are attached elsewhere than is said, and an error of the registration looks
        much like it.
    """

    sigma_m: float
    pushing: int
    attachment_moves: bool = False

    def variances(self, tangent: Tangent, nodes: Tensor, loads: Tensor | None = None) -> Tensor:
        """Variance of every load's amplitude, (p,).

        Parameters
        ----------
        tangent : Tangent
        nodes : (s,) int64
            Those that are observed.
        loads : (p,) int64 or None
            Numbers of the loads that the tangent has; None for all.
        """
        pushes = slice(0, self.pushing) if loads is None else loads < self.pushing
        equal = equal_variances(tangent, nodes, self.sigma_m, pushes)
        return equal if self.attachment_moves else self.held(equal, loads)

    def least(self, tangent: Tangent, nodes: Tensor, loads: Tensor | None = None) -> Tensor:
        """Return what the variances are at least where a step goes on from earlier ones, (p,); see `variances`."""
        return LEAST_START_SHARE * self.variances(tangent, nodes, loads)

    def held(self, variances: Tensor, loads: Tensor | None = None) -> Tensor:
        """Return variances (p,) that let next to nothing move what holds the organ, unless it may move."""
        if self.attachment_moves:
            return variances
        kept = variances.clone()
        behind = slice(self.pushing, None) if loads is None else loads >= self.pushing
        kept[behind] *= _HELD_SHARE
        return kept
