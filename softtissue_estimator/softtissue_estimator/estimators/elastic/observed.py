"""What the solver asks of an observation, whatever kind it is: pairs that are given, or a surface to be matched."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from softtissue_estimator.estimators.elastic.amplitudes import Amplitudes, Variances
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.organ.mesh import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Conditioned:
    """Loads, conditioned on an observation.

    Parameters
    ----------
    amplitudes : Amplitudes
    mean : (n, 3) float64 m
        Displacement of the nodes.
    residual : (c, 3) m
        What is left of each patch.
    log_evidence : float
        Of the observation.
    """

    amplitudes: Amplitudes
    mean: Tensor
    residual: FloatArray
    log_evidence: float


class Explained(Protocol):
    """What a posterior says of the observation that it explains."""

    @property
    def amplitudes(self) -> Amplitudes:
        """Of the loads and errors."""

    @property
    def mean(self) -> Tensor:
        """Displacement of the nodes, (n, 3) float64 m."""

    @property
    def residual(self) -> FloatArray:
        """What it leaves of each patch, (c, 3) m."""

    @property
    def observed(self) -> Observed:
        """What it explains."""

    @property
    def registration(self) -> RegistrationError:
        """What was supposed of it."""

    @property
    def registration_step(self) -> FloatArray:
        """Mean of its error beside the correction that was supposed, (6,) m and rad."""


class Matchable(Protocol):
    """An observation that is matched with the organ as it is estimated."""

    @property
    def first_sigmas_m(self) -> tuple[float, ...]:
        """Errors of the model with which it is matched about rest, from coarse to fine; none where pairs are given."""

    @property
    def first_fields_m(self) -> tuple[float, ...]:
        """Standard deviation of each field of errors that neighbours share, before the evidence tells it, m."""

    @property
    def least_sigma_m(self) -> float:
        """Error of the model that its patches show at least, m."""

    @property
    def identified(self) -> bool:
        """Whether it is given which part of the organ each patch shows: else it may show anything."""

    @property
    def registration_scales(self) -> tuple[float, ...]:
        """Sizes of the registration's error, over the largest that is expected, which its evidence tells apart."""

    def about(self, mean: Tensor, registration: RegistrationError, reach_m: float) -> Observed:
        """Match it with the organ.

        Parameters
        ----------
        mean : (n, 3) float64 m
            Displacement of the nodes.
        registration : RegistrationError
            What is supposed of it.
        reach_m : float
            What is farther from the organ is none of it.

        Raises
        ------
        InvalidInputError
            If next to nothing is near the organ.
        """

    def anew(self, explained: Explained, reach_m: float) -> tuple[Observed, FloatArray]:
        """Match it with the organ as a posterior has it; also what that leaves of the new matches, (c, 3) m."""


class Observed(Protocol):
    """Patches of surface that were observed, matched.

    Attributes
    ----------
    precision : (c,) 1/m^2
        Inverse variance of each observed component by the noise alone.
    counts : (c,)
        One where the patch belongs to the organ, else zero.
    components : int
        That are observed of each patch: 3, or 1 along the normal.
    field_components : tuple of int
        Along how many directions each field of errors acts at a place.
    equations : int
        How many numbers were observed in all.
    nodes : (s,) int64
        That the patches lie between.
    """

    precision: FloatArray
    counts: FloatArray
    components: int
    field_components: tuple[int, ...]
    equations: int
    nodes: Tensor

    @property
    def reference(self) -> FloatArray:
        """Where the patches that count were on the preoperative surface, (k, 3) m."""

    @property
    def displacement(self) -> FloatArray:
        """How far these have moved, (k, 3) m, as the registration has it."""

    def relied_on(self) -> BoolArray | None:
        """See `Estimate.relied_on`."""

    def holds(self, explained: Explained) -> bool:
        """Whether its matches are those with the organ as a posterior of them has it, too."""

    def condition(
        self,
        tangent: Tangent,
        registration: RegistrationError,
        precision: FloatArray,
        variances: Variances,
        updates: int,
        most_fields: Tensor | None,
    ) -> Conditioned:
        """Condition loads and errors on what is observed.

        Parameters
        ----------
        tangent : Tangent
        registration : RegistrationError
        precision : (c,) 1/m^2
            Inverse variance of each observed component.
        variances : Variances
            To start from.
        updates : int
            Of the variances.
        most_fields : (f,) float64 m^2 or None
            Variances of the fields of errors, at most.
        """
