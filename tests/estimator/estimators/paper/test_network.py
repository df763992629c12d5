"""The U-Net: size, outputs, receptive field and initialisation."""

import pytest
import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture, initialise, parameter_count

SMALL = UNetArchitecture(widths=(4, 6, 6, 8))


def test_paper_network_has_nine_million_weights() -> None:
    assert parameter_count(UNet()) == 9_080_844


def test_outputs_at_four_resolutions() -> None:
    outputs = UNet(SMALL).forward_all(torch.zeros(2, 5, 16, 24, 32))
    assert [tuple(o.shape) for o in outputs] == [
        (2, 3, 2, 3, 4),
        (2, 3, 4, 6, 8),
        (2, 3, 8, 12, 16),
        (2, 3, 16, 24, 32),
    ]


def test_forward_is_the_finest_output() -> None:
    torch.manual_seed(0)
    network, inputs = UNet(SMALL), torch.randn(1, 5, 16, 16, 16)
    torch.testing.assert_close(network(inputs), network.forward_all(inputs)[-1])


def test_every_output_sees_every_input() -> None:
    """Gradient of one corner's output with respect to the opposite corner's input, on the paper's 64^3 grid."""
    torch.manual_seed(0)
    # Positive weights, double precision: no cancellation and no underflow can hide a path. Two maps a level suffice:
    # the receptive field depends on kernels and depths alone.
    network = UNet(UNetArchitecture(widths=(2, 2, 2, 2))).double()
    with torch.no_grad():
        for weight in network.parameters():
            weight.fill_(0.05)
    inputs = torch.zeros(1, 5, 64, 64, 64, dtype=torch.double, requires_grad=True)
    network(inputs)[0, 0, 0, 0, 0].backward()
    assert inputs.grad is not None
    assert float(inputs.grad[0, 0, 63, 63, 63]) > 0.0
    assert bool((inputs.grad > 0.0).all())


@pytest.mark.parametrize("shape", [(1, 4, 16, 16, 16), (1, 5, 16, 16, 20), (5, 16, 16, 16)])
def test_wrong_input_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInputError, match="got"):
        UNet(SMALL)(torch.zeros(shape))


def _effect_of_the_input(network: UNet, example: torch.Tensor) -> float:
    with torch.no_grad():
        return float((network(example) - network(example.flip(2))).std())


def test_initialisation_keeps_the_signal_alive() -> None:
    generator = torch.Generator().manual_seed(3)
    network = UNet(UNetArchitecture(widths=(8, 8, 8, 16)))
    # Channels of very different size, as signed distance and flag are.
    scale = torch.tensor([1.0, 0.1, 0.1, 0.1, 0.01]).reshape(1, 5, 1, 1, 1)
    example = torch.randn(1, 5, 16, 16, 16, generator=generator) * scale
    default_effect = _effect_of_the_input(network, example)
    reached = initialise(network, example, generator=generator)
    hidden = [std for name, std in reached.items() if not name.startswith("heads")]
    assert len(hidden) == 2 * 3 + 5 + 2 * 3
    assert all(std == pytest.approx(1.0, rel=1e-3) for std in hidden)
    assert all(
        std == pytest.approx(0.1, rel=1e-3) for name, std in reached.items() if name.startswith("heads")
    )
    # What is guarded against: with the default the output hardly depends on the input at all.
    assert _effect_of_the_input(network, example) > 10 * default_effect
