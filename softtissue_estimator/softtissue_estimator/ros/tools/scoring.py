"""Arithmetic of the score: which frames were answered, how fast, and how far off the markers are. Knows no ROS."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# A frame says something about the target registration error only while the markers have moved.
DISPLACED_M = 0.005
_LATE_S = 1.0  # a first answer that is later is said in the table


@dataclass
class Record:
    """What was heard of a run, by the stamp of the cloud (nanoseconds).

    Attributes
    ----------
    sent_ns, answered_ns : dict
        When a cloud was published and when its answer was received, system clock, nanoseconds.
    truth : dict
        True positions of the markers, (k, 3) m, organ frame.
    estimate : dict
        Estimated positions of the markers, (k, 3) m, organ frame.
    sigma : dict
        Their standard deviations, (k,) m, where the estimator gives some.
    fitted, true_pose : dict
        Pose of the organ's frame in the cloud's, (4, 4) m: as the node fits it, and as it truly is, where that is told.
    reference : (k, 3) float64 or None
        Preoperative positions of the markers, m, organ frame.
    dropped, refused : int
        As the node counted them.
    stages : dict
        For every stage of the node's work, the seconds that it took, one entry an answered cloud.
    project, shows : callable or None
        Of the camera that has the cloud's frame: map points (k, 3) m to columns and rows (k, 2 or more), pixels, and
        tell which of them are on its image (k,).
    """

    sent_ns: dict[int, int] = field(default_factory=dict)
    answered_ns: dict[int, int] = field(default_factory=dict)
    truth: dict[int, FloatArray] = field(default_factory=dict)
    estimate: dict[int, FloatArray] = field(default_factory=dict)
    sigma: dict[int, FloatArray] = field(default_factory=dict)
    fitted: dict[int, FloatArray] = field(default_factory=dict)
    true_pose: dict[int, FloatArray] = field(default_factory=dict)
    reference: FloatArray | None = None
    dropped: int = 0
    refused: int = 0
    stages: dict[str, list[float]] = field(default_factory=dict)
    project: Callable[[FloatArray], FloatArray] | None = None
    shows: Callable[[FloatArray], NDArray[np.bool_]] | None = None

    @property
    def answered(self) -> int:
        """Number of clouds answered."""
        return len(self.sent_ns.keys() & self.answered_ns.keys())

    def scored(self) -> list[int]:
        """Stamps for which truth and estimate of the markers are there."""
        return sorted(self.truth.keys() & self.estimate.keys())

    def estimated(self, stamp: int) -> FloatArray:
        """Estimated positions of the markers, (k, 3) m, in the organ's true frame.

        Where the organ's true pose is told, they are those that a viewer draws in the cloud's frame: with a wrong pose
        the answer in the organ's frame is of no use.
        """
        estimate = self.estimate[stamp]
        if stamp not in self.fitted or stamp not in self.true_pose:
            return estimate
        motion = np.linalg.inv(self.true_pose[stamp]) @ self.fitted[stamp]
        moved: FloatArray = estimate @ motion[:3, :3].T + motion[:3, 3]
        return moved

    @property
    def unaccounted(self) -> int:
        """Number of clouds neither answered nor counted by the node."""
        return len(self.sent_ns) - self.answered - self.dropped - self.refused


def latency_ms(record: Record) -> dict[str, float]:
    """Return p50, p95 and max of the time from publishing a cloud to receiving its answer, ms."""
    both = record.sent_ns.keys() & record.answered_ns.keys()
    values = [1e-6 * (record.answered_ns[stamp] - record.sent_ns[stamp]) for stamp in both]
    if not values:
        return {}
    return {
        "p50": float(np.percentile(values, 50)),
        "p95": float(np.percentile(values, 95)),
        "max": float(np.max(values)),
    }


def first_answer_s(record: Record) -> float | None:
    """Return the time from publishing the first cloud to receiving the first answer, s; None without any."""
    both = record.sent_ns.keys() & record.answered_ns.keys()
    if not both:
        return None
    return 1e-9 * (min(record.answered_ns[stamp] for stamp in both) - min(record.sent_ns.values()))


def stages_ms(record: Record) -> dict[str, dict[str, float]]:
    """Return p50 and p95 of every stage of the node's work on a cloud, ms; stages within a stage have a slash."""
    return {
        name: {"p50": float(1e3 * np.percentile(values, 50)), "p95": float(1e3 * np.percentile(values, 95))}
        for name, values in record.stages.items()
    }


