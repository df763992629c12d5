"""What the command line of the executable `viewer` says and takes; nothing that draws is imported for it."""

from softtissue_estimator.ros.command_line import Program
from softtissue_estimator.viewer.settings import ViewerSettings

PROGRAM = Program(
    "viewer",
    "Serve a live page of the organ and its structures at http://127.0.0.1:8080.",
    "ros2 run softtissue_estimator viewer --ros-args -r surface_points:=/tracker/points -p port:=8081",
    ViewerSettings,
)
