"""Arrays in a file that holds nothing but numbers and text."""

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray


def save_arrays(target: Path | IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as `numpy.load(..., allow_pickle=False)` reads them.

    Raises
    ------
    ValueError
        If an array holds Python objects. Before version 2, `numpy.savez` would pickle them, and cannot be told not to.
    """
    objects = [name for name, array in arrays.items() if np.asarray(array).dtype.hasobject]
    if objects:
        raise ValueError(f"expected arrays of numbers or text, got Python objects in {', '.join(objects)}")
    named: dict[str, Any] = dict(arrays)
    np.savez(target, **named)
