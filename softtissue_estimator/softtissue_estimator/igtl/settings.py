"""What a user can set of the bridge, with unit, range and description as `EstimatorConfig` has it."""

from dataclasses import dataclass

from softtissue_estimator.config import check_settings, niceness_setting, setting


@dataclass(frozen=True)
class BridgeSettings:
    """Settings of the bridge and of the node around it.

    Raises
    ------
    InvalidInputError
        If a value is of the wrong type, outside its range or not one of the choices.
    """

    estimator_node: str = setting(
        "softtissue_estimator", "Name of the node whose answers are sent. Can only be given at the start."
    )
    host: str = setting(
        "127.0.0.1",
        "Address on which clients are listened for. OpenIGTLink has neither passwords nor encryption: on any other "
        "address whoever reaches it hears all. Can only be given at the start.",
    )
    port: int = setting(
        18944,
        "Port on which clients are listened for; 0 for any that is free. Can only be given at the start.",
        limits=(0, 65535),
    )
    rate_hz: float = setting(
        10.0,
        "Each surface is sent at most so often. Can only be given at the start.",
        unit="Hz",
        limits=(0.1, 60.0),
    )
    surface: bool = setting(True, "Send the organ's surface too. Can only be given at the start.")
    coordinates: str = setting(
        "LPS",
        "Coordinate system of the organ's frame, that of the meshes in its folder; what is sent is in RAS. Can only "
        "be given at the start.",
        choices=("LPS", "RAS"),
    )
    maximum_age_s: float = setting(
        1.0,
        "Without a new answer for this long the status says so, and surfaces are no longer sent.",
        unit="s",
        limits=(0.05, 60.0),
    )
    niceness: int = niceness_setting()

    def __post_init__(self) -> None:
        check_settings(self)
