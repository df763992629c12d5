"""Prepare an organ for an estimator, here or in another process that leaves this one free for other work.

Reading, checking, finding tables and factorising hold Python's lock for up to a second at a time, in which a stream
would stand still; on two cores they also take what an answer needs.
"""

import dataclasses
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import OrganError, SoftTissueError
from softtissue_estimator.estimators.estimator import create_estimator, estimator_names
from softtissue_estimator.estimators.handover import read_objects, write_objects
from softtissue_estimator.inference.device import choose_device
from softtissue_estimator.organ.organ import Organ, load_organ
from softtissue_estimator.support.leftovers import child_environment, run_contained, temporary_folder
from softtissue_estimator.support.log_lines import log_lines
from softtissue_estimator.support.sentences import one_sentence

_WORKER = Path(__file__).with_name("preparation_worker.py")
_TIMEOUT_S = 1200.0  # three attempts at tetrahedra have 300 s each

Say = Callable[[str], None]


class WorkerError(Exception):
    """What nobody expected was raised in the other process; its text holds the traceback."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """An organ and what an estimator computes of it once.

    Attributes
    ----------
    organ : Organ
    computed : object
        For `Estimator.take_over`.
    """

    organ: Organ
    computed: Any


@dataclass(frozen=True)
class Request:
    """What to prepare: an organ folder, the folders outside of which nothing is read, and for whom."""

    folder: Path
    roots: tuple[Path, ...]
    config: EstimatorConfig


def prepare(request: Request, say: Say) -> Prepared:
    """Read an organ and compute what its estimator needs, in this process.

    An estimator that this process does not know, because it was registered elsewhere, computes it when it takes the
    organ over.

    Raises
    ------
    SoftTissueError
        If organ or estimator cannot be used.
    """
    try:
        with log_lines(say):
            organ = load_organ(request.folder, request.roots)
        if request.config.estimator not in estimator_names():
            return Prepared(organ, None)
        return Prepared(organ, create_estimator(request.config).precompute(organ, say))
    except MemoryError as error:
        raise too_large(request.folder) from error


def prepare_elsewhere(request: Request, say: Say) -> Prepared:
    """Do the same in another process, which ends with this one.

    Raises
    ------
    SoftTissueError
        If organ or estimator cannot be used.
    WorkerError
        If the other process raised what nobody expected.
    """
    device = choose_device(request.config.device)
    with temporary_folder() as folder:
        source, target = folder / "request", folder / "prepared"
        # A second process on a GPU would take seconds to begin, and memory.
        config = dataclasses.replace(request.config, device="cpu", precision="auto")
        write_objects(source, dataclasses.replace(request, config=config))
        environment = child_environment(one_thread=True, folder=folder)
        try:
            done = run_contained(
                [str(_WORKER), str(source), str(target)], folder, environment, _TIMEOUT_S, say
            )
        except subprocess.TimeoutExpired as error:
            raise OrganError(
                f"organ {request.folder}: expected one that is prepared within {_TIMEOUT_S:.0f} s, got none"
            ) from error
        if done.returncode > 0:
            raise WorkerError(done.stderr)
        if done.returncode < 0:  # killed: out of memory, or a library that a damaged file crashed
            raise OrganError(
                f"organ {request.folder}: expected one that can be prepared, got signal {-done.returncode} meanwhile"
            )
        result = read_objects(target, device)
    if isinstance(result, SoftTissueError):
        raise result
    if not isinstance(result, Prepared):
        raise WorkerError(f"expected a prepared organ, got {type(result).__name__}")
    return result


def serve(source: Path, target: Path, say: Say) -> None:
    """Be the other process: prepare what one file asks for, and write what became of it into another."""
    request: Request = read_objects(source, choose_device("cpu"))
    result: Prepared | SoftTissueError
    try:
        result = prepare(request, lambda text: say(one_sentence(text)))
    except SoftTissueError as error:
        result = type(error)(str(error))
    write_objects(target, result)


def too_large(folder: Path) -> OrganError:
    """Return the error for an organ that does not fit into memory."""
    return OrganError(f"organ {folder}: expected one that fits into memory, got one too large")
