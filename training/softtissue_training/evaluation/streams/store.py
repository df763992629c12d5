"""Answers to streams on disk: a file for each stream, condition and estimator, so that an interrupted run goes on."""

from __future__ import annotations

import hashlib
from pathlib import Path

from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.store import read_arrays, write_arrays
from softtissue_training.evaluation.streams.answers import is_paced
from softtissue_training.evaluation.streams.frames import StreamAnswers

STREAMS_VERSION = 1
"""Of how streams, conditions and answers are made; whatever changes, other files are looked for."""
_PACE_VERSION = 2
_FIELDS = ("index", "answered", "error", "sigma", "seconds", "processor_s", "degraded")


def method_key(spec: MethodSpec, paced: bool | None, stride: int) -> str:
    """Return a hash of all that an estimator's answers to a stream depend on."""
    waits = paced or (paced is None and is_paced(spec))
    content = f"{STREAMS_VERSION}\0{spec.key()}\0{_PACE_VERSION if waits else paced}\0{stride}"
    return hashlib.sha256(content.encode()).hexdigest()[:16]


class StreamStore:
    """Answers by stream, condition and estimator.

    Parameters
    ----------
    folder
        Where the files are; made if needed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def has(self, stream: str, instance: str, method: str) -> bool:
        """Whether answers are stored."""
        return self._path(stream, instance, method).is_file()

    def write(self, stream: str, instance: str, method: str, answers: StreamAnswers) -> None:
        """Store answers."""
        arrays = {name: getattr(answers, name) for name in _FIELDS}
        write_arrays(self._path(stream, instance, method), arrays, [answers.failures, answers.event])

    def read(self, stream: str, instance: str, method: str) -> StreamAnswers | None:
        """Return stored answers, or None if there are none or they are damaged."""
        stored = read_arrays(self._path(stream, instance, method))
        if stored is None:
            return None
        arrays, about = stored
        failures, event = about
        return StreamAnswers(**{name: arrays[name] for name in _FIELDS}, failures=failures, event=event)

    def _path(self, stream: str, instance: str, method: str) -> Path:
        return self._folder / f"{stream}-{instance}-{method}.npz"
