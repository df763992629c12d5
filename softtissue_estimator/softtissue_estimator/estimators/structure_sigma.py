"""How uncertain each structure of an organ is."""

import numpy as np

from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.organ import Organ


def largest_sigmas(organ: Organ, sigma: FloatArray | None) -> FloatArray:
    """Return the largest standard deviation of each structure, (s,) m.

    Parameters
    ----------
    organ : Organ
    sigma : (q,) m or None
        Of each component of the displacement of `Organ.query_points`, as an `Estimate` has it; None becomes NaN.
    """
    largest = np.full(len(organ.structures), np.nan)
    if sigma is not None:
        begin = 0
        for number, structure in enumerate(organ.structures):
            end = begin + len(structure.mesh.vertices)
            largest[number] = sigma[begin:end].max(initial=0.0)
            begin = end
    return largest


def uncertain_structures(organ: Organ, largest: FloatArray, maximum_m: float) -> str | None:
    """Say in a sentence which structures' largest standard deviations (s,) m exceed a limit, if any do."""
    over = np.flatnonzero(largest > maximum_m)
    if not len(over):
        return None
    worst = over[largest[over].argmax()]
    others = f" and more than that in {len(over) - 1} other(s)" if len(over) > 1 else ""
    return (
        f"standard deviation: expected at most {1e3 * maximum_m:.3g} mm in every structure,"
        f" got {1e3 * largest[worst]:.3g} mm in {organ.structures[worst].name!r}{others}"
    )
