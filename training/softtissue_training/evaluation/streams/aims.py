"""What estimators are to reach on the bundled recording, and what of it they miss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

MOST_SIGMA_OVER_ERROR = 1.5
"""Mean sigma over root mean square error / sqrt(3), so that a large sigma is no way out."""
LEAST_ANSWERED = 0.98
MOST_MS, MOST_MS_P95 = 20.0, 40.0
"""Median and 95 % quantile of the time of an estimate."""
MOST_DEGRADED_IF_EXACT, LEAST_DEGRADED_IF_WRONG, WRONG_OVER_EXACT = 0.01, 0.90, 3.0
"""Share of DEGRADED frames where nothing is wrong, and where the mean error is so many times that of `exact`."""


@dataclass(frozen=True)
class Aim:
    """Largest errors, mm, None where there is no target, and the range of rms z, of a condition."""

    mean_mm: float
    p95_mm: float
    max_mm: float | None
    rms_z: tuple[float, float]


AIMS: Mapping[str, Aim] = {
    "exact": Aim(1.6, 4.5, 6.0, (0.7, 1.4)),
    "registration_2": Aim(2.0, 5.0, 7.0, (0.0, 1.5)),
    "registration_5": Aim(3.0, 6.0, 9.0, (0.0, 1.5)),
    "outliers_5": Aim(1.7, 5.0, 7.0, (0.7, 1.5)),
    "outliers_20": Aim(1.8, 5.0, 8.0, (0.0, 1.5)),
    "outliers_40": Aim(2.2, 6.0, 9.0, (0.0, 1.5)),
    "patch_20": Aim(2.5, 6.0, 10.0, (0.0, 1.6)),
    "drift_6": Aim(3.0, 6.0, 9.0, (0.0, 1.6)),
    "stray_4": Aim(2.0, 5.0, 8.0, (0.0, 1.5)),
    "bare": Aim(2.2, 6.0, None, (0.0, 1.5)),
    "bare_registration_5": Aim(3.5, 8.0, None, (0.0, 1.5)),
}


def missed(condition: str, row: Mapping[str, Any]) -> list[str]:
    """Name the aims that the figures of a condition (`measure`, `over_exact`) miss, as tables print them.

    Where an estimator gives no sigma or never says whether it is degraded, that aim is not missed but not there.
    """
    aim, errors, calibration, time = AIMS[condition], row["errors"], row["calibration"], row["time_ms"]
    held = {"answered": row["answered"] >= LEAST_ANSWERED}
    if errors is not None:
        # Compared as they are printed.
        limits = {name: getattr(aim, f"{name}_mm") for name in ("mean", "p95", "max")}
        held |= {
            name: round(errors[f"{name}_mm"], 1) <= limit
            for name, limit in limits.items()
            if limit is not None
        }
    if calibration is not None:
        low, high = aim.rms_z
        held["z"] = low <= round(calibration["rms_z"], 2) <= high
        held["sigma"] = round(calibration["sigma_over_rms_error"], 2) <= MOST_SIGMA_OVER_ERROR
    # A bare cloud says less than pairs, also where all is well.
    if row["degraded"] is not None and not condition.startswith("bare"):
        held["DEGRADED"] = _says_what_is_so(condition, row)
    if time is not None:
        held["ms"] = round(time["median"]) <= MOST_MS and round(time["p95"]) <= MOST_MS_P95
    return [name for name, reached in held.items() if not reached]


def _says_what_is_so(condition: str, row: Mapping[str, Any]) -> bool:
    if condition == "exact":
        return bool(row["degraded"] <= MOST_DEGRADED_IF_EXACT)
    wrong = row["over_exact"] is not None and row["over_exact"] > WRONG_OVER_EXACT
    return not wrong or bool(row["degraded"] >= LEAST_DEGRADED_IF_WRONG)
