"""What a user can set of the overlay, with unit, range and description as `EstimatorConfig` has it."""

from dataclasses import dataclass

from softtissue_estimator.config import check_settings, niceness_setting, setting


@dataclass(frozen=True)
class OverlaySettings:
    """Settings of the overlay and of the node around it.

    Raises
    ------
    InvalidInputError
        If a value is of the wrong type, outside its range or not one of the choices.
    """

    estimator_node: str = setting(
        "softtissue_estimator", "Name of the node whose answers are drawn. Can only be given at the start."
    )
    image_transport: str = setting(
        "raw",
        "Which images are taken: 'raw' from `image`, 'compressed' from `image/compressed`. Can only be given at the "
        "start.",
        choices=("raw", "compressed"),
    )
    rectified: bool = setting(
        False,
        "The images are rectified: the projection matrix of `camera_info` holds, without distortion.",
    )
    clock_offset_s: float = setting(
        0.0,
        "Added to the stamps of images, it gives those of the clock that stamps the clouds.",
        unit="s",
        limits=(-3600.0, 3600.0),
    )
    maximum_age_s: float = setting(
        0.3,
        "Nothing is drawn from an answer whose cloud is older than this, or by as much younger, than the image.",
        unit="s",
        limits=(0.01, 60.0),
    )
    maximum_mask_age_s: float = setting(
        0.2,
        "A mask of instruments that is older than this, or by as much younger, than the image does not count.",
        unit="s",
        limits=(0.001, 60.0),
    )
    margin_mm: float = setting(
        10.0,
        "Width of the margin round tumours whose contour is drawn; 0: none.",
        unit="mm",
        limits=(0.0, 50.0),
    )
    names: bool = setting(True, "Write the names of structures and their depths, where there is place.")
    jpeg_quality: int = setting(90, "Of the compressed images.", limits=(1, 100))
    niceness: int = niceness_setting()

    def __post_init__(self) -> None:
        check_settings(self)
