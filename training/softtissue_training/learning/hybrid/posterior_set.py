"""The posteriors that a training run uses, split into those to learn from and those held out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.learning.hybrid.config import HybridConfig
from softtissue_training.learning.hybrid.posterior_record import PosteriorCase, parse_posteriors
from softtissue_training.simulation.archive import digest, list_records, read_records, record_number


@dataclass(frozen=True, eq=False)
class ViewOf:
    """One view of a case.

    Attributes
    ----------
    case
        The case it belongs to.
    view
        Its number.
    """

    case: PosteriorCase
    view: int

    @property
    def share(self) -> float:
        """Visible share of the surface."""
        return float(self.case.share[self.view])


class PosteriorSet:
    """Views for training and held-out views; what is held out depends on an organ's number alone.

    Parameters
    ----------
    folders
        Written by `posterior`, all with the same grid and the same elastic estimator.
    show_progress
        Whether to show a bar.

    Raises
    ------
    InvalidInputError
        There is nothing to train on or to validate with, or the posteriors do not fit the configuration or each other.
    """

    def __init__(self, folders: Sequence[Path], config: HybridConfig, *, show_progress: bool = True) -> None:
        self.training: list[ViewOf] = []
        self.held_out: list[ViewOf] = []
        self.settings: dict[str, Any] = {}
        self.failures: Counter[str] = Counter()
        self.records = 0
        self._hashes: dict[str, str] = {}
        self._config = config
        for number, folder in enumerate(folders):
            names = list_records(folder)
            contents = zip(names, read_records(folder, names), strict=True)
            quiet = not (names and show_progress)
            for name, content in tqdm(
                contents, "reading", len(names), unit="organ", leave=False, disable=quiet
            ):
                self._add(f"{number}/{name}", content, f"{folder}: {name}")
        if not self.training or not (self.held_out or config.validation_every == 0):
            raise InvalidInputError(
                f"{', '.join(map(str, folders))}: expected posteriors of at least {config.validation_every + 1} "
                f"organs, got {self.records}"
            )
        # Evenly over all, so that a limit keeps organs and kinds of views mixed.
        step = max(1.0, len(self.held_out) / max(1, config.validation_views))
        self.held_out = [
            self.held_out[int(step * i)] for i in range(min(len(self.held_out), config.validation_views))
        ]

    def digest(self) -> str:
        """Return a hash of the simulations behind all posteriors in use, and of how these were made."""
        return digest({**self._hashes, "settings": repr(sorted(self.settings.items()))})

    def _add(self, name: str, content: bytes, source: str) -> None:
        record = parse_posteriors(content, source)
        self._check(record.settings, source)
        self.records += 1
        self._hashes[name] = record.simulation
        self.failures.update(record.failures)
        every = self._config.validation_every
        held_out = every != 0 and record_number(name.partition("/")[2]) % every == 0
        views = [ViewOf(case, view) for case in record.cases for view in range(len(case.counts))]
        (self.held_out if held_out else self.training).extend(views)

    def _check(self, settings: dict[str, Any], source: str) -> None:
        spec = self._config.spec
        wanted = {
            "spacing": spec.spacing,
            "margin_cells": spec.margin_cells,
            "multiple": spec.architecture.multiple,
        }
        found = {name: settings["grid"][name] for name in wanted}
        if found != wanted:
            raise InvalidInputError(
                f"{source}: expected posteriors on the grid of configuration {self._config.name} ({wanted}), "
                f"got {found}; make them with --config {self._config.name}"
            )
        self.settings = self.settings or settings
        for name in ("version", "grid", "elastic", "code"):
            if settings[name] != self.settings[name]:
                raise InvalidInputError(
                    f"{source}: expected posteriors of one elastic estimator, got another {name} than in the others: "
                    f"{settings[name]}, not {self.settings[name]}"
                )