def target_registration_error_mm(record: Record) -> dict[str, Any]:
    """Return the target registration error before and after the estimate, mm.

    Before: a marker is taken to be where it was when the organ was scanned (after the rigid registration).
    `before` and `after` are means and maxima over markers and over the scored frames whose markers have moved
    `DISPLACED_M` on average; `peak` speaks of the scored frame in which they have moved most; `markers` has one
    entry a marker. Empty if no frame could be scored.
    """
    reference = record.reference
    stamps = record.scored()
    if reference is None or not stamps:
        return {}
    before = 1e3 * np.stack([np.linalg.norm(record.truth[s] - reference, axis=1) for s in stamps])
    after = 1e3 * np.stack([np.linalg.norm(record.truth[s] - record.estimated(s), axis=1) for s in stamps])
    moved = before.mean(axis=1) >= 1e3 * DISPLACED_M
    if not moved.any():
        return {"scored_frames": len(stamps), "displaced_frames": 0}
    peak = int(before.mean(axis=1).argmax())
    return {
        "scored_frames": len(stamps),
        "displaced_frames": int(moved.sum()),
        "before": _summary(before[moved]),
        "after": _summary(after[moved]),
        "peak": {"stamp_ns": stamps[peak], "before": _summary(before[peak]), "after": _summary(after[peak])},
        "markers": [
            {"before": _summary(before[moved, marker]), "after": _summary(after[moved, marker])}
            for marker in range(before.shape[1])
        ],
    }


def reprojection_error_px(record: Record) -> dict[str, Any]:
    """Return how far markers are from where they are truly seen on the camera's image, before and after, pixels.

    Means and maxima over the frames of `target_registration_error_mm` and the markers that are in the image there;
    `markers` has one entry a marker, with the number of its frames, or None for one that never is. Empty without a
    camera or the true pose in its frame.
    """
    reference, project, shows = record.reference, record.project, record.shows
    stamps = [stamp for stamp in record.scored() if stamp in record.fitted and stamp in record.true_pose]
    if reference is None or project is None or shows is None:
        return {}
    before, after, counted_in = [], [], []
    for stamp in stamps:
        if np.linalg.norm(record.truth[stamp] - reference, axis=1).mean() < DISPLACED_M:
            continue
        motion = record.true_pose[stamp]
        placed = [
            points @ motion[:3, :3].T + motion[:3, 3]
            for points in (record.truth[stamp], reference, record.estimated(stamp))
        ]
        seen, first, found = (project(points)[:, :2] for points in placed)
        before.append(np.linalg.norm(first - seen, axis=1))
        after.append(np.linalg.norm(found - seen, axis=1))
        counted_in.append(shows(placed[0]))
    both, counted = np.array([before, after]), np.array(counted_in)
    if not counted.any():
        return {}
    counted &= np.isfinite(both).all(axis=0)  # far beside the image a lens's distortion says nothing
    return {
        "before": _summary(both[0][counted]),
        "after": _summary(both[1][counted]),
        "markers": [
            {**_summary(errors[here]), "frames": int(here.sum())} if here.any() else None
            for errors, here in zip(both[1].T, counted.T, strict=True)
        ],
    }


def root_mean_square_z(record: Record) -> float | None:
    """Return the root mean square of |error| / (sqrt(3) sigma) over markers and scored frames: 1 is honest.

    None if no frame could be scored or the estimator gives no standard deviations.
    """
    squares = [
        np.square(record.truth[s] - record.estimated(s)).sum(axis=1) / (3.0 * np.square(record.sigma[s]))
        for s in record.scored()
        if s in record.sigma
    ]
    return float(np.sqrt(np.mean(squares))) if squares else None


