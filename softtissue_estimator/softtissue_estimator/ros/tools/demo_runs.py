"""Recordings that the demo can play, and how."""

from dataclasses import dataclass
from pathlib import Path

TRUE_POSE = ("/organ_pose_truth:=/registration",)
UNREGISTERED = "bare_unregistered"
# Kinds of clouds that the bundled scene shows: names under which its topics are heard, and which one holds the clouds.
# Where nothing is said of the registration the node finds the organ itself; that is played on request alone.
SCENE = {
    "tracks": (TRUE_POSE, "tracked_points"),
    "bare": (TRUE_POSE, "surface_points"),
    UNREGISTERED: ((), "surface_points"),
}
DRAWN = "bare"
"""Whose answer is drawn on the laparoscope's image, where it is played; else that of the first one."""


@dataclass(frozen=True)
class Run:
    """One recording, played to a node with one estimator.

    Attributes
    ----------
    input : str
        What its clouds are: "pairs", or one of `SCENE`.
    estimator : str
    bag : Path
    remap : tuple of str
        Names of topics, as ROS takes them.
    clouds : str
        Topic of the bag that is played as `surface_points`.
    snapshot_ns : int or None
        Stamp of the frame that is kept for the picture.
    view_ns : tuple of int
        Stamps of frames of which one is kept for the picture of the overlay, best first.
    """

    input: str
    estimator: str
    bag: Path
    remap: tuple[str, ...] = ()
    clouds: str = "surface_points"
    snapshot_ns: int | None = None
    view_ns: tuple[int, ...] = ()

    @property
    def folder(self) -> str:
        """Name of the folder of its results."""
        return self.estimator if self.input == "pairs" else f"{self.input}-{self.estimator}"

    @property
    def played_as(self) -> tuple[str, ...]:
        """Names of topics for the replay."""
        if self.clouds == "surface_points":
            return self.remap
        return (*self.remap, "/surface_points:=/other_points", f"/{self.clouds}:=/surface_points")

    @property
    def title(self) -> str:
        """What its table is headed with."""
        return f"{self.input}: estimator {self.estimator}"
