"""An organ and an estimator that is ready for it."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.estimator import Estimator, create_estimator
from softtissue_estimator.estimators.preparation import Request, prepare_elsewhere, too_large
from softtissue_estimator.organ.organ import Organ, load_organ
from softtissue_estimator.organ.organ_file import FILE_NAME, read_organ_file
from softtissue_estimator.registration.elastic_modes import elastic_modes
from softtissue_estimator.ros.frames import FrameAnswerer, unmoved
from softtissue_estimator.ros.outputs.answer_buffer import AnswerBuffer
from softtissue_estimator.ros.outputs.markers import MarkerBuffer
from softtissue_estimator.ros.outputs.status import Setup
from softtissue_estimator.support.files import real
from softtissue_estimator.support.log_lines import log_lines
from softtissue_estimator.support.resources import bundled_organ


@dataclass(frozen=True)
class Engine:
    """An organ and an estimator that is ready for it."""

    organ: Organ
    estimator: Estimator
    points: AnswerBuffer
    markers: MarkerBuffer

    @cached_property
    def answerer(self) -> FrameAnswerer:
        """What makes answers of frames; one thread at a time may ask it."""
        return FrameAnswerer(self.organ, self.estimator)

    @cached_property
    def surface(self) -> AnswerBuffer:
        """The organ's surface as a message; made when somebody listens."""
        return AnswerBuffer(self.organ, surface=True)

    @cached_property
    def elastic(self) -> NDArray[np.float32] | None:
        """How the organ bends, for the search of its pose (`elastic_modes`); computed in the first one."""
        return elastic_modes(self.estimator, self.organ.surface)

    @property
    def setup(self) -> Setup:
        """Names for the status."""
        return Setup(self.estimator.name, self.estimator.device, self.organ.name, self.organ.frame)


def organ_roots(config: EstimatorConfig) -> tuple[Path, ...]:
    """Return the folders outside of which no organ is read; the empty one of `organ_root` stands for the usual two."""
    roots: list[Path] = []
    for given in config.organ_root:
        if given:
            roots.append(Path(given))
            continue
        for folder in (Path(config.organ) if config.organ else bundled_organ(), bundled_organ()):
            # Also where links lead: an installation may consist of them.
            roots.append(real(folder).parent)
            roots.append(real(folder / FILE_NAME).parent.parent)
    return tuple(dict.fromkeys(roots))


def load_engine(
    folder: str,
    config: EstimatorConfig,
    say: Callable[[str], None],
    roots: tuple[Path, ...],
    elsewhere: bool = False,
) -> Engine:
    """Load an organ and prepare an estimator for it: seconds the first time.

    Parameters
    ----------
    folder : str
        Organ folder; empty for the bundled one.
    config : EstimatorConfig
    say : callable
        Told in a sentence what is going on.
    roots : tuple of Path
        Folders outside of which nothing is read (`organ_roots`).
    elsewhere : bool
        Whether another process does most of it, so that an engine at work goes on answering.

    Raises
    ------
    SoftTissueError
        If organ or estimator cannot be used.
    WorkerError
        If the other process raised what nobody expected.
    """
    path = Path(folder) if folder else bundled_organ()
    request = Request(path, roots, config)
    read_organ_file(path, request.roots)  # what is wrong with the folder itself is said at once
    say(f"loading organ {path}")
    began = time.monotonic()
    try:
        organ, estimator = (_ready_elsewhere if elsewhere else _ready_here)(request, say)
        points, markers = AnswerBuffer(organ), MarkerBuffer(organ)
    except MemoryError as error:
        raise too_large(path) from error
    say(
        f"organ {organ.name!r} with {len(organ.structures)} structures is ready after"
        f" {time.monotonic() - began:.1f} s: estimator {estimator.name!r} on {estimator.device}"
    )
    return Engine(organ, estimator, points, markers)


def _ready_here(request: Request, say: Callable[[str], None]) -> tuple[Organ, Estimator]:
    with log_lines(say):
        organ = load_organ(request.folder, request.roots)
    estimator = create_estimator(request.config)
    estimator.load_organ(organ, say)
    # Libraries set themselves up in the first estimate, which would make the first cloud late.
    estimator.estimate(unmoved(organ, request.config))
    return organ, estimator


def _ready_elsewhere(request: Request, say: Callable[[str], None]) -> tuple[Organ, Estimator]:
    prepared = prepare_elsewhere(request, say)
    estimator = create_estimator(request.config)
    if prepared.computed is None:
        estimator.load_organ(prepared.organ, say)
    else:
        estimator.take_over(prepared.organ, prepared.computed, say)
    return prepared.organ, estimator