def _summary(errors: FloatArray) -> dict[str, float]:
    return {"mean": float(errors.mean()), "max": float(errors.max())}


def make_report(record: Record) -> dict[str, Any]:
    """Return all figures of a run, ready for JSON."""
    return {
        "frames": {
            "sent": len(record.sent_ns),
            "answered": record.answered,
            "dropped": record.dropped,
            "refused": record.refused,
            "unaccounted": record.unaccounted,
        },
        "latency_ms": latency_ms(record),
        "first_answer_s": first_answer_s(record),
        "stages_ms": stages_ms(record),
        "tre_mm": target_registration_error_mm(record),
        "reprojection_px": reprojection_error_px(record),
        "rms_z": root_mean_square_z(record),
    }


def failures(report: dict[str, Any]) -> list[str]:
    """Say in sentences what is wrong with a run."""
    found = []
    frames, errors = report["frames"], report["tre_mm"]
    if frames["sent"] == 0:
        found.append("frames: expected some clouds, got none")
    if frames["unaccounted"] != 0:
        found.append(
            f"frames: expected {frames['sent']} answered, dropped or refused, got"
            f" {frames['answered']} + {frames['dropped']} + {frames['refused']}"
        )
    if "after" in errors and not errors["after"]["mean"] < errors["before"]["mean"]:
        found.append(
            f"target registration error: expected less than {errors['before']['mean']:.1f} mm,"
            f" got {errors['after']['mean']:.1f} mm"
        )
    return found


def table(report: dict[str, Any], title: str) -> str:
    """Return the figures of a run as text."""
    frames, latency, errors = report["frames"], report["latency_ms"], report["tre_mm"]
    lines = [
        title,
        f"  frames   sent {frames['sent']}   answered {frames['answered']}   dropped {frames['dropped']}"
        f"   refused {frames['refused']}   unaccounted for {frames['unaccounted']}",
    ]
    if latency:
        lines.append(
            f"  latency  p50 {latency['p50']:.1f} ms   p95 {latency['p95']:.1f} ms   max {latency['max']:.1f} ms"
            "   (cloud published to answer received)"
        )
    first_s = report["first_answer_s"]
    if first_s is not None and first_s > _LATE_S:
        lines.append(f"  first answer {first_s:.1f} s after the first cloud")
    lines += _stage_lines(report["stages_ms"])
    if "after" in errors:
        lines.append(
            f"  TRE (mm) over {errors['displaced_frames']} frames with displaced markers"
            f" ({errors['scored_frames']} scored)"
        )
        lines.append(f"  {'':12}{'before mean':>12}{'max':>8}{'after mean':>13}{'max':>8}")
        rows = [(f"marker {n + 1}", entry) for n, entry in enumerate(errors["markers"])]
        for name, entry in [*rows, ("all", errors), ("peak frame", errors["peak"])]:
            before, after = entry["before"], entry["after"]
            lines.append(
                f"  {name:12}{before['mean']:12.1f}{before['max']:8.1f}{after['mean']:13.1f}{after['max']:8.1f}"
            )
    if report["reprojection_px"]:
        before, after = (report["reprojection_px"][when] for when in ("before", "after"))
        lines.append(
            f"  markers on the image (pixels): before mean {before['mean']:.1f}  max {before['max']:.1f}"
            f"   after mean {after['mean']:.1f}  max {after['max']:.1f}"
        )
    if report["rms_z"] is not None:
        lines.append(f"  rms z    {report['rms_z']:.2f}   (error over sqrt(3) sigma; 1 is honest)")
    return "\n".join(lines)


def _stage_lines(stages: dict[str, dict[str, float]]) -> list[str]:
    if not stages:
        return []
    lines = [f"  {'stage (ms)':22}{'p50':>8}{'p95':>8}"]
    for name, entry in stages.items():
        label = f"  {name.rpartition('/')[2]}" if "/" in name else name
        lines.append(f"  {label:22}{entry['p50']:8.2f}{entry['p95']:8.2f}")
    return lines
