"""What the benchmark simulates, and how each simulation is looked at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.evaluation.clouds.plan import ORGANS, QUICK_ORGANS, QUICK_VIEWS, VIEWS, CloudPlan
from softtissue_training.evaluation.measured import Truth
from softtissue_training.evaluation.metrics import CONDITIONS, Condition
from softtissue_training.evaluation.observe import ObservationSettings
from softtissue_training.evaluation.streams.plan import RecordingPlan, StreamPlan
from softtissue_training.physics.material import Material
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.reserved_seeds import FIRST_RESERVED_SEED

SUITES = ("random", "own", "user", "real", "bag", "clouds")
RANDOM_SEED, OWN_SEED, USER_SEED, REAL_SEED, BAG_SEED, CLOUDS_SEED = (
    FIRST_RESERVED_SEED + index for index in range(6)
)
"""One seed each for the suites; the sweeps are of the random suite's organs. That of `bag` draws errors alone."""
VISIBLE_BINS = ((8, 15), (15, 25), (25, 40), (40, 60))
"""Percent of the surface; with the lower end, without the upper one, except that the last holds all above."""
SWEEP_BASE = "noise_0mm"
"""The first organs of the random suite without anything changed: what most sweeps are compared with."""

NU_UNKNOWN = "nu_unknown"
"""All simulations with another Poisson's ratio than the paper's."""

COUNTS = {"random": 300, "own": 200, "user": 1334, "real": 20, "clouds": ORGANS}
"""Samples of each suite, of `real` organs that move, of `clouds` organs of several views; 1334 are the paper's."""
SWEEP_COUNT = 60
QUICK_COUNTS = {"random": 60, "own": 20, "user": 20, "real": 4, "clouds": QUICK_ORGANS}
QUICK_SWEEP_COUNT = 10

_PLAIN_OBSERVATION = ObservationSettings()
_RANDOM_RECIPE = Recipe(shapes="mixed")
_NOISE_MM = (1, 2, 3)
_SPARSE_POINTS = 13
_ASSUMED_POISSON_RATIO = 0.35
_POISSON_RATIOS = (0.30, _ASSUMED_POISSON_RATIO, 0.40, 0.45, 0.49)
_WEAK_FORCE_N = (0.0, 0.5)
_WEAK_FORCES, _OTHER_LAW, _SEVERAL_LOADS = "neo_hookean_weak", "st_venant_kirchhoff", "three_loads_gravity"
_THREE_LOADS_RECIPE = replace(_RANDOM_RECIPE, forces=(3, 3), gravity=(0.0, 0.15))


@dataclass(frozen=True)
class View:
    """How the first `organs` organs of a data set are looked at, and the condition's name."""

    condition: str
    organs: int
    settings: ObservationSettings = _PLAIN_OBSERVATION


@dataclass(frozen=True)
class NamedSurface:
    """A surface file and the length of its unit in metres."""

    path: Path
    unit_m: float


@dataclass(frozen=True)
class DataSet:
    """Simulations and what is asked of them.

    Attributes
    ----------
    name
        Of its folder.
    seed, recipe, organs
        As in `generate`.
    views
        Ways to look at each simulation; the first covers all organs. With materials there is one.
    materials
        Names of conditions and the materials that they stand for; each load is simulated with all of them. Without,
        the recipe draws one, and conditions are called as the views are.
    surface
        The organ, if it is one surface.
    """

    name: str
    seed: int
    recipe: Recipe
    organs: int
    views: tuple[View, ...]
    materials: tuple[tuple[str, Material], ...] = ()
    surface: NamedSurface | None = None


@dataclass(frozen=True)
class Plan:
    """The whole benchmark.

    Attributes
    ----------
    suites
        Those that figures are drawn of and that pairs of estimators are compared on; not `real`, `bag` and `clouds`.
    data_sets
        Everything that is simulated for them.
    streams
        The suite `real`, if it is asked for.
    recording
        The suite `bag`, if it is asked for.
    clouds
        The suite `clouds`, if it is asked for.
    """

    suites: tuple[str, ...]
    data_sets: tuple[DataSet, ...]
    streams: StreamPlan | None = None
    recording: RecordingPlan | None = None
    clouds: CloudPlan | None = None


def condition_of(suite: str) -> str:
    """Return the name of the condition that holds a whole suite: `all`, `own_all`, `user_all`."""
    return "all" if suite == "random" else f"{suite}_all"


def subsets(suite: str) -> Mapping[str, Condition]:
    """Return the conditions that are a choice of a suite's samples, by name."""
    prefix = condition_of(suite).removesuffix("all")
    chosen = {f"{prefix}{name}": holds for name, holds in CONDITIONS.items()}
    for low, high in VISIBLE_BINS:
        upper = 101 if (low, high) == VISIBLE_BINS[-1] else high
        chosen[f"{prefix}visible_{low:02d}_{high:02d}"] = partial(_sees, low=0.01 * low, high=0.01 * upper)
    return chosen


