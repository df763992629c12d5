"""How much of the organ's surface is visible."""

import numpy as np

from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.organ import Organ


def visible_fraction(organ: Organ, observation: Observation) -> float:
    """Share of the surface area with a tracked point on it.

    The surface is divided into patches of about 5 mm; a patch counts as visible if at least one point lies on
    it. So the share is meaningful for clouds with a point every few millimetres; a handful of hand-set
    points show only the patches they lie on.

    Parameters
    ----------
    organ : Organ
    observation : Observation
        Points away from the surface show nothing.

    Returns
    -------
    float
        0 to 1.
    """
    lookup = organ.surface_lookup
    sample = observation.nearest_sample(lookup)
    visible = np.zeros(len(lookup.patch_areas), dtype=np.bool_)
    visible[lookup.patch.take(sample[sample >= 0])] = True
    return float(lookup.patch_areas[visible].sum() / lookup.patch_areas.sum())
