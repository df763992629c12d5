"""One optimisation step after the other: network, moving average of its weights, and Adam."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from softtissue_estimator.estimators.paper.network import UNet, initialise
from softtissue_training.learning.coarse_convolution import use_products
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.loss import sample_losses, sigma_losses
from softtissue_training.learning.optimisation import Optimisation
from softtissue_training.learning.precision import restrict_autocast
from softtissue_training.learning.softsign import quicken
from softtissue_training.learning.training_config import TrainingConfig


@dataclass(frozen=True)
class Batch:
    """The part of a batch that one process has.

    Attributes
    ----------
    inputs, target, mask
        (b, c, X, Y, Z), (b, 3, X, Y, Z) and (b, 1, X, Y, Z), as `voxelise` makes them.
    count
        Samples of the batch in all processes together.
    counts
        Whether the samples count: a process that has none of a small batch computes one for nothing.
    """

    inputs: Tensor
    target: Tensor
    mask: Tensor
    count: int
    counts: bool = True


class Learner(Optimisation[UNet]):
    """A network in training.

    The loss of a batch is the mean over its samples in all processes, each sample's being a mean over cells of its own,
    so that neither the sizes of grids nor the number of processes change the gradient.
    """

    def __init__(self, config: TrainingConfig, device: torch.device, ranks: Ranks, *, bfloat16: bool) -> None:
        self.config, self.bfloat16 = config, bfloat16
        # Overwritten by `initialise` or by a stored state; seeded all the same, so that nothing depends on chance.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            network = UNet(config.spec.architecture)
        super().__init__(network, config, device, ranks)
        # Convolutions in bfloat16 take half of the time, on a GPU and with AMX.
        self._lay_out(torch.channels_last_3d)
        restrict_autocast(self.network, device)
        quicken(self.network)
        if bfloat16 and device.type == "cpu":
            use_products(self.network.bottleneck)
        self._outputs: nn.Module | None = None

    def initialise(self, example: Tensor) -> dict[str, float]:
        """Give every layer unit variance on an example (1, 5, X, Y, Z); returns what was reached, by layer."""
        generator = torch.Generator(self.device).manual_seed(self.config.seed)
        # Random numbers fill memory in its order, which is to be that of the indices.
        self._lay_out(torch.contiguous_format)
        reached = initialise(self.network, example, generator=generator)
        self._lay_out(torch.channels_last_3d)
        self.average.load_state_dict(self.network.state_dict())
        return reached

    def begin_with(self, network: UNet) -> None:
        """Take the weights of another network of this architecture."""
        self.network.load_state_dict(network.state_dict())
        self.average.load_state_dict(network.state_dict())

    def _lay_out(self, memory_format: torch.memory_format) -> None:
        for network in (self.network, self.average):
            network.to(memory_format=memory_format)  # type: ignore[call-overload]

    def gradient(self, batch: Batch) -> Tensor:
        """Set the gradients of the mean loss over the whole batch; returns this process' share of that loss, ()."""
        if (
            self._outputs is None
        ):  # not before the weights are what they are to be: the first process hands out its own
            self._outputs = self.ranks.share_gradients(_AllResolutions(self.network))
        self.optimiser.zero_grad(set_to_none=True)
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.bfloat16):
            outputs = self._outputs(batch.inputs)
        config = self.config
        truth = batch.target, batch.mask, config.cube_cells
        losses = sample_losses(outputs, *truth, distance=config.loss == "distance")
        if config.spec.gives_sigma:
            losses = losses + config.sigma_weight * sigma_losses(outputs[-1], *truth)
        share = losses.sum() * (float(batch.counts) / batch.count)
        return self.backward(share)


class _AllResolutions(nn.Module):
    """What `DistributedDataParallel` needs: a module whose call gives all outputs."""

    def __init__(self, network: UNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, inputs: Tensor) -> list[Tensor]:
        return self.network.forward_all(inputs)
