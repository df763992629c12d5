"""The ways a simulation can fail; each becomes a counted reason for rejecting a sample."""

from __future__ import annotations

from softtissue_estimator.errors import SoftTissueError


class SolverDivergedError(SoftTissueError):
    """No equilibrium was found; the message gives the iterations and the residual."""


class MovedTooFarError(SoftTissueError):
    """On its way to equilibrium a body moved further than is of use; the message says how far."""


class TrainingFailedError(SoftTissueError):
    """Training cannot go on: its gradients are not finite."""


class RejectedSampleError(SoftTissueError):
    """A simulation that ran but is not used for training; `reason` is one of a few short names that are counted."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class EvaluationStoppedError(SoftTissueError):
    """An evaluation that cannot be finished now; what it has measured is kept."""
