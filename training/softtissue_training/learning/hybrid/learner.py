"""The hybrid network in training."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from softtissue_estimator.estimators.hybrid.network import HybridNetwork, initialise
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.hybrid.batches import HybridBatch
from softtissue_training.learning.hybrid.config import HybridConfig
from softtissue_training.learning.hybrid.loss import view_losses
from softtissue_training.learning.optimisation import Optimisation
from softtissue_training.learning.precision import restrict_autocast


class HybridLearner(Optimisation[HybridNetwork]):
    """Network, moving average and Adam; the loss of a batch is the mean over its views in all processes."""

    def __init__(self, config: HybridConfig, device: torch.device, ranks: Ranks, *, bfloat16: bool) -> None:
        self.config, self.bfloat16 = config, bfloat16
        # Overwritten in the next line; seeded all the same, so that nothing depends on chance.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            network = HybridNetwork(config.spec.architecture)
        initialise(network, torch.Generator().manual_seed(config.seed))
        super().__init__(network, config, device, ranks)
        restrict_autocast(self.network, device)
        self._shared: nn.Module | None = None

    def gradient(self, batch: HybridBatch) -> Tensor:
        """Set the gradients of the mean loss over the whole batch; returns this process' share of that loss, ()."""
        if self._shared is None:  # not before the weights are what they are to be
            self._shared = self.ranks.share_gradients(self.network)
        self.optimiser.zero_grad(set_to_none=True)
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.bfloat16):
            outputs = self._shared(batch.inputs)
        losses = view_losses(outputs, batch, self.config)
        return self.backward(losses.sum() * (float(batch.counts) / batch.count))
