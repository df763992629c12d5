"""Answers on disk, so that an interrupted evaluation goes on where it stopped.

One file holds an estimator's answers to the cases of one job. Its name says what they depend on: the job's key (the
data and how it is observed) and the estimator's (kind, weights, code). Whatever changes, other files are looked for.
"""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_training.evaluation.measured import Answer, Truth

Arrays = dict[str, NDArray[Any]]


class Store:
    """Truths and answers by job and estimator.

    Parameters
    ----------
    folder
        Where the files are; made if needed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def has_truths(self, job: str) -> bool:
        """Whether the truths of a job are stored."""
        return self._path(job, "truth").is_file()

    def has_answers(self, job: str, method: str) -> bool:
        """Whether an estimator's answers to a job are stored."""
        return self._path(job, method).is_file()

    def write_truths(self, job: str, truths: list[Truth]) -> None:
        """Store the truths of a job's cases."""
        arrays: Arrays = {}
        about = []
        for index, truth in enumerate(truths):
            for field in ("target", "depth", "visible"):
                arrays[f"{field}_{index}"] = getattr(truth, field)
            about.append([truth.name, truth.visible_share, truth.load_seen_share])
        write_arrays(self._path(job, "truth"), arrays, about)

    def read_truths(self, job: str) -> list[Truth] | None:
        """Return a job's truths, or None if they are not stored or damaged."""
        stored = read_arrays(self._path(job, "truth"))
        if stored is None:
            return None
        arrays, about = stored
        return [
            Truth(*values, *(arrays[f"{field}_{index}"] for field in ("target", "depth", "visible")))
            for index, values in enumerate(about)
        ]

    def write_answers(self, job: str, method: str, answers: list[Answer]) -> None:
        """Store an estimator's answers to a job's cases."""
        arrays: Arrays = {}
        about = []
        for index, answer in enumerate(answers):
            arrays[f"error_{index}"] = answer.error
            if answer.sigma is not None:
                arrays[f"sigma_{index}"] = answer.sigma
            about.append([answer.failure, answer.setup_s, answer.estimate_s])
        write_arrays(self._path(job, method), arrays, about)

    def read_answers(self, job: str, method: str) -> list[Answer] | None:
        """Return an estimator's answers to a job, or None if they are not stored or damaged."""
        stored = read_arrays(self._path(job, method))
        if stored is None:
            return None
        arrays, about = stored
        return [
            Answer(failure, arrays[f"error_{index}"], arrays.get(f"sigma_{index}"), setup_s, estimate_s)
            for index, (failure, setup_s, estimate_s) in enumerate(about)
        ]

    def _path(self, job: str, what: str) -> Path:
        return self._folder / f"{job}.{what}.npz"


def write_arrays(path: Path, arrays: Arrays, about: Any) -> None:
    """Write arrays and JSON values into a file that appears under its name only when it is complete."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        about=np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
        allow_pickle=False,
        **arrays,
    )
    partial = path.with_suffix(f".partial{os.getpid()}")
    partial.write_bytes(buffer.getvalue())
    partial.replace(path)


def read_arrays(path: Path) -> tuple[Arrays, Any] | None:
    """Read what `write_arrays` wrote; None if it is not there or damaged."""
    try:
        # Opened here, because NumPy leaves a damaged file open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
            return arrays, json.loads(arrays.pop("about").tobytes())
    except Exception:  # a damaged file may raise anything, and is then made anew
        return None
