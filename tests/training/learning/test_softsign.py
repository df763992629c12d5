import torch
from torch import nn

from softtissue_training.learning.softsign import quicken, softsign


def test_values_and_derivative_are_those_of_softsign():
    inputs = torch.linspace(-20.0, 20.0, 81, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(softsign(inputs), nn.functional.softsign(inputs), rtol=1e-15, atol=0.0)
    assert torch.autograd.gradcheck(softsign, inputs)
    weights = torch.linspace(1.0, 2.0, 81, dtype=torch.float64)
    (ours,) = torch.autograd.grad((weights * softsign(inputs)).sum(), inputs)
    (theirs,) = torch.autograd.grad((weights * nn.functional.softsign(inputs)).sum(), inputs)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=0.0)


def test_all_layers_of_a_network_use_it():
    network = nn.Sequential(nn.Linear(2, 2), nn.Sequential(nn.Softsign(), nn.Linear(2, 1)), nn.Softsign())
    inputs = torch.tensor([[0.3, -2.0]])
    before = network(inputs)
    quicken(network)
    after = network(inputs)
    assert torch.equal(after, before)
    assert after.grad_fn.name() == "_SoftSignBackward"
