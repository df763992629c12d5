"""How much of the organ's surface is visible."""

import numpy as np

from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.seen_surface import CELL_M
from softtissue_estimator.organ.mesh import FloatArray, IntArray
from softtissue_estimator.organ.organ import Organ

_AROUND = 0.5 * CELL_M * np.vstack([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


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
    return _share(organ, observation.nearest_sample(organ.surface_lookup))


def seen_fraction(organ: Organ, places: FloatArray) -> float:
    """Share of the surface area that was seen, where the points of each small cell have been averaged.

    Parameters
    ----------
    organ : Organ
    places : (c, 3) m
        On the preoperative surface, each for the piece of surface in a cell of `seen_surface.CELL_M`.

    Returns
    -------
    float
        0 to 1.
    """
    # Each stands for what lies around it, too: cells and patches do not coincide.
    around = (places[:, None, :] + _AROUND).reshape(-1, 3)
    return _share(organ, organ.surface_lookup.nearest_sample(around))


def _share(organ: Organ, sample: IntArray) -> float:
    lookup = organ.surface_lookup
    visible = np.zeros(len(lookup.patch_areas), dtype=np.bool_)
    visible[lookup.patch.take(sample[sample >= 0])] = True
    return float(lookup.patch_areas[visible].sum() / lookup.patch_areas.sum())
