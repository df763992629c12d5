"""Settings of a training run; saved beside its weights."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec, rigid_spec
from softtissue_training.organs.organ_shape import CUBE_SIDE_M

Loss = Literal["squared", "distance"]


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
        Samples a step, over all processes.
    learning_rate
        Highest learning rate of Adam.
    warmup_steps
        Steps over which the learning rate rises to its highest value.
    ema_decay
        Decay a step of the moving average of the weights, which is what is validated and kept; 0 for none.
    visible_share
        Lowest and highest share of the surface that is visible, in training.
    common_share
        Half of the visible shares are drawn from this range, the others from `visible_share` on a logarithmic scale;
        None: all of them evenly from that.
    noise_m
        Lowest and highest standard deviation of the Gaussian noise on each component of a visible point's
        displacement, metres; drawn anew each time a sample is used.
    noisy
        Share of the views with noise.
    correspondences
        Lowest and highest number of visible points whose displacement is known, drawn uniformly on a logarithmic
        scale; None: all of them.
    sparse
        Share of the views of which only so many points are known.
    misregistered
        Share of the views that are seen with a registration that is off.
    misregistration
        By up to which angle (rad) and distance (m).
    misattached
        Share of the views for which the attached region is told too small or too large.
    misattachment
        By which share of its area.
    orientations
        8: mirrored copies, as in the paper; 48: axes exchanged as well; 1: none.
    redraw
        Draw the visible patch, its noise and correspondences anew each time a sample is used, not once for all.
    larger_box_share
        Share of the batches that see more of the surroundings than the organ's own box, up to the whole cube, with the
        organ anywhere in it.
    loss
        "squared", the paper's, or "distance", which large errors dominate less.
    sigma_weight
        Weight of the likelihood of the standard deviation, if the network gives one, beside the loss.
    validation_visible_share
        Share of the surface that is visible, in validation.
    validation_every
        One organ out of this many is held out, with all its load cases; 0: the samples that are trained on are
        validated with the patches that they are trained with, which shows whether a network learns them by heart.
    validation_samples
        Held-out organs that are used at most.
    seed
        Seed of the initial weights, of the order of samples and of what is observed of them.
    """

    name: str = "paper"
    spec: NetworkSpec = field(default_factory=NetworkSpec)
    batch_size: int = 4
    learning_rate: float = 3e-4
    warmup_steps: int = 200
    ema_decay: float = 0.998
    visible_share: tuple[float, float] = (0.02, 1.0)
    common_share: tuple[float, float] | None = None
    noise_m: tuple[float, float] = (0.0, 0.0)
    noisy: float = 1.0
    correspondences: tuple[int, int] | None = None
    sparse: float = 1.0
    misregistered: float = 0.0
    misregistration: tuple[float, float] = (math.radians(10.0), 0.020)
    misattached: float = 0.0
    misattachment: float = 0.3
    orientations: int = 48
    redraw: bool = True
    larger_box_share: float = 0.0
    loss: Loss = "squared"
    sigma_weight: float = 0.03
    validation_visible_share: tuple[float, float] = (0.08, 0.6)
    validation_every: int = 10
    validation_samples: int = 100
    seed: int = 1

    def __post_init__(self) -> None:
        for name in ("visible_share", "validation_visible_share"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high <= 1.0:
                raise InvalidInputError(
                    f"{name} must be two shares with 0 < low <= high <= 1, got {low}, {high}"
                )
        if not 0.0 <= self.noise_m[0] <= self.noise_m[1]:
            raise InvalidInputError(
                f"noise must be a range from low to high, at least 0, got {self.noise_m} m"
            )
        if self.correspondences is not None and not 1 <= self.correspondences[0] <= self.correspondences[1]:
            raise InvalidInputError(
                f"correspondences must be a range from low to high, at least 1, got {self.correspondences}"
            )
        if self.loss not in get_args(Loss):
            raise InvalidInputError(f"loss must be one of {', '.join(get_args(Loss))}, got {self.loss!r}")
        if not 0.0 <= self.ema_decay < 1.0:
            raise InvalidInputError(f"ema_decay must be at least 0 and below 1, got {self.ema_decay}")
        if self.orientations not in (1, 8, 48):
            raise InvalidInputError(f"orientations must be 1, 8 or 48, got {self.orientations}")
        if self.validation_every == 0 and self.redraw:
            raise InvalidInputError(
                "patches must not be drawn anew where training samples are validated, got redraw"
            )

    @property
    def exchange_axes(self) -> bool:
        """Whether organs are turned onto other axes as well as mirrored."""
        return self.orientations == 48

    @property
    def cube_cells(self) -> float:
        """Cells of the cube of 0.30 m at full resolution, by which the loss is divided (N^3 in the paper)."""
        return (CUBE_SIDE_M / self.spec.spacing) ** 3

    def to_json(self) -> dict[str, Any]:
        """Return the settings as JSON can hold them."""
        return asdict(self)


_PAPER = TrainingConfig(
    spec=rigid_spec(CUBE_SIDE_M / 64, margin_cells=1),
    common_share=(0.08, 0.6),
    noise_m=(0.0, 0.003),
    noisy=0.3,
    correspondences=(8, 60),
    sparse=0.15,
    misregistered=0.1,
    misattached=0.2,
    loss="distance",
    validation_samples=1000,
)
CONFIGS = {
    # In the frame of the rigid motion of what is observed, on the paper's cells.
    "paper": _PAPER,
    # The same network on cells of twice the size: a step costs an eighth, which is what a CPU can afford.
    "paper-coarse": replace(
        _PAPER, name="paper-coarse", spec=rigid_spec(CUBE_SIDE_M / 32, margin_cells=0), validation_samples=200
    ),
    # As published: displacements in the organ's frame, five channels, exact inputs, mirrored copies.
    "paper-original": TrainingConfig(
        name="paper-original", spec=NetworkSpec(margin_cells=1), orientations=8, validation_samples=1000
    ),
    # For tests and for trying things out.
    "tiny": TrainingConfig(
        name="tiny",
        spec=rigid_spec(
            CUBE_SIDE_M / 16,
            margin_cells=1,
            widths=(8, 8, 16, 16),
            encoder_convolutions=1,
            bottleneck_convolutions=2,
            decoder_convolutions=1,
        ),
        batch_size=2,
        warmup_steps=10,
        ema_decay=0.9,
        validation_samples=8,
        validation_every=4,
    ),
}
# Learns a few organs by heart: nothing is drawn anew, and all of them, on the whole cube, make one batch.
CONFIGS["overfit"] = replace(
    CONFIGS["tiny"],
    name="overfit",
    spec=replace(
        CONFIGS["tiny"].spec,
        cube_side_m=CUBE_SIDE_M,
        architecture=replace(CONFIGS["tiny"].spec.architecture, widths=(16, 16, 32, 32)),
    ),
    batch_size=8,
    learning_rate=3e-3,
    ema_decay=0.95,
    visible_share=(0.5, 0.5),
    orientations=1,
    redraw=False,
    validation_every=0,
)


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
