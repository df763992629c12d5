"""Settings of a training run; saved beside its weights."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.network import UNetArchitecture
from softtissue_estimator.network_input import NetworkSpec


@dataclass(frozen=True)
class TrainingConfig:
    """What decides the outcome of a training run, beside its data and its time.

    Attributes
    ----------
    name
        Name of the configuration.
    spec
        Grid, scales and architecture of the network.
    batch_size
        Samples a step.
    learning_rate
        Highest learning rate of Adam.
    warmup_steps
        Steps over which the learning rate rises to its highest value; from there it falls to zero as half a cosine of
        the time spent.
    ema_decay
        Decay a step of the moving average of the weights, which is what is validated and kept; 0 for none.
    visible_share
        Lowest and highest share of the surface that is seen, in training.
    validation_visible_share
        The same in validation.
    validation_every
        One organ out of this many is held out.
    validation_samples
        Held-out organs that are used at most.
    exchange_axes
        Turn organs onto other axes as well as mirroring them.
    seed
        Seed of the initial weights, of the order of samples and of what is seen of them.
    """

    name: str = "paper"
    spec: NetworkSpec = field(default_factory=NetworkSpec)
    batch_size: int = 2
    learning_rate: float = 3e-4
    warmup_steps: int = 200
    ema_decay: float = 0.998
    visible_share: tuple[float, float] = (0.08, 1.0)
    validation_visible_share: tuple[float, float] = (0.08, 0.6)
    validation_every: int = 20
    validation_samples: int = 100
    exchange_axes: bool = True
    seed: int = 1

    def to_json(self) -> dict[str, Any]:
        """Return the settings as JSON can hold them."""
        return asdict(self)


CONFIGS = {
    "paper": TrainingConfig(spec=NetworkSpec(margin_cells=1)),
    # The same network on cells of twice the size: a step costs an eighth, which is what a CPU can afford.
    "paper-coarse": TrainingConfig(
        name="paper-coarse", spec=NetworkSpec(spacing=0.30 / 32, margin_cells=0), batch_size=4
    ),
    # For tests and for trying things out.
    "tiny": TrainingConfig(
        name="tiny",
        spec=NetworkSpec(
            spacing=0.30 / 16,
            margin_cells=1,
            architecture=UNetArchitecture(
                widths=(8, 8, 16, 16),
                encoder_convolutions=1,
                bottleneck_convolutions=2,
                decoder_convolutions=1,
            ),
        ),
        warmup_steps=10,
        ema_decay=0.9,
        validation_samples=8,
        validation_every=4,
    ),
}


def get_config(name: str, **changes: Any) -> TrainingConfig:
    """Return a named configuration with some settings changed.

    Raises
    ------
    InvalidInputError
        There is no configuration of that name.
    """
    if name not in CONFIGS:
        raise InvalidInputError(f"the configuration must be one of {', '.join(CONFIGS)}, got {name!r}")
    return replace(CONFIGS[name], **changes)
