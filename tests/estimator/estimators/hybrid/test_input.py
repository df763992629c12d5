"""What the hybrid network reads and what its outputs mean, apart from any organ's elasticity."""

import itertools
import math

import numpy as np
import pytest
import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.hybrid.input import (
    HYBRID_CHANNELS,
    VECTOR_CHANNELS,
    HybridSpec,
    ObservedMisfit,
    assemble_hybrid_input,
    posterior_cells,
    remainder,
    sample_field,
)
from softtissue_estimator.estimators.hybrid.network import HybridArchitecture, HybridNetwork, initialise
from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.network_input import OrganChannels

GRID = VoxelGrid((0.1, -0.2, 0.3), 0.01, (8, 12, 4))
SMALL = HybridArchitecture(widths=(4, 8), groups=2)


def organ() -> OrganChannels:
    """Inside is x < 0.14; attached is the first layer of cells."""
    distance = torch.from_numpy(GRID.points()[:, 0] - 0.14).float().reshape(GRID.shape)
    attached = torch.zeros(GRID.shape)
    attached[0] = 1.0
    return OrganChannels(GRID, distance, attached)


def test_every_channel_holds_what_its_name_says_in_its_own_scale():
    generator = torch.Generator().manual_seed(3)
    channels = organ()
    cells = posterior_cells(channels.signed_distance, GRID.spacing)
    assert len(cells) == 6 * 12 * 4  # x = 0.10 to 0.15: inside, and one cell beyond
    mean = torch.randn(len(cells), 3, generator=generator, dtype=torch.float64)
    sigma = torch.rand(len(cells), generator=generator, dtype=torch.float64) + 0.001
    at = (3, 5, 2)
    point = torch.from_numpy(GRID.points().reshape(*GRID.shape, 3)[at])[None]
    observed = ObservedMisfit(
        point, torch.tensor([[1e-3, 2e-3, -3e-3]]).double(), torch.tensor([0.003]).double()
    )
    scales = tuple(float(scale) for scale in range(1, 11))
    spec = HybridSpec(spacing=GRID.spacing, input_scales=scales)
    inputs = assemble_hybrid_input(channels, cells, mean, sigma, observed, spec)[0]
    assert inputs.shape == (len(HYBRID_CHANNELS), *GRID.shape)
    named = {name: field / scale for name, field, scale in zip(HYBRID_CHANNELS, inputs, scales, strict=True)}
    torch.testing.assert_close(named["signed_distance"], channels.signed_distance)
    torch.testing.assert_close(named["attached"], channels.zero_displacement)
    for axis, letter in enumerate("xyz"):
        field = named[f"posterior_mean_{letter}"].reshape(-1)
        torch.testing.assert_close(field[cells], mean[:, axis].float())
        assert field.abs().sum() == pytest.approx(float(mean[:, axis].abs().sum()), rel=1e-5)
        assert named[f"misfit_{letter}"][at] == pytest.approx((1e-3, 2e-3, -3e-3)[axis], rel=1e-5)
        assert VECTOR_CHANNELS[0][axis] == HYBRID_CHANNELS.index(f"posterior_mean_{letter}")
        assert VECTOR_CHANNELS[1][axis] == HYBRID_CHANNELS.index(f"misfit_{letter}")
    logarithm = named["posterior_log_sigma"].reshape(-1)[cells]
    torch.testing.assert_close(logarithm, (1e3 * sigma).log().float())
    # 1 / (1 + 3 mm / 1 mm); nothing beyond two cells.
    assert named["visible"][at] == pytest.approx(0.25)
    assert (named["visible"][5:] == 0).all() and (named["visible"][:, :3] == 0).all()


def test_precise_patches_outweigh_others_nearby():
    channels = organ()
    point = torch.from_numpy(GRID.points()[:1]).repeat(2, 1)
    observed = ObservedMisfit(
        point, torch.tensor([[0.001] * 3, [0.005] * 3]).double(), torch.tensor([0.001, 0.002])
    )
    none = torch.zeros(0, dtype=torch.long)
    inputs = assemble_hybrid_input(channels, none, torch.zeros(0, 3), torch.zeros(0), observed, HybridSpec())
    expected = (0.001 / 1e-6 + 0.005 / 4e-6) / (1 / 1e-6 + 1 / 4e-6)
    assert float(inputs[0, 7, 0, 0, 0]) / 500.0 == pytest.approx(expected, rel=1e-5)


