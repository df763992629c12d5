"""What a user can set: one frozen value, each field with its unit, its range or choices, and a description."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from softtissue_estimator.errors import InvalidInputError

NICENESS = 5
"""Of what runs beside the estimator: where both want a core, the estimator has three quarters of it."""


def setting(
    default: Any,
    description: str,
    *,
    unit: str = "",
    limits: tuple[float, float] | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """Return a field of a frozen dataclass of settings, with what parameters are derived from."""
    metadata = {"unit": unit, "range": limits, "choices": choices, "description": description}
    return dataclasses.field(default=default, metadata=metadata)


def niceness_setting() -> Any:
    """Return the field of those settings of whose process the estimator must not wait for."""
    return setting(
        NICENESS,
        "How far this process stands back behind others, as the command `nice` counts it; 0: not at all. Can only be "
        "given at the start.",
        limits=(0, 19),
    )


@dataclass(frozen=True)
class EstimatorConfig:
    """Settings of the estimator and of the node around it.

    The metadata of every field holds `unit` ('' if it has none), `range` (lowest, highest; both allowed; None
    if unlimited), `choices` (None if free) and `description`; parameters elsewhere are derived from them.

    Raises
    ------
    InvalidInputError
        If a value is of the wrong type, outside its range or not one of the choices.
    """

    estimator: str = setting(
        "elastic",
        "Which estimator answers: 'elastic', 'paper' (U-Net) or a registered one.",
    )
    organ: str = setting("", "Folder with organ.yaml; empty for the bundled phantom liver.")
    organ_root: tuple[str, ...] = setting(
        ("",),
        "Folders outside of which no organ and no file of one is read; an empty name stands for the bundled organs "
        "and the folder in which the configured organ lies. Can only be given at the start.",
    )
    checkpoint: str = setting("", "Network weights (safetensors); empty for the bundled ones.")
    device: str = setting(
        "auto", "Where the network runs; 'auto' takes a GPU if there is one.", choices=("auto", "cuda", "cpu")
    )
    precision: str = setting(
        "auto",
        "Floating-point format of the network's convolutions; 'auto' takes what is fastest: float16 on GPUs and with "
        "AMX-FP16, bfloat16 with AMX, else float32. Used by 'paper'.",
        choices=("auto", "float32", "bfloat16", "float16"),
    )
    autostart: bool = setting(True, "Configure and activate the node without being asked.")
    tracking: bool = setting(
        False,
        "Start every answer from the one before and improve it between frames, as the node does by default; otherwise "
        "every frame is answered on its own. Used by 'elastic'.",
    )
    tracking_patience_s: float = setting(
        0.02,
        "With tracking, how long an answer waits at most for what is found out between frames, where that takes longer "
        "than on two idle cores; answers come for it later from then on. If it is never reached, the same clouds have "
        "the same answers. Used by 'elastic'.",
        unit="s",
        limits=(0.0, 3600.0),
    )
    matching: str = setting(
        "auto",
        "How clouds are matched with the preoperative surface: 'given' by correspondences that come with them, "
        "'tracks' by a field `id`, 'closest' by the nearest surface whatever they carry; 'auto' by what each carries.",
        choices=("auto", "given", "tracks", "closest"),
    )
    organ_label: int = setting(
        -1,
        "Value of a cloud's field `label` that says that a point is of the organ; others are left out of a cloud "
        "without correspondences. -1: the field says nothing.",
        limits=(-1, 2**31 - 1),
    )
    viewpoint: str = setting(
        "auto",
        "From where a cloud without correspondences was seen: 'camera' is the origin of its frame, 'none' unknown; "
        "'auto' is 'camera' for clouds of a camera whose pose is told, and in frames whose name ends in _optical or "
        "_optical_frame.",
        choices=("auto", "camera", "none"),
    )
    default_sigma_m: float = setting(
        0.001,
        "Standard deviation of each component of a correspondence that states none, and of a point without one.",
        unit="m",
        limits=(1e-5, 0.05),
    )
    max_displacement_m: float = setting(
        0.15,
        "Correspondences that moved further than this are rejected, and points without one that far off the organ.",
        unit="m",
        limits=(0.001, 1.0),
    )
    max_reference_distance_m: float = setting(
        0.01,
        "Correspondences whose preoperative point is further than this from the organ's surface are rejected.",
        unit="m",
        limits=(0.0005, 0.03),
    )
    minimum_points: int = setting(
        3, "Fewest usable correspondences for an answer.", unit="points", limits=(3, 100_000)
    )
    minimum_visible_fraction: float = setting(
        0.05, "Below this visible share of the surface, the status is DEGRADED.", limits=(0.0, 1.0)
    )
    maximum_rejected_fraction: float = setting(
        0.5, "Above this share of rejected correspondences, the status is DEGRADED.", limits=(0.0, 1.0)
    )
    maximum_sigma_m: float = setting(
        0.005,
        "Where the standard deviation of any vertex of a structure exceeds this, the status is DEGRADED and names the "
        "structure. Twice the default is the margin of 10 mm that surgeons commonly leave around a tumour: beyond it a "
        "structure may lie on the other side of the margin in more than one case of twenty.",
        unit="m",
        limits=(0.0001, 1.0),
    )
    frame_budget_s: float = setting(
        0.1, "A frame that takes longer than this makes the status DEGRADED.", unit="s", limits=(0.001, 60.0)
    )
    no_data_timeout_s: float = setting(
        2.0, "Without a usable cloud for this long, the status says so.", unit="s", limits=(0.1, 3600.0)
    )
    registration_source: str = setting(
        "given",
        "Where the registration comes from: 'given' by messages or tf2; with 'auto' the node also searches for the "
        "organ in bare clouds, where none is given and after the organ was lost.",
        choices=("given", "auto"),
    )
    use_tf: bool = setting(
        True,
        "Ask tf2, where it is installed, for the organ's pose when no registration has arrived. Can only be given at "
        "the start.",
    )
    tf_timeout_s: float = setting(
        0.1,
        "How long a cloud waits for a transform, or a camera's pose, at its stamp; other clouds go on meanwhile.",
        unit="s",
        limits=(0.0, 2.0),
    )
    registration_max_age_s: float = setting(
        0.5,
        "A pose that moves may be this much older than its cloud: of tf2 or `camera_pose` such an answer is DEGRADED, "
        "and a cloud is refused beyond it; of a registration answers are DEGRADED beyond it. Static transforms and "
        "registrations that are published once hold on.",
        unit="s",
        limits=(0.0, 3600.0),
    )
    broadcast_registration: bool = setting(
        False,
        "Send the pose of `~/registration` on /tf, with every answer whose registration came by a topic; needs "
        "tf2_msgs.",
    )
    poisson_ratio: float = setting(
        0.35, "Poisson's ratio that is expected of the organ, used by 'elastic'.", limits=(0.0, 0.49)
    )
    poisson_ratio_sigma: float = setting(
        0.1,
        "Its standard deviation: within twice as much the observation decides; 0 where it is known. Used by 'elastic'.",
        limits=(0.0, 0.2),
    )
    prior_sigma_m: float = setting(
        0.015,
        "How far visible points are expected to move, before any observation; used by 'elastic'.",
        unit="m",
        limits=(0.0005, 0.1),
    )
    model_sigma_m: float = setting(
        0.0003,
        "Least error of the elastic model itself, which points of one small neighbourhood share; used by 'elastic'.",
        unit="m",
        limits=(1e-5, 0.01),
    )

    registration_sigma_m: float = setting(
        0.005,
        "Standard deviation of each component of the registration's translation, at the organ's centre: the largest "
        "that is expected. Used by 'elastic'.",
        unit="m",
        limits=(1e-5, 0.05),
    )
    registration_sigma_rad: float = setting(
        0.05,
        "Standard deviation of the registration's rotation about each axis: the largest that is expected. Used by "
        "'elastic'.",
        unit="rad",
        limits=(1e-5, 0.5),
    )
    sensor_bias_m: float = setting(
        0.002,
        "Standard deviation of a smooth error of the sensor along its ray, at most. Used by 'elastic'.",
        unit="m",
        limits=(0.0001, 0.02),
    )
    match_slide_m: float = setting(
        0.005,
        "Root mean square of how far correspondences slide along the surface together, at most: what a tracker loses. "
        "Used by 'elastic'.",
        unit="m",
        limits=(0.0002, 0.05),
    )
    track_slide_m_s: float = setting(
        0.0005,
        "How fast tracks (clouds with a field `id`) slide along the surface: growth of the standard deviation of each "
        "component of a track's place on the organ, from when it is first seen. Used by 'elastic' with `tracking`.",
        unit="m/s",
        limits=(0.0, 0.1),
    )
    attachment_length_m: float = setting(
        0.002,
        "Attached surface is held as by tissue of this thickness; more where it is uncertain what is attached. Used by "
        "'elastic'.",
        unit="m",
        limits=(0.0002, 1.0),
    )

    def __post_init__(self) -> None:
        check_settings(self)


def check_settings(settings: Any) -> None:
    """Check the fields of a dataclass that `setting` made.

    Raises
    ------
    InvalidInputError
        If a value is of the wrong type, outside its range or not one of the choices.
    """
    for field in dataclasses.fields(settings):
        _check(field, getattr(settings, field.name))


def _check(field: "dataclasses.Field[Any]", value: Any) -> None:
    kind: Any = type(field.default)
    unit = f" {field.metadata['unit']}" if field.metadata["unit"] else ""
    accepted: Any = (int, float) if kind is float else (kind,)
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise InvalidInputError(f"parameter {field.name}: expected {kind.__name__}, got {value!r}")
    if kind is tuple and not all(isinstance(item, str) for item in value):
        raise InvalidInputError(f"parameter {field.name}: expected texts, got {value!r}")
    choices = field.metadata["choices"]
    if choices is not None and value not in choices:
        raise InvalidInputError(
            f"parameter {field.name}: expected one of {', '.join(choices)}, got {value!r}"
        )
    limits = field.metadata["range"]
    if limits is not None and not (math.isfinite(value) and limits[0] <= value <= limits[1]):
        raise InvalidInputError(
            f"parameter {field.name}: expected {limits[0]} to {limits[1]}{unit}, got {value}{unit}"
        )
