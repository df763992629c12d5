import pytest
import torch
from torch import nn
from torch.nn import functional

from softtissue_training.learning.coarse_convolution import convolve, use_products

GENERATOR = torch.Generator().manual_seed(0)


def _drawn(*shape, dtype=torch.float64):
    return torch.randn(*shape, generator=GENERATOR, dtype=dtype).requires_grad_()


@pytest.mark.parametrize("cells", [(2, 2, 4), (1, 2, 3), (3, 4, 2)])
def test_answer_and_gradients_are_those_of_the_convolution(cells):
    inputs, weight, bias = _drawn(2, 3, *cells), _drawn(4, 3, 3, 3, 3), _drawn(4)
    ours = convolve(inputs, weight, bias, torch.float64)
    theirs = functional.conv3d(inputs, weight, bias, padding=1)
    torch.testing.assert_close(ours, theirs, rtol=0.0, atol=1e-12)
    given = torch.randn(theirs.shape, generator=GENERATOR, dtype=torch.float64)
    expected = torch.autograd.grad((given * theirs).sum(), [inputs, weight, bias])
    for got, wanted in zip(
        torch.autograd.grad((given * ours).sum(), [inputs, weight, bias]), expected, strict=True
    ):
        torch.testing.assert_close(got, wanted, rtol=0.0, atol=1e-12)


def test_a_level_in_bfloat16_is_near_that_in_float32():
    level = nn.Sequential(nn.Conv3d(16, 32, 3, padding=1), nn.Softsign(), nn.Conv3d(32, 32, 3, padding=1))
    inputs = _drawn(4, 16, 2, 2, 4, dtype=torch.float32)
    parameters = [inputs, *level.parameters()]

    def answered():
        outputs = level(inputs)
        assert outputs.dtype == torch.float32
        return [outputs.detach(), *torch.autograd.grad(outputs.square().sum(), parameters)]

    exact = answered()
    use_products(level)
    for rough, fine in zip(answered(), exact, strict=True):
        assert 0.0 < float((rough - fine).norm()) < 0.02 * float(fine.norm())
