"""Run the phantom experiment: every estimator on every way to observe a case, errors at its markers, the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.estimators.estimator import silent
from softtissue_training.evaluation.case import EvaluationCase
from softtissue_training.evaluation.methods import Method, MethodSpec, Reading
from softtissue_training.experiments.phantom.case import PhantomCase
from softtissue_training.experiments.phantom.variants import OWN_ANSWER, Progress, Variant, variants_of

FloatArray = NDArray[np.float64]

REPEATS = 3
"""Answers of an estimator, of whose times the median counts; one where an answer takes longer than `LONG_S`."""
LONG_S = 0.5


@dataclass(frozen=True, eq=False)
class Answer:
    """An estimator's answer to one variant; `failure` says in a sentence why there is none.

    Attributes
    ----------
    label
        Of the estimator.
    reading
        At the markers, then at `Organ.query_points`.
    failure
        None if it answered.
    """

    label: str
    reading: Reading | None
    failure: str | None = None


@dataclass(frozen=True, eq=False)
class PhantomRun:
    """All answers to a case.

    Attributes
    ----------
    case
    asked
        (q, 3) m: the markers before, then `Organ.query_points`.
    variants
        The first is the one whose figures count.
    answers
        Of each variant, one an estimator, in the order asked for.
    """

    case: PhantomCase
    asked: FloatArray
    variants: list[Variant]
    answers: list[list[Answer]]


def run_phantom(case: PhantomCase, specs: Sequence[MethodSpec], progress: Progress = silent) -> PhantomRun:
    """Let every estimator answer every variant of a case.

    Raises
    ------
    SoftTissueError
        A variant cannot be made, or there is no such estimator. An estimator that fails to answer is no error.
    """
    methods = [spec.make() for spec in specs]
    asked = np.concatenate([case.markers.before, case.organ.query_points])
    variants = variants_of(case, asked, progress)
    answers: list[list[Answer]] = [[] for _ in variants]
    for spec, method in zip(specs, methods, strict=True):
        progress(f"estimator {spec.label}")
        try:
            method.load(case.organ)
        except SoftTissueError as error:
            failed = Answer(spec.label, None, " ".join(str(error).split()))
            for of_variant in answers:
                of_variant.append(failed)
            continue
        for variant, of_variant in zip(variants, answers, strict=True):
            of_variant.append(_answer(method, spec.label, _question(case, asked, variant)))
    for variant, of_variant in zip(variants, answers, strict=True):
        if variant.own is not None:
            of_variant.append(Answer(OWN_ANSWER, variant.own))
    return PhantomRun(case, asked, variants, answers)


def _question(case: PhantomCase, asked: FloatArray, variant: Variant) -> EvaluationCase:
    unknown = np.zeros(len(asked))
    return EvaluationCase(
        name=f"{case.name}, {variant.title}",
        organ=case.organ,
        observation=variant.observation,
        points=asked,
        truth=np.zeros_like(asked),  # no estimator may look at it
        visible=np.zeros(len(asked), dtype=np.bool_),
        depth=unknown,
        visible_share=variant.visible_share,
    )


def _answer(method: Method, label: str, question: EvaluationCase) -> Answer:
    try:
        readings = [method.answer(question)]
        while len(readings) < REPEATS and readings[-1].seconds < LONG_S:
            readings.append(method.answer(question))
    except (SoftTissueError, np.linalg.LinAlgError) as error:
        return Answer(label, None, " ".join(str(error).split()))
    reading = replace(readings[-1], seconds=float(np.median([reading.seconds for reading in readings])))
    if not np.isfinite(reading.displacement).all():
        return Answer(label, None, "expected finite displacements, got others")
    return Answer(label, reading)


def marker_errors_mm(run: PhantomRun, answer: Answer) -> FloatArray | None:
    """Distance of every estimated marker to where it truly is, (k,) mm; None if the estimator failed."""
    if answer.reading is None:
        return None
    markers = run.case.markers
    estimated = markers.before + answer.reading.displacement[: len(markers)]
    return np.asarray(1e3 * np.linalg.norm(estimated - markers.after, axis=1))


def moved_mm(run: PhantomRun) -> FloatArray:
    """How far every marker moved, (k,) mm: the error without an estimate."""
    return np.asarray(1e3 * np.linalg.norm(run.case.markers.displacement, axis=1))


def everywhere_mm(run: PhantomRun, answer: Answer) -> dict[str, float] | None:
    """Return mean, 95 % and largest error (mm) at all vertices of structures and surface; None if not known."""
    truth, reading = run.case.truth, answer.reading
    if truth is None or reading is None:
        return None
    known = run.asked[len(run.case.markers) :]
    estimated = known + reading.displacement[len(run.case.markers) :]
    error = 1e3 * np.linalg.norm(estimated - truth.positions, axis=1)
    return {
        "mean": float(error.mean()),
        "p95": float(np.percentile(error, 95)),
        "max": float(error.max()),
    }


def content_of(run: PhantomRun, command: str) -> dict[str, Any]:
    """Return everything as `report.json` holds it; `estimators` are those of the first variant."""
    variants = {
        variant.key: {
            "title": variant.title,
            "points": len(variant.observation.reference),
            "visible_share": variant.visible_share,
            "time_s": variant.seconds,
            **({"details": variant.details} if variant.details else {}),
            "estimators": {answer.label: _entry(run, answer) for answer in answers},
        }
        for variant, answers in zip(run.variants, run.answers, strict=True)
    }
    first = run.variants[0].key
    return {
        "experiment": "phantom",
        "case": run.case.name,
        "command": command,
        "organ": run.case.organ.name,
        "sigma_mm": 1e3 * run.case.sigma_m,
        "variant": first,
        "estimators": variants[first]["estimators"],
        "variants": variants,
    }


def _entry(run: PhantomRun, answer: Answer) -> dict[str, Any]:
    before, after = moved_mm(run), marker_errors_mm(run, answer)
    if after is None or answer.reading is None:
        return {"failed": answer.failure}
    sigma = answer.reading.sigma
    markers: dict[str, dict[str, float]] = {}
    for i, label in enumerate(run.case.markers.labels):
        markers[label] = {"before_mm": float(before[i]), "after_mm": float(after[i])}
        if sigma is not None:
            markers[label]["sigma_mm"] = float(1e3 * sigma[i])
    entry: dict[str, Any] = {
        "tre_mm": {"before": _summary(before), "after": _summary(after)},
        "markers": markers,
        "time_s": answer.reading.seconds,
    }
    everywhere = everywhere_mm(run, answer)
    return entry if everywhere is None else entry | {"everywhere_mm": everywhere}


def _summary(errors: FloatArray) -> dict[str, float]:
    return {"mean": float(errors.mean()), "max": float(errors.max())}


def rows_of(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return `report.csv`: one row for each variant, estimator and marker."""
    rows: list[dict[str, Any]] = []
    for key, variant in content["variants"].items():
        for label, entry in variant["estimators"].items():
            if "failed" in entry:
                rows.append({"variant": key, "estimator": label, "failed": entry["failed"]})
                continue
            for marker, errors in entry["markers"].items():
                time_s = {"time_s": entry["time_s"]}
                rows.append({"variant": key, "estimator": label, "marker": marker, **errors, **time_s})
    return rows
