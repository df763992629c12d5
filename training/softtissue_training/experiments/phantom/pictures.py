"""Pictures of a phantom experiment."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.view.picture import draw_phantom
from softtissue_estimator.view.scene import Markers, Scene
from softtissue_training.experiments.phantom.experiment import (
    Answer,
    PhantomRun,
    everywhere_mm,
    marker_errors_mm,
    moved_mm,
)
from softtissue_training.experiments.phantom.variants import Variant

_DPI = 120


def draw_markers(run: PhantomRun, variant: Variant, answers: list[Answer]) -> Figure:
    """Draw the error of every marker for every estimator; bars show one predicted standard deviation.

    The error of a marker is a length, so that its bar is the standard deviation of one component times the root of
    three.
    """
    labels = run.case.markers.labels
    shown = [answer for answer in answers if answer.reading is not None]
    figure = Figure(figsize=(max(7.0, 1.2 * len(labels) + 3.0), 4.2), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    place = np.arange(len(labels))
    width = 0.8 / max(len(shown), 1)
    for i, answer in enumerate(shown):
        errors = marker_errors_mm(run, answer)
        if errors is None or answer.reading is None:
            continue
        sigma = answer.reading.sigma
        bars = None if sigma is None else np.sqrt(3.0) * 1e3 * sigma[: len(labels)]
        at = place + (i - 0.5 * (len(shown) - 1)) * width
        axes.bar(at, errors, 0.92 * width, yerr=bars, label=answer.label, error_kw={"linewidth": 0.9})
    axes.scatter(place, moved_mm(run), marker="_", s=900, color="0.3", label="moved by")
    axes.set_xticks(place, labels)
    axes.set_xlabel("marker")
    axes.set_ylabel("target registration error, mm")
    axes.set_title(variant.title)
    axes.set_ylim(bottom=0.0)
    axes.grid(axis="y", alpha=0.3)
    figure.legend(loc="outside right upper")
    return figure


def draw_summary(run: PhantomRun) -> Figure:
    """Draw the mean error of every estimator for every variant; the line reaches to the largest."""
    labels = list(dict.fromkeys(answer.label for answers in run.answers for answer in answers))
    figure = Figure(figsize=(9.0, 0.55 * len(run.variants) * 2.2 + 1.6), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    height = 0.8 / max(len(labels), 1)
    for i, label in enumerate(labels):
        rows, means, largest = [], [], []
        for row, answers in enumerate(run.answers):
            for answer in answers:
                errors = marker_errors_mm(run, answer)
                if answer.label == label and errors is not None:
                    rows.append(row + (i - 0.5 * (len(labels) - 1)) * height)
                    means.append(errors.mean())
                    largest.append(errors.max() - errors.mean())
        spread = np.array([np.zeros(len(means)), largest])
        axes.barh(rows, means, 0.92 * height, xerr=spread, label=label, error_kw={"linewidth": 0.8})
    axes.set_yticks(range(len(run.variants)), [variant.title for variant in run.variants])
    axes.invert_yaxis()
    axes.set_xlabel("target registration error, mm: mean (bar) and largest (line)")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside right upper")
    return figure


def draw_organ(run: PhantomRun, variant: Variant, answer: Answer) -> bytes:
    """Draw the organ before, with what was observed, and as an estimator says it is; returns a PNG file's bytes.

    Raises
    ------
    InvalidInputError
        The estimator has not answered.
    """
    case, count = run.case, len(run.case.markers)
    if answer.reading is None:
        raise InvalidInputError(f"picture: expected an answer of {answer.label}, got none ({answer.failure})")
    estimated = run.asked + answer.reading.displacement
    markers = Markers(case.markers.before, estimated[:count], case.markers.after)
    observation = variant.observation
    scene = Scene(
        organ=case.organ,
        reference=observation.reference,
        observed=observation.reference + observation.displacement,
        estimated=estimated[count:],
        true=None if case.truth is None else case.truth.positions,
        markers=markers,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "organ.png"
        title = f"{case.organ.name}, {variant.title}, {answer.label}"
        draw_phantom(path, scene, title=title, caption=_caption(run, answer))
        return path.read_bytes()


def _caption(run: PhantomRun, answer: Answer) -> str:
    before, after = moved_mm(run), marker_errors_mm(run, answer)
    if after is None:
        return ""
    text = (
        f"TRE of {len(after)} markers: before {before.mean():.1f} mm (max {before.max():.1f}), after "
        f"{after.mean():.1f} mm (max {after.max():.1f})"
    )
    everywhere = everywhere_mm(run, answer)
    return text if everywhere is None else f"{text}; everywhere {everywhere['mean']:.1f} mm"
