import torch

from softtissue_estimator.estimators.paper.network import UNet
from softtissue_training.learning.training_config import get_config
from softtissue_training.learning.training_state import Progress, load_state, save_state

TINY = get_config("tiny")
SHAPE = (1, TINY.spec.architecture.in_channels, 8, 8, 8)


def test_state_restores_weights_average_optimiser_and_progress(tmp_path):
    def trained(seed):
        torch.manual_seed(seed)
        network = UNet(TINY.spec.architecture)
        optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
        for _ in range(2):
            optimiser.zero_grad()
            network(torch.randn(SHAPE)).square().mean().backward()
            optimiser.step()
        return network, UNet(TINY.spec.architecture), optimiser

    path = tmp_path / "state.safetensors"
    one, average, optimiser = trained(1)
    other, other_average, other_optimiser = trained(2)
    before = Progress(step=7, epoch=2, batch=3, seconds=0.1 + 0.2, best_error=0.5, loss_sum=1 / 3)
    save_state(path, one, average, optimiser, before, TINY.to_json())
    assert load_state(path, other, other_average, other_optimiser, TINY.to_json()) == before
    batch = torch.randn(SHAPE)
    torch.testing.assert_close(other_average(batch), average(batch))
    for network, adam in ((one, optimiser), (other, other_optimiser)):
        adam.zero_grad()
        network(batch).square().mean().backward()
        adam.step()
    torch.testing.assert_close(other(batch), one(batch), rtol=0, atol=0)
