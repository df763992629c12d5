"""The in-silico experiment: simulated organs, each observed through a random patch (paper, experiment 1)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.evaluation.case import EvaluationCase
from softtissue_training.evaluation.measured import CaseResult
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.observe import ObservationSettings, simulated_case
from softtissue_training.evaluation.report import summarise, table, write_csv, write_json
from softtissue_training.evaluation.runner import evaluate
from softtissue_training.simulation.archive import digest, list_records, read_records
from softtissue_training.simulation.record_format import content_hash, parse_record

_CASES_VERSION = 2  # of how cases are made
ANSWERS, ROWS, SUMMARY, FIGURES = "answers", "samples.csv", "evaluation.json", "figures"


@dataclass(frozen=True)
class SimulatedOrgan:
    """All load cases of one record.

    Attributes
    ----------
    data, name
        Folder or packed file, and the record in it.
    settings
        How it is observed.
    seed
        Seed of the evaluation; the observation depends on it and on the record's own seed, not on other records.
    key
        Hash of all of this and of the record's content.
    """

    data: Path
    name: str
    settings: ObservationSettings
    seed: int
    key: str

    def cases(self) -> list[EvaluationCase]:
        """See `runner.Job.cases`."""
        content = next(read_records(self.data, [self.name]))
        record = parse_record(content, f"{self.data}: {self.name}")
        stem = Path(self.name).stem
        samples = record.simulations
        return [
            simulated_case(
                sample,
                self.settings,
                np.random.default_rng([self.seed, *record.seed, number]),
                stem if len(samples) == 1 else f"{stem}.{number}",
            )
            for number, sample in enumerate(samples)
        ]


def simulated_organs(
    data: Path, settings: ObservationSettings, seed: int, count: int | None = None, skip: int = 0
) -> tuple[list[SimulatedOrgan], str]:
    """List the records to evaluate on.

    Parameters
    ----------
    count
        At most so many, in the order of their numbers; None for all.
    skip
        Leave out so many first ones.

    Returns
    -------
    list
        One job a record.
    str
        Hash of the chosen records' names and content.

    Raises
    ------
    InvalidInputError
        There are no such records, or one is damaged.
    """
    names = list_records(data)
    chosen = list(islice(names, skip, None if count is None else skip + count))
    if not chosen:
        raise InvalidInputError(
            f"{data}: expected simulations after the first {skip}, got {len(names)} in all"
            if names
            else f"{data}: expected simulations, got none"
        )
    if count is not None and len(chosen) < count:
        raise InvalidInputError(f"{data}: expected {skip + count} simulations, got {len(names)}")
    hashes = {
        name: content_hash(content, f"{data}: {name}")
        for name, content in zip(chosen, read_records(data, chosen), strict=True)
    }
    jobs = [
        SimulatedOrgan(data, name, settings, seed, _key(content, settings, seed))
        for name, content in hashes.items()
    ]
    return jobs, digest(hashes)


def _key(content: str, settings: ObservationSettings, seed: int) -> str:
    described = json.dumps([_CASES_VERSION, content, asdict(settings), seed], sort_keys=True)
    return hashlib.sha256(described.encode()).hexdigest()[:24]


def evaluate_in_silico(
    data: Path,
    methods: Sequence[MethodSpec],
    out: Path,
    settings: ObservationSettings,
    *,
    seed: int = 0,
    count: int | None = None,
    skip: int = 0,
    workers: int = 1,
    command: str = "",
    show_progress: bool = True,
) -> str:
    """Evaluate estimators on simulations and write CSV, JSON and figures; returns a table to print.

    Finished answers are kept in `out` and used again.

    Raises
    ------
    SoftTissueError
        The data or an estimator cannot be used.
    """
    jobs, checksum = simulated_organs(data, settings, seed, count, skip)
    results = evaluate(jobs, methods, out / ANSWERS, workers=workers, show_progress=show_progress)
    about: dict[str, Any] = {
        "experiment": "insilico",
        "command": command,
        "data": {"path": data.name, "digest": checksum, "records": len(jobs), "skipped": skip},
        "seed": seed,
        "observation": asdict(settings),
        "checkpoints": {spec.label: spec.provenance() for spec in methods if spec.checkpoint is not None},
    }
    return write_reports(out, results, about)


def write_reports(out: Path, results: Sequence[CaseResult], about: dict[str, Any]) -> str:
    """Write CSV, JSON and figures of an evaluation; returns a table to print."""
    # matplotlib is slow to import.
    from softtissue_training.evaluation.figures import write_figures

    summary = about | summarise(results)
    write_csv(out / ROWS, results)
    write_json(out / SUMMARY, summary)
    write_figures(out / FIGURES, results)
    return table(summary)
