"""What the command line of the executable `igtl_bridge` says and takes; no socket is opened for it."""

from softtissue_estimator.igtl.settings import BridgeSettings
from softtissue_estimator.ros.command_line import Program

PROGRAM = Program(
    "igtl_bridge",
    "Send the structures inside an organ to 3D Slicer and other clients of OpenIGTLink.",
    "ros2 run softtissue_estimator igtl_bridge --ros-args -p port:=18944 -p coordinates:=LPS",
    BridgeSettings,
)
