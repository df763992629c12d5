"""What `make bench` measures, in full and in five minutes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class NodeRun:
    """A node with one estimator and structures of so many vertices, and the grid that it is measured with."""

    estimator: str
    vertices: int
    points: tuple[int, ...]
    rates: tuple[float, ...]


@dataclass(frozen=True)
class RealtimePlan:
    """What is measured.

    Attributes
    ----------
    estimators, points, rates
        The grid of the whole path: names for `create_estimator`, tracked points of a cloud, clouds a second.
    seconds
        Of each combination.
    vertices
        Vertices of the structures: an organ for each number. The first one takes part in everything.
    device
        'cpu' or 'cuda'.
    frames
        Of each combination of the stages alone.
    stage_points
        Tracked points of these.
    element_sizes_m
        Of the finite elements.
    fem_repeats, network_repeats
        How often each is timed; no networks with 0.
    soak_s
        How long the stream is at 60 Hz that is looked at for growth, s; 0 for none.
    quick
        Whether all but the first organ are measured with one estimator in one combination only, and estimators only in
        a stream.
    seed
        Of points and noise.
    overlays
        Images that an overlay draws on beside the first node of the first organ, as `latency --overlay` takes them; a
        viewer runs too.
    """

    estimators: tuple[str, ...]
    points: tuple[int, ...]
    rates: tuple[float, ...]
    seconds: float
    vertices: tuple[int, ...]
    device: str
    frames: int
    stage_points: tuple[int, ...]
    element_sizes_m: tuple[float, ...]
    fem_repeats: int
    network_repeats: int
    soak_s: float
    quick: bool
    seed: int = 0
    overlays: tuple[str, ...] = ()

    @property
    def middle_points(self) -> int:
        """Tracked points of what is measured with one number of them only."""
        return self.points[len(self.points) // 2]

    @property
    def runs(self) -> tuple[NodeRun, ...]:
        """The nodes that are started, one after the other."""
        first, *others = self.vertices
        runs = [NodeRun(name, first, self.points, self.rates) for name in self.estimators]
        for vertices in others:
            if self.quick:
                middle = (self.rates[len(self.rates) // 2],)
                runs.append(NodeRun(self.estimators[0], vertices, (self.middle_points,), middle))
            else:
                runs += [NodeRun(name, vertices, self.points, self.rates) for name in self.estimators]
        return tuple(runs)


ESTIMATORS = ("elastic", "paper")
POINTS = (1_000, 10_000, 40_000)
RATES_HZ = (10.0, 30.0, 60.0)
# A GPU is to keep up with this.
GPU_RATES_HZ = (*RATES_HZ, 100.0)
VERTICES = (5_000, 50_000)
OVERLAYS = ("640x480@25", "1920x1080@10")
# As in the in-silico benchmark; between; near the organ's own triangles.
ELEMENT_SIZES_M = (0.010, 0.007, 0.005)


def make_plan(quick: bool, device: str, estimators: tuple[str, ...] = ESTIMATORS) -> RealtimePlan:
    """Return the plan of `make bench`, or that of `make bench QUICK=1`."""
    rates = GPU_RATES_HZ if device == "cuda" else RATES_HZ
    common: dict[str, Any] = {
        "estimators": estimators,
        "points": POINTS,
        "rates": rates,
        "vertices": VERTICES,
        "device": device,
        "overlays": OVERLAYS,
    }
    if quick:
        return RealtimePlan(
            **common,
            seconds=1.5,
            frames=15,
            stage_points=POINTS[1:2],
            element_sizes_m=ELEMENT_SIZES_M[:2],
            fem_repeats=1,
            network_repeats=3,
            soak_s=0.0,
            quick=True,
        )
    return RealtimePlan(
        **common,
        seconds=10.0,
        frames=100,
        stage_points=POINTS,
        element_sizes_m=ELEMENT_SIZES_M,
        fem_repeats=3,
        network_repeats=20,
        soak_s=120.0,
        quick=False,
    )
