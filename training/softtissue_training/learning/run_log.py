"""The curves of a run: CSV files that an interruption cannot confuse, and TensorBoard."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError


class CsvLog:
    """Rows whose first column is a step that rises; rows beyond the step from which a run goes on are removed.

    Parameters
    ----------
    path
        File to append to; made if needed.
    columns
        Names; the first is the step.
    step
        Where the run stands: rows of later steps were written by a part of it that is lost.
    """

    def __init__(self, path: Path, columns: Sequence[str], step: int) -> None:
        kept = _rows_until(path, columns, step)
        partial = path.with_name(path.name + ".partial")
        with partial.open("w", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerows([columns, *kept])
        partial.replace(path)
        # Line by line, so that a run can be watched.
        self._stream = path.open("a", newline="", buffering=1)
        self._writer = csv.writer(self._stream, lineterminator="\n")

    def write(self, row: Sequence[Any]) -> None:
        """Append a row."""
        self._writer.writerow(row)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def _rows_until(path: Path, columns: Sequence[str], step: int) -> list[list[str]]:
    if not path.exists():
        return []
    kept: list[list[str]] = []
    with path.open(newline="") as stream:
        for row in list(csv.reader(stream))[1:]:
            # A row that was being written when the run was killed has too few columns, or is of a later step.
            if len(row) != len(columns) or int(row[0]) > step:
                break
            kept.append(row)
    return kept


class TensorBoardLog:
    """The same curves for TensorBoard.

    Raises
    ------
    InvalidInputError
        TensorBoard is not installed.
    """

    def __init__(self, folder: Path, step: int) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise InvalidInputError(
                'logs for TensorBoard need the package tensorboard: pip install "softtissue-training[tensorboard]"'
            ) from error
        self._writer = SummaryWriter(str(folder), purge_step=step + 1)

    def write(self, step: int, values: dict[str, float]) -> None:
        """Append values by name; values that are not finite are left out."""
        for name, value in values.items():
            if math.isfinite(value):
                self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Write what is pending and close."""
        self._writer.close()