def test_a_field_that_is_linear_in_the_position_is_sampled_exactly():
    coefficients = torch.tensor([[0.5, -1.0, 2.0], [3.0, 0.25, -0.5]])
    index = torch.stack(torch.meshgrid(*(torch.arange(n).float() for n in GRID.shape), indexing="ij"))
    field = torch.einsum("ca,axyz->cxyz", coefficients, index)[None]
    rng = np.random.default_rng(0)
    position = torch.from_numpy(rng.uniform(0, np.array(GRID.shape) - 1, size=(50, 3))).float()
    expected = position @ coefficients.T
    torch.testing.assert_close(sample_field(field, position[None])[0], expected, atol=1e-5, rtol=1e-5)
    # Beyond the outermost cells: as at the nearest point between them.
    outside = torch.tensor([[[-4.0, 5.5, 9.0]]])
    nearest = torch.tensor([[[0.0, 5.5, 3.0]]])
    torch.testing.assert_close(sample_field(field, outside), sample_field(field, nearest))


def test_outputs_of_zero_leave_the_posterior_as_it_is_to_the_last_bit():
    sigma = torch.rand(20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    added, predicted = remainder(torch.zeros(20, 4, dtype=torch.float64), sigma, HybridSpec())
    assert (added == 0).all() and torch.equal(predicted, sigma)


def test_outputs_are_in_units_of_the_posteriors_deviation_and_bounded():
    spec = HybridSpec(remainder_limit=6.0, log_sigma_limit=3.0, sigma_factor=1.5)
    sigma = torch.tensor([0.002, 0.001]).double()
    outputs = torch.tensor([[0.01, -0.02, 0.03, 0.05], [1e4, -1e4, 0.0, -1e4]]).double()
    added, predicted = remainder(outputs, sigma, spec)
    torch.testing.assert_close(added[0], 0.002 * outputs[0, :3], rtol=1e-4, atol=0.0)
    assert float(predicted[0]) == pytest.approx(1.5 * 0.002 * math.exp(0.05), rel=1e-4)
    torch.testing.assert_close(added[1], torch.tensor([0.006, -0.006, 0.0]).double())
    half = HybridSpec(remainder_gain=0.5, log_sigma_limit=3.0, sigma_factor=1.5)
    torch.testing.assert_close(remainder(outputs, sigma, half)[0], 0.5 * added)
    torch.testing.assert_close(remainder(outputs, sigma, half)[1], predicted)
    assert float(predicted[1]) == pytest.approx(1.5 * 0.001 * math.exp(-3.0))


def test_network_starts_at_zero_but_not_its_features():
    network = HybridNetwork(SMALL)
    initialise(network, torch.Generator().manual_seed(0))
    features = []
    network.heads[0].register_forward_hook(lambda module, given, output: features.append(given[0]))
    inputs = torch.randn(1, 10, 8, 12, 4, generator=torch.Generator().manual_seed(2))
    assert (network(inputs) == 0).all()
    assert 0.1 < float(features[0].detach().std()) < 10.0


@pytest.mark.parametrize("groups", [0, 2])
def test_every_output_sees_every_cell_of_an_organ(groups):
    network = HybridNetwork(HybridArchitecture(groups=groups, widths=(4, 4, 8)))
    initialise(network, torch.Generator().manual_seed(0))
    for weight in network.heads.parameters():
        torch.nn.init.ones_(weight)
    inputs = torch.randn(1, 10, 24, 24, 24, generator=torch.Generator().manual_seed(2), requires_grad=True)
    network(inputs)[0, 0, 0, 0, 0].backward()
    assert (inputs.grad[0].abs().amax(dim=0)[-1] > 0).any()


@pytest.mark.parametrize(("shape", "message"), [((1, 9, 8, 8, 8), "takes"), ((1, 10, 8, 9, 8), "multiples")])
def test_inputs_that_do_not_fit_are_refused(shape, message):
    with pytest.raises(InvalidInputError, match=message):
        HybridNetwork(SMALL)(torch.zeros(shape))


def test_upsampling_and_pooling_commute_with_mirrors():
    """With kernels that are even along every axis, the network must be equivariant to all 48 orientations."""
    network = HybridNetwork(SMALL)
    initialise(network, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for weight in network.heads.parameters():
            weight.normal_(generator=torch.Generator().manual_seed(5))
        for module in network.modules():
            if isinstance(module, torch.nn.Conv3d) and module.kernel_size == (3, 3, 3):
                turned = [
                    module.weight.permute(0, 1, *(2 + axis for axis in order)).flip([2 + a for a in axes])
                    for order in itertools.permutations(range(3))
                    for axes in (a for k in range(4) for a in itertools.combinations(range(3), k))
                ]
                module.weight.copy_(torch.stack(turned).mean(dim=0))
    inputs = torch.randn(1, 10, 8, 8, 8, generator=torch.Generator().manual_seed(2))
    expected = network(inputs).permute(0, 1, 3, 2, 4).flip(4)
    torch.testing.assert_close(network(inputs.permute(0, 1, 3, 2, 4).flip(4)), expected, atol=1e-4, rtol=1e-4)
