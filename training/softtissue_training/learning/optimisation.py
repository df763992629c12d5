"""Adam on the weights of a network, and a moving average of them."""

from __future__ import annotations

import copy
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor, nn

from softtissue_training.learning.distributed import Ranks

CLIP_NORM = 1.0

NetworkT = TypeVar("NetworkT", bound=nn.Module)


class Settings(Protocol):
    """What every configuration of a training run has."""

    @property
    def name(self) -> str:
        """Name of the configuration."""

    @property
    def learning_rate(self) -> float:
        """Highest learning rate of Adam."""

    @property
    def warmup_steps(self) -> int:
        """Steps over which the learning rate rises to its highest value."""

    @property
    def ema_decay(self) -> float:
        """Decay a step of the moving average of the weights."""

    @property
    def seed(self) -> int:
        """Seed of all that is drawn."""

    def to_json(self) -> dict[str, Any]:
        """Return the settings as JSON can hold them."""


class Optimisation(Generic[NetworkT]):
    """A network in training.

    Attributes
    ----------
    network
        What is optimised.
    average
        The moving average of its weights, which is validated and kept.
    """

    def __init__(self, network: NetworkT, settings: Settings, device: torch.device, ranks: Ranks) -> None:
        self.settings, self.device, self.ranks = settings, device, ranks
        self.network = network.to(device)
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=settings.learning_rate)

    def backward(self, share: Tensor) -> Tensor:
        """Set the gradients from this process' share of a batch's loss, (); returns it."""
        # The processes' gradients are averaged, where they should be added.
        (share * self.ranks.size).backward()
        return share.detach()

    def update(self, rate: float, step: int) -> bool:
        """Make the step with the gradients that are set; returns false, and does nothing, where they are not finite.

        Parameters
        ----------
        rate
            Learning rate.
        step
            Steps made before.
        """
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), CLIP_NORM)
        if not bool(torch.isfinite(norm)):
            return False
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.step()
        # Early weights are forgotten sooner than the decay says, or the average would start at zero output.
        decay = min(self.settings.ema_decay, (2 + step) / (11 + step))
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.average.parameters()), list(self.network.parameters()), 1.0 - decay
            )
        return True
