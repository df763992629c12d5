"""Everything that decides what the scene is, besides the shapes' own numbers."""

from dataclasses import dataclass, field

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.phantom.spec import PhantomSpec, Push
from softtissue_training.scene.camera import StereoCamera


@dataclass(frozen=True)
class Breathing:
    """A force that the diaphragm spreads over the dome.

    Attributes
    ----------
    period
        s, of a breath.
    steady_n
        N, what is always there.
    push
        Where and how large the force is that comes on top, breathed in.
    """

    period: float = 4.0
    steady_n: float = 1.0
    push: Push = field(
        default_factory=lambda: Push(
            point=(-0.036, -0.012, 0.075), radius=0.040, direction=(0.0, -0.20, -0.98), peak_n=1.2
        )
    )


@dataclass(frozen=True)
class SceneSpec:
    """Settings of one scene. Lengths in metres, times in seconds.

    Attributes
    ----------
    phantom
        The organ: seed, tissue, elements; its markers.
    breathing, push, push_start
        What moves it, and when the push begins.
    run_up
        Before time 0, in which the steady force comes on.
    states
        Equilibria that are computed, evenly spread in time, the undeformed one among them.
    neighbour_spacing
        Edge lengths of what lies around the organ.
    frames, rate_hz, first_frame, points
        Of the clouds.
    tracks
        Features that are followed at a time.
    image_rate_hz, pose_rate_hz
        Of the images and of the camera's pose.
    camera
        The laparoscope.
    """

    phantom: PhantomSpec = field(default_factory=lambda: PhantomSpec(marker_motion=(0.008, 0.040)))
    breathing: Breathing = field(default_factory=Breathing)
    push: Push = field(default_factory=lambda: Push(peak_n=2.2))
    push_start: float = 1.5
    run_up: float = 1.0
    states: int = 46
    neighbour_spacing: float = 0.009
    frames: int = 100
    rate_hz: float = 10.0
    first_frame: float = 0.2
    points: int = 4000
    tracks: int = 300
    image_rate_hz: float = 5.0
    pose_rate_hz: float = 20.0
    camera: StereoCamera = field(default_factory=StereoCamera)

    def __post_init__(self) -> None:
        for name in ("frames", "points", "tracks"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"expected {name} of at least 1, got {getattr(self, name)}")
        if self.push_start >= self.duration:
            raise InvalidInputError(
                f"expected a push that starts before the last frame ({self.duration:g} s), got {self.push_start:g} s"
            )
        if self.states < 2:
            raise InvalidInputError(f"expected at least 2 states to interpolate between, got {self.states}")

    @property
    def duration(self) -> float:
        """Time (s) of the last frame."""
        return self.first_frame + (self.frames - 1) / self.rate_hz
