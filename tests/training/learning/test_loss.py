import math

import pytest
import torch
from torch.nn import functional

from softtissue_training.learning.loss import multi_resolution_loss, sample_losses, sigma_losses


def _problem():
    generator = torch.Generator().manual_seed(1)
    mask = (torch.rand(2, 1, 16, 8, 8, generator=generator) < 0.5).float()
    target = torch.randn(2, 3, 16, 8, 8, generator=generator) * mask
    return target, mask


def test_only_cells_inside_the_organ_count():
    target, mask = _problem()
    generator = torch.Generator().manual_seed(2)
    output = torch.randn(target.shape, generator=generator)
    outside = output + 100.0 * (1 - mask)
    inside = output + 1.0 * mask
    reference = multi_resolution_loss([output], target, mask)
    torch.testing.assert_close(multi_resolution_loss([outside], target, mask), reference)
    assert multi_resolution_loss([inside], target, mask) > reference


def test_value_is_the_squared_length_averaged_over_all_cells():
    mask = torch.zeros(1, 1, 8, 8, 8)
    mask[0, 0, :2, :2, :2] = 1.0
    target = mask.expand(-1, 3, -1, -1, -1) * torch.tensor([1.0, 2.0, 2.0]).view(1, 3, 1, 1, 1)
    expected = 9.0 * 8 / 512
    assert float(multi_resolution_loss([torch.zeros_like(target)], target, mask)) == pytest.approx(expected)


def test_resolutions_are_added_and_coarse_targets_are_means_inside():
    target, mask = _problem()
    coarse = functional.avg_pool3d(target, 4) / functional.avg_pool3d(mask, 4)
    assert float(multi_resolution_loss([coarse], target, mask)) == pytest.approx(0.0, abs=1e-10)
    wrong = coarse + 1.0
    only = float(multi_resolution_loss([wrong], target, mask))
    assert only == pytest.approx(3.0 * float(mask.mean()), rel=1e-5)
    both = float(multi_resolution_loss([wrong, torch.zeros_like(target)], target, mask))
    assert both == pytest.approx(only + float(target.square().sum(1).mean()), rel=1e-5)


def test_empty_coarse_cells_do_not_spoil_the_gradient():
    mask = torch.zeros(1, 1, 8, 8, 8)
    mask[0, 0, 0, 0, 0] = 1.0
    output = torch.zeros(1, 3, 2, 2, 2, requires_grad=True)
    multi_resolution_loss([output], torch.ones(1, 3, 8, 8, 8) * mask, mask).backward()
    assert torch.isfinite(output.grad).all()
    assert (output.grad != 0).sum() == 3


def test_loss_of_a_sample_does_not_depend_on_its_box_or_its_batch():
    target, mask = _problem()
    generator = torch.Generator().manual_seed(3)
    outputs = [
        torch.randn(2, 3, *(cells // factor for cells in (16, 8, 8)), generator=generator)
        for factor in (1, 4)
    ]
    losses = sample_losses(outputs, target, mask, cells=4096.0)
    wider = [functional.pad(tensor, (8, 0, 0, 8, 8, 8)) for tensor in (target, mask)]
    padded = [
        functional.pad(output, tuple(cells // factor for cells in (8, 0, 0, 8, 8, 8)))
        for output, factor in zip(outputs, (1, 4), strict=True)
    ]
    torch.testing.assert_close(sample_losses(padded, *wider, cells=4096.0), losses)
    for number in range(2):
        part = slice(number, number + 1)
        alone = multi_resolution_loss([output[part] for output in outputs], target[part], mask[part], 4096.0)
        torch.testing.assert_close(alone, losses[number])
    assert abs(float(losses[0] - losses[1])) > 1e-3


def test_distance_is_summed_as_a_length():
    mask = torch.zeros(1, 1, 8, 8, 8)
    mask[0, 0, :2, :2, :2] = 1.0
    target = mask.expand(-1, 3, -1, -1, -1) * torch.tensor([1.0, 2.0, 2.0]).view(1, 3, 1, 1, 1)
    nothing = torch.zeros_like(target)
    lost = float(sample_losses([nothing], target, mask, distance=True))
    assert lost == pytest.approx((math.sqrt(9.0 + 0.02**2) - 0.02) * 8 / 512, rel=1e-5)
    # Ten times the error costs ten times as much, and not a hundred times.
    tenfold = float(sample_losses([nothing], 10.0 * target, mask, distance=True))
    assert tenfold == pytest.approx(10.0 * lost, rel=0.01)
    found = target.clone().requires_grad_(True)
    exact = sample_losses([found], target, mask, distance=True)
    exact.sum().backward()
    assert float(exact.detach()) == pytest.approx(0.0, abs=1e-8)
    assert torch.isfinite(found.grad).all()


def test_channels_after_the_displacement_do_not_count():
    target, mask = _problem()
    output = torch.randn(2, 4, 16, 8, 8, generator=torch.Generator().manual_seed(5))
    for distance in (False, True):
        torch.testing.assert_close(
            sample_losses([output], target, mask, distance=distance),
            sample_losses([output[:, :3]], target, mask, distance=distance),
        )


def _claimed(log_sigma):
    """Outputs that are off by (1, 2, 2) everywhere and claim a standard deviation; target and mask."""
    mask = torch.zeros(1, 1, 8, 8, 8)
    mask[0, 0, :2, :2, :2] = 1.0
    error = torch.tensor([1.0, 2.0, 2.0]).view(1, 3, 1, 1, 1).expand(1, 3, 8, 8, 8)
    output = torch.cat([error, torch.full((1, 1, 8, 8, 8), log_sigma)], dim=1)
    return output.requires_grad_(True), torch.zeros(1, 3, 8, 8, 8), mask


@pytest.mark.parametrize("sigma", [0.5, math.sqrt(3.0), 5.0])
def test_likelihood_of_the_deviation_and_its_gradient(sigma):
    output, target, mask = _claimed(math.log(sigma))
    loss = sigma_losses(output, target, mask, 512.0)
    # Three components: 3 log(sigma) + |e|^2 / (2 sigma^2), in 8 of 512 cells.
    assert float(loss.detach()) == pytest.approx(
        (3.0 * math.log(sigma) + 9.0 / (2.0 * sigma**2)) * 8 / 512, rel=1e-5
    )
    loss.sum().backward()
    assert not output.grad[:, :3].any()  # the error is taken as it is
    expected = (3.0 - 9.0 / sigma**2) / 512
    torch.testing.assert_close(output.grad[:, 3:], mask * expected, rtol=1e-4, atol=1e-7)


def test_likelihood_is_highest_at_the_true_deviation():
    true = math.log(math.sqrt(9.0 / 3.0))  # root mean square of the three components
    losses = [
        float(sigma_losses(*_claimed(true + off), 512.0).detach()) for off in (-0.2, -0.02, 0.0, 0.02, 0.2)
    ]
    assert min(losses) == losses[2]
    assert losses[0] > losses[1] and losses[4] > losses[3]
