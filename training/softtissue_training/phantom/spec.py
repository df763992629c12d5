"""Everything that decides what the phantom is, besides the shape's own numbers."""

from dataclasses import dataclass, field

from softtissue_estimator.errors import InvalidInputError


@dataclass(frozen=True)
class Push:
    """A force that acts on one side of the organ; positions and directions in the organ's frame.

    Attributes
    ----------
    point
        m; the middle of the pushed area is the surface point nearest to it.
    radius
        m, standard deviation of the force's bell shape over the surface.
    direction, sway
        Directions (unit length is not needed) of the push, and of the sideways movement after it.
    peak_n
        N, size of the force at the peak.
    """

    point: tuple[float, float, float] = (-0.09, -0.01, -0.035)
    radius: float = 0.026
    direction: tuple[float, float, float] = (0.97, 0.10, 0.22)
    sway: tuple[float, float, float] = (0.0, 0.8, -0.6)
    peak_n: float = 2.8


@dataclass(frozen=True)
class PhantomSpec:
    """Settings of one phantom. Lengths in metres, times in seconds.

    Attributes
    ----------
    seed
        Of every random choice: shape, vessels, tumour, sensor noise.
    surface_spacing, vessel_spacing, element_size
        Edge lengths of the organ's surface, of the structures and of the finite elements.
    portal_ends, hepatic_ends
        Ends of the two vessel trees.
    youngs_modulus_pa, poisson_ratio
        Of the tissue at small strain.
    attached_share, visible_share
        Shares of the surface's area.
    attached_point, visible_point
        m, organ frame; the patches grow from the surface points nearest to them.
    frames, rate_hz, points_per_frame, noise
        Of the sensor; `noise` is the standard deviation of each coordinate, m.
    states
        Equilibria that are computed, evenly spread in time; frames lie between them.
    markers
        Number of internal markers.
    marker_motion
        Smallest and largest displacement (m) of a marker at the peak.
    """

    seed: int = 1
    surface_spacing: float = 0.0052
    vessel_spacing: float = 0.0022
    element_size: float = 0.012
    portal_ends: int = 26
    hepatic_ends: int = 22
    youngs_modulus_pa: float = 3000.0
    poisson_ratio: float = 0.45
    attached_share: float = 0.20
    visible_share: float = 0.20
    attached_point: tuple[float, float, float] = (-0.02, 0.06, 0.045)
    visible_point: tuple[float, float, float] = (-0.04, -0.06, -0.015)
    push: Push = field(default_factory=Push)
    frames: int = 100
    rate_hz: float = 10.0
    points_per_frame: int = 1200
    noise: float = 0.001
    states: int = 26
    markers: int = 6
    marker_motion: tuple[float, float] = (0.020, 0.050)

    def __post_init__(self) -> None:
        for name in ("frames", "points_per_frame", "markers"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"expected {name} of at least 1, got {getattr(self, name)}")
        if self.states < 2:
            raise InvalidInputError(f"expected at least 2 states to interpolate between, got {self.states}")

    @property
    def first_frame(self) -> float:
        """Time (s) of the first frame; the registration precedes it."""
        return 0.2

    @property
    def duration(self) -> float:
        """Time (s) of the last frame."""
        return self.first_frame + (self.frames - 1) / self.rate_hz
