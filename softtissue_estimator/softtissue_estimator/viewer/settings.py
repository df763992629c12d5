"""What a user can set of the viewer, with unit, range and description as `EstimatorConfig` has it."""

from dataclasses import dataclass

from softtissue_estimator.config import check_settings, niceness_setting, setting


@dataclass(frozen=True)
class ViewerSettings:
    """Settings of the viewer and of the node around it.

    Raises
    ------
    InvalidInputError
        If a value is of the wrong type, outside its range or not one of the choices.
    """

    estimator_node: str = setting(
        "softtissue_estimator", "Name of the node whose answers are shown. Can only be given at the start."
    )
    image_transport: str = setting(
        "none",
        "Which images are shown at the camera: 'raw' from `image`, 'compressed' from `image/compressed`; 'none': none. "
        "They need the extra `overlay`. Can only be given at the start.",
        choices=("none", "raw", "compressed"),
    )
    host: str = setting(
        "127.0.0.1",
        "Address on which the page is served; whoever reaches it may press the buttons. Can only be given at the "
        "start.",
    )
    port: int = setting(
        8080, "Port of the page; 0: any free one. Can only be given at the start.", limits=(0, 65535)
    )
    buttons: bool = setting(
        True,
        "Offer the buttons that ask the node to register, to reset and to load an organ; without them the page only "
        "shows. Can only be given at the start.",
    )
    rate_hz: float = setting(
        20.0,
        "How often the page changes at most. Can only be given at the start.",
        unit="Hz",
        limits=(0.5, 20.0),
    )
    maximum_age_s: float = setting(
        1.0,
        "Without a new answer for this long, the page says so and shows no structures.",
        unit="s",
        limits=(0.05, 60.0),
    )
    maximum_points: int = setting(
        3000, "Observed points that are shown of a cloud at most; 0: none.", limits=(0, 100_000)
    )
    sigma_scale_mm: float = setting(
        5.0, "Standard deviation that has the last colour of the scale.", unit="mm", limits=(0.1, 100.0)
    )
    recording_s: float = setting(
        60.0,
        "How far back the time-line and the exported file reach; 0: nothing is recorded. Can only be given at the "
        "start.",
        unit="s",
        limits=(0.0, 3600.0),
    )
    recording_mb: int = setting(
        128, "Most memory of the recording, in megabytes. Can only be given at the start.", limits=(1, 4096)
    )
    niceness: int = niceness_setting()

    def __post_init__(self) -> None:
        check_settings(self)
