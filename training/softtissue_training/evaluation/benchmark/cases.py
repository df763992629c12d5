"""The cases of the benchmark: one record observed in several ways."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from softtissue_estimator.organ.organ import Organ
from softtissue_training.evaluation.benchmark.plan import DataSet
from softtissue_training.evaluation.case import EvaluationCase
from softtissue_training.evaluation.observe import ObservationSettings, simulated_case, told_organ
from softtissue_training.simulation.archive import digest, read_records, record_name
from softtissue_training.simulation.record_format import content_hash, parse_record

_CASES_VERSION = 1  # of how cases are made
_OBSERVATION_SEED = 0


@dataclass(frozen=True)
class ObservedOrgan:
    """All cases of one record; see `runner.Job`.

    Attributes
    ----------
    data, name
        Folder of the data set, and the record in it.
    conditions, settings
        Of each case, in order: one after the other for each simulation. Where simulations differ in their material
        alone, they have one each.
    key
        Hash of all of this and of the record's content.
    """

    data: Path
    name: str
    conditions: tuple[str, ...]
    settings: tuple[ObservationSettings, ...]
    key: str

    def cases(self) -> list[EvaluationCase]:
        """See `runner.Job.cases`; all cases of a record observe the same patch of it."""
        content = next(read_records(self.data, [self.name]))
        record = parse_record(content, f"{self.data}: {self.name}")
        views = len(self.settings) // len(record.simulations)
        organs: dict[tuple[bytes, float], Organ] = {}
        cases: list[EvaluationCase] = []
        for index, (condition, settings) in enumerate(zip(self.conditions, self.settings, strict=True)):
            sample = record.simulations[index // views]
            name = case_name(self.data.name, Path(self.name).stem, condition)
            told = (sample.attached.tobytes(), settings.attached_share)
            if told not in organs:
                organs[told] = told_organ(sample, settings, name)
            # One seed for all views and materials of an organ.
            rng = np.random.default_rng([_OBSERVATION_SEED, *record.seed])
            cases.append(simulated_case(sample, settings, rng, name, organs[told]))
        return cases


def case_name(data_set: str, organ: str, condition: str) -> str:
    """Return what a case is called in tables.

    Examples
    --------
    >>> case_name("random", "organ_000007", "noise_1mm")
    'random/organ_000007/noise_1mm'
    """
    return f"{data_set}/{organ}/{condition}"


def organ_of(name: str) -> str:
    """Return the data set and organ of a case's name, which cases of one organ share.

    Examples
    --------
    >>> organ_of("random/organ_000007/noise_1mm")
    'random/organ_000007'
    """
    return name.rpartition("/")[0]


def observed_organs(data: DataSet, folder: Path) -> tuple[list[ObservedOrgan], str]:
    """List the jobs of a data set whose simulations are complete.

    Parameters
    ----------
    folder
        Of the data set.

    Returns
    -------
    list
        One job an organ.
    str
        Hash of the simulations.
    """
    names = [record_name(number) for number in range(data.organs)]
    jobs: list[ObservedOrgan] = []
    hashes: dict[str, str] = {}
    for number, (name, content) in enumerate(zip(names, read_records(folder, names), strict=True)):
        hashes[name] = content_hash(content, f"{folder}: {name}")
        used = [view for view in data.views if number < view.organs]
        conditions = tuple(label for label, _ in data.materials) or tuple(view.condition for view in used)
        settings = tuple(view.settings for view in used) * max(1, len(data.materials))
        jobs.append(
            ObservedOrgan(folder, name, conditions, settings, _key(hashes[name], conditions, settings))
        )
    return jobs, digest(hashes)


def _key(content: str, conditions: tuple[str, ...], settings: tuple[ObservationSettings, ...]) -> str:
    described = json.dumps(
        ["benchmark", _CASES_VERSION, content, conditions, [asdict(one) for one in settings]], sort_keys=True
    )
    return hashlib.sha256(described.encode()).hexdigest()[:24]
