"""Correspondences as arrays, checked by the rules that the message's definition states."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from softtissue_msgs.msg import Correspondences

from softtissue_estimator.errors import InvalidInputError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Pairs:
    """Correspondences as arrays.

    Attributes
    ----------
    index : (n,) int64
        Rows of the cloud.
    reference : (n, 3) float64
        Preoperative positions, m, organ frame.
    sigma : (n,) float64 or None
        Standard deviation of each component of the displacement, m.
    """

    index: NDArray[np.int64]
    reference: FloatArray
    sigma: FloatArray | None


def read_correspondences(message: Correspondences, rows: int) -> Pairs:
    """Read and check correspondences that belong to a cloud of `rows` rows.

    Raises
    ------
    InvalidInputError
        If the message breaks one of the rules that its definition lists.
    """
    reference = np.asarray(message.reference, dtype=np.float64)
    if reference.size == 0 or reference.size % 3:
        raise InvalidInputError(
            f"correspondences: expected reference to hold 3 numbers an entry, got {reference.size} numbers"
        )
    reference = reference.reshape(-1, 3)
    entries = len(reference)
    if not np.isfinite(reference).all():
        bad = int((~np.isfinite(reference).all(axis=1)).sum())
        raise InvalidInputError(
            f"correspondences: expected finite references, got {bad} of {entries} not finite"
        )
    if entries > rows:
        raise InvalidInputError(
            f"correspondences: expected at most as many entries as the cloud has points ({rows}), got {entries}"
        )
    return Pairs(_read_index(message, entries, rows), reference, _read_sigma(message, entries))


def _read_index(message: Correspondences, entries: int, rows: int) -> NDArray[np.int64]:
    index = np.asarray(message.index, dtype=np.int64)
    if index.size == 0:
        return np.arange(entries)
    if index.size != entries:
        raise InvalidInputError(
            f"correspondences: expected index to have {entries} entries or none, got {index.size}"
        )
    if index.max() >= rows:
        raise InvalidInputError(
            f"correspondences: expected index below the cloud's {rows} rows, got {int(index.max())}"
        )
    if np.bincount(index, minlength=rows).max() > 1:
        raise InvalidInputError(
            "correspondences: expected each row of the cloud at most once in index, got repeats"
        )
    return index


def _read_sigma(message: Correspondences, entries: int) -> FloatArray | None:
    sigma = np.asarray(message.sigma, dtype=np.float64)
    if sigma.size == 0:
        return None
    if sigma.size != entries:
        raise InvalidInputError(
            f"correspondences: expected sigma to have {entries} entries or none, got {sigma.size}"
        )
    if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        bad = int((~(np.isfinite(sigma) & (sigma > 0.0))).sum())
        raise InvalidInputError(
            f"correspondences: expected positive finite sigma (m), got {bad} of {entries} that are not"
        )
    return sigma
