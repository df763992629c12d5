"""What the command line of the executable `overlay` says and takes; nothing that draws is imported for it."""

from softtissue_estimator.overlay.settings import OverlaySettings
from softtissue_estimator.ros.command_line import Program

PROGRAM = Program(
    "overlay",
    "Draw the structures inside an organ on a camera's images.",
    "ros2 run softtissue_estimator overlay --ros-args -r image:=/camera/image_raw -r camera_info:=/camera/camera_info",
    OverlaySettings,
)
