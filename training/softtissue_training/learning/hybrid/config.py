"""Settings of a training run of the hybrid network; saved beside its weights."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.hybrid.input import HybridSpec
from softtissue_estimator.estimators.hybrid.network import HybridArchitecture


@dataclass(frozen=True)
class HybridConfig:
    """What decides the outcome of a training run, beside its data and its time.

    Attributes
    ----------
    name
        Name of the configuration.
    spec
        Grid, scales and architecture of the network.
    batch_size
        Views a step, over all processes.
    learning_rate
        Highest learning rate of Adam.
    warmup_steps
        Steps over which the learning rate rises to its highest value.
    ema_decay
        Decay a step of the moving average of the weights, which is what is validated and kept; 0 for none.
    orientations
        48: mirrored and turned copies; 8: mirrored; 1: none.
    visible_weight
        Weight in the loss of a point on the visible surface; others have one.
    balance
        The error of a view counts with (e + 0.2 mm)^-balance, e the elastic posterior's own: 0 minimises the mean
        error in millimetres, 1 the error relative to the posterior's.
    likelihood
        Weight of the standard deviation's likelihood beside the error.
    validation_every
        One organ out of this many is held out; 0: the views that are trained on are validated.
    validation_views
        Held-out views that are used at most.
    seed
        Seed of the initial weights, of the order of views and of their orientations.
    """

    name: str = "hybrid"
    spec: HybridSpec = field(default_factory=HybridSpec)
    batch_size: int = 4
    learning_rate: float = 2e-3
    warmup_steps: int = 100
    ema_decay: float = 0.998
    orientations: int = 48
    visible_weight: float = 0.25
    balance: float = 0.5
    likelihood: float = 0.1
    validation_every: int = 10
    validation_views: int = 240
    seed: int = 1

    def __post_init__(self) -> None:
        if self.orientations not in (1, 8, 48):
            raise InvalidInputError(f"orientations must be 1, 8 or 48, got {self.orientations}")
        if not 0.0 <= self.balance <= 1.0:
            raise InvalidInputError(f"balance must be from 0 to 1, got {self.balance}")

    def to_json(self) -> dict[str, Any]:
        """Return the settings as JSON can hold them."""
        return asdict(self)


HYBRID_CONFIGS = {
    "hybrid": HybridConfig(),
    # The paper's resolution and four times the weights, for a GPU.
    "hybrid-full": HybridConfig(
        name="hybrid-full",
        spec=HybridSpec(
            spacing=0.30 / 64, margin_cells=2, architecture=HybridArchitecture(widths=(32, 64, 96, 128))
        ),
        batch_size=8,
        validation_views=1000,
    ),
    # For tests and for trying things out.
    "hybrid-tiny": HybridConfig(
        name="hybrid-tiny",
        spec=HybridSpec(
            spacing=0.30 / 16,
            architecture=HybridArchitecture(
                widths=(8, 16), encoder_convolutions=1, bottleneck_convolutions=1, decoder_convolutions=1
            ),
        ),
        batch_size=2,
        warmup_steps=10,
        ema_decay=0.9,
        validation_every=4,
        validation_views=16,
    ),
}


def get_hybrid_config(name: str, **changes: Any) -> HybridConfig:
    """Return a named configuration with some settings changed.

    Raises
    ------
    InvalidInputError
        There is no configuration of that name.
    """
    if name not in HYBRID_CONFIGS:
        raise InvalidInputError(f"the configuration must be one of {', '.join(HYBRID_CONFIGS)}, got {name!r}")
    return replace(HYBRID_CONFIGS[name], **changes)