def _sees(truth: Truth, low: float, high: float) -> bool:
    return truth.visible_share is not None and low <= truth.visible_share < high


def base_of(condition: str) -> str | None:
    """Return the condition with the same organs, and nothing changed, that a condition of a sweep is compared with.

    Examples
    --------
    >>> base_of("noise_2mm"), base_of("nu_0.45"), base_of("hidden_load")
    ('noise_0mm', 'nu_0.35', None)
    """
    if condition in (_nu(_ASSUMED_POISSON_RATIO), SWEEP_BASE, _WEAK_FORCES):
        return None
    if condition.startswith("nu_"):
        return _nu(_ASSUMED_POISSON_RATIO)
    if condition == _OTHER_LAW:
        return _WEAK_FORCES
    swept = ("noise_", "sparse_", "outliers_", "attached_", _SEVERAL_LOADS)
    return SWEEP_BASE if condition.startswith(swept) else None


def make_plan(
    suites: Sequence[str],
    surfaces: Mapping[str, NamedSurface],
    *,
    quick: bool = False,
    count: int | None = None,
    sweep_count: int | None = None,
    recording: RecordingPlan | None = None,
) -> Plan:
    """Return the plan of the suites.

    Parameters
    ----------
    suites
        Some of `SUITES`; sweeps come with `random`.
    surfaces
        The surfaces of `own` and `user`.
    quick
        Take few samples: `QUICK_COUNTS`.
    count
        Samples of every suite, instead of `COUNTS`.
    sweep_count
        Organs of every sweep; at most those of the random suite.
    recording
        The suite `bag`.

    Raises
    ------
    InvalidInputError
        There is no such suite, or its surface is not named.
    """
    if not suites or not set(suites) <= set(SUITES) or len(set(suites)) < len(suites):
        raise InvalidInputError(
            f"suites: expected some of {', '.join(SUITES)}, got {', '.join(suites) or 'none'}"
        )
    data_sets: list[DataSet] = []
    streams: StreamPlan | None = None
    clouds: CloudPlan | None = None
    for suite in suites:
        if suite == "bag":
            continue
        samples = count or (QUICK_COUNTS if quick else COUNTS)[suite]
        if suite == "real":
            streams = StreamPlan(REAL_SEED, samples)
            continue
        if suite == "clouds":
            clouds = CloudPlan(CLOUDS_SEED, samples, QUICK_VIEWS if quick else VIEWS)
            continue
        if suite == "random":
            sweeps = min(sweep_count or (QUICK_SWEEP_COUNT if quick else SWEEP_COUNT), samples)
            data_sets += _random_suite(samples, sweeps)
            continue
        if suite not in surfaces:
            raise InvalidInputError(f"suite {suite}: expected a surface (--organ-surface FILE), got none")
        seed = OWN_SEED if suite == "own" else USER_SEED
        view = View(condition_of(suite), samples)
        data_sets.append(DataSet(suite, seed, Recipe(), samples, (view,), surface=surfaces[suite]))
    simulated = tuple(suite for suite in suites if suite not in ("real", "bag", "clouds"))
    return Plan(simulated, tuple(data_sets), streams, recording if "bag" in suites else None, clouds)


def _random_suite(samples: int, sweeps: int) -> list[DataSet]:
    views = [View("all", samples)]
    views += [View(f"noise_{mm}mm", sweeps, ObservationSettings(noise_m=1e-3 * mm)) for mm in _NOISE_MM]
    views += [
        View(f"sparse_{_SPARSE_POINTS}", sweeps, ObservationSettings(sparse=_SPARSE_POINTS)),
        View("outliers_10", sweeps, ObservationSettings(outliers=0.10)),
        View("attached_30_less", sweeps, ObservationSettings(attached_share=0.7)),
        View("attached_30_more", sweeps, ObservationSettings(attached_share=1.3)),
    ]
    ratios = tuple((_nu(ratio), Material(poisson_ratio=ratio)) for ratio in _POISSON_RATIOS)
    laws = ((_WEAK_FORCES, Material("neo_hookean")), (_OTHER_LAW, Material("st_venant_kirchhoff")))
    weak = replace(_RANDOM_RECIPE, force_n=_WEAK_FORCE_N)
    return [
        DataSet("random", RANDOM_SEED, _RANDOM_RECIPE, samples, tuple(views)),
        DataSet("nu", RANDOM_SEED, _RANDOM_RECIPE, sweeps, (View("nu", sweeps),), ratios),
        DataSet("law", RANDOM_SEED, weak, sweeps, (View("law", sweeps),), laws),
        DataSet(
            _SEVERAL_LOADS,
            RANDOM_SEED,
            _THREE_LOADS_RECIPE,
            sweeps,
            (View(_SEVERAL_LOADS, sweeps),),
        ),
    ]


def _nu(ratio: float) -> str:
    return f"nu_{ratio:.2f}"
