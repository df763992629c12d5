"""What a network's input and output mean: grid, channels, scales and frame, as its checkpoint says.

Channel order and scales follow the paper (section "Grid"): signed distance and zero-displacement flag are multiplied by
0.1, everything is in metres. A network may carry a further common factor (`NetworkSpec.input_scales`), which is the
same function of its inputs with a better conditioned first layer.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from softtissue_estimator.estimators.paper.network import UNetArchitecture
from softtissue_estimator.estimators.paper.rigid_frame import ORGAN, RIGID

CHANNELS = (
    "signed_distance",
    "visible_displacement_x",
    "visible_displacement_y",
    "visible_displacement_z",
    "zero_displacement",
)
OBSERVED = (
    "observed"  # 1 where something was observed: a point that did not move is told from one that was not seen
)
PAPER_SCALES = (0.1, 1.0, 1.0, 1.0, 0.1)
COMMON_FACTOR = 50.0  # one network unit is then 20 mm, near the displacements that are to be told apart
LOG_SIGMA_RANGE = (-6.0, 4.0)  # of a standard deviation in the network's unit of length
RIGID_UNIT_M = 0.005  # what is left to tell apart in the frame of the rigid motion


@dataclass(frozen=True)
class NetworkSpec:
    """What a network needs to know about its input; stored in its checkpoint, never a parameter.

    Attributes
    ----------
    spacing
        Distance between cell centres, metres.
    channels
        Names of the input channels, in order.
    input_scales
        Factor of each channel, from SI units to the network's.
    output_scale
        Metres of displacement per unit of output.
    cube_side_m
        Side of the cube that the network was trained on; 0 if it was trained on the organ's bounding box.
    margin_cells
        Free cells on each side of the organ's bounding box.
    architecture
        Shapes of the weights.
    frame
        Frame of all displacements: "organ", or "rigid", that of the rigid motion of what is observed (`rigid_frame`).
    sigma_scale
        Factor from the standard deviation that the network says to the one that held-out organs show; 0 where no
        factor makes it true, and no standard deviation is given.
    """

    spacing: float = 0.30 / 64
    channels: tuple[str, ...] = CHANNELS
    input_scales: tuple[float, ...] = tuple(scale * COMMON_FACTOR for scale in PAPER_SCALES)
    output_scale: float = 1.0 / COMMON_FACTOR
    cube_side_m: float = 0.0
    margin_cells: int = 2
    architecture: UNetArchitecture = UNetArchitecture()
    frame: str = ORGAN
    sigma_scale: float = 1.0

    @property
    def gives_sigma(self) -> bool:
        """Whether a fourth output is the logarithm of the standard deviation of each component."""
        return self.architecture.out_channels == 4

    @property
    def sigma_is_calibrated(self) -> bool:
        """Whether the network gives a standard deviation that held-out organs bear out."""
        return self.gives_sigma and self.sigma_scale > 0.0


_SPEC_FIELDS = frozenset(field.name for field in fields(NetworkSpec))


def rigid_spec(spacing: float, *, sigma: bool = True, observed: bool = True, **changes: Any) -> NetworkSpec:
    """Return the specification of a network in the frame of the rigid motion.

    Parameters
    ----------
    sigma
        Whether it says how sure it is.
    observed
        Whether a sixth channel says what was observed.
    changes
        Other fields of `NetworkSpec`, and of its architecture.
    """
    spec_changes = {name: changes.pop(name) for name in list(changes) if name in _SPEC_FIELDS}
    architecture = UNetArchitecture(
        in_channels=6 if observed else 5, out_channels=4 if sigma else 3, **changes
    )
    unit = 1.0 / RIGID_UNIT_M
    distance, flag = (COMMON_FACTOR * PAPER_SCALES[index] for index in (0, -1))
    return NetworkSpec(
        spacing=spacing,
        channels=(*CHANNELS, OBSERVED) if observed else CHANNELS,
        input_scales=(distance, unit, unit, unit, flag, *([1.0] if observed else [])),
        output_scale=RIGID_UNIT_M,
        architecture=architecture,
        frame=RIGID,
        **spec_changes,
    )
