"""What was seen of a surface as equations about the organ, each along one direction d.

    d . (correction(y) - x) = d . u(x) + d . J e + error,

y where something was seen, x the point of the preoperative surface that it is taken for, e the registration's error.
Matches with the nearest surface say something along its normal; a point that is followed says it along the surface too.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from softtissue_estimator.estimators.elastic.closest_points import ClosestPoints, MaterialPoints
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.observation.patch_average import ObservedPatches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.observation.seen_surface import SeenSurface
from softtissue_estimator.organ.mesh import BoolArray, FloatArray, IntArray, unit_rows

NOISE_DEVIATIONS = 3.0  # beyond the reach, that something may be from the organ


@dataclass(frozen=True, eq=False)
class SurfaceRows:
    """Equations about an organ.

    Parameters
    ----------
    direction : (c, 3)
        d.
    seen : (c, 3) m
        y, as the registration has it.
    reference : (c, 3) m
        x.
    position : (c, 3) m
        Where the organ that the matches were made with has x.
    nodes : (c, 4) int64
        Of the tetrahedron around x.
    weights : (c, 4)
        Barycentric, of these.
    precision : (c,) 1/m^2
        Inverse variance of the error by noise alone.
    counted : (c,) bool
        Whether it is near enough to be about the organ.
    """

    direction: FloatArray
    seen: FloatArray
    reference: FloatArray
    position: FloatArray
    nodes: IntArray
    weights: FloatArray
    precision: FloatArray
    counted: BoolArray

    def and_(self, others: SurfaceRows) -> SurfaceRows:
        """Return all of them, and then others."""
        pairs = ((getattr(self, one.name), getattr(others, one.name)) for one in fields(self))
        return SurfaceRows(*(np.concatenate(pair) for pair in pairs))

    def told(self, registration: RegistrationError) -> FloatArray:
        """Return d . (correction(y) - x), (c,) m."""
        offset = registration.corrected(self.seen) - self.reference
        return np.asarray(np.einsum("cd,cd->c", self.direction, offset))

    def errors(self, registration: RegistrationError) -> FloatArray:
        """Return d . J times the root of the registration's error, (c, 6)."""
        return registration.along(self.position, self.direction)

    @cached_property
    def _entries(self) -> FloatArray:
        """Part of each component of the four nodes in d . u(x), (c, 12)."""
        return np.asarray(self.weights[:, :, None] * self.direction[:, None, :]).reshape(-1, 12)

    @cached_property
    def _columns(self) -> NDArray[np.int32]:
        """Which of all components these are, (c, 12)."""
        columns = 3 * self.nodes[:, :, None] + np.arange(3)
        return np.asarray(columns.reshape(-1, 12), dtype=np.int32)

    def moved(self, nodal: Tensor) -> FloatArray:
        """Return d . u(x), (c,) m, for nodal displacement (n, 3) m."""
        at_nodes = nodal.cpu().numpy().reshape(-1).take(self._columns)
        return np.asarray(np.einsum("ck,ck->c", self._entries, at_nodes))

    def response(self, tangent: Tangent, used: IntArray, scale: FloatArray) -> NDArray[np.float32]:
        """Return d . C of the equations `used`, (k, 3 p), each times its own scale, (k,)."""
        # Each is about one tetrahedron: a row has an entry for each component of four nodes.
        entries = (self._entries[used] * scale[:, None]).astype(np.float32).reshape(-1)
        begins = np.arange(0, 12 * len(used) + 1, 12, dtype=np.int32)
        shape = len(used), len(tangent.response)
        rows = csr_array((entries, self._columns[used].reshape(-1), begins), shape=shape)
        return np.asarray(rows @ tangent.response.cpu().numpy())


def normal_rows(
    seen: SeenSurface, pairs: ClosestPoints, corrected: FloatArray, reach_m: float
) -> SurfaceRows:
    """Make an equation along the organ's normal of each piece of surface that was seen, (c,).

    Those count that show the same side of a surface within a distance of the organ, as most of their neighbours do:
    where a wall touches the organ, it is still a wall. `corrected` is where they are estimated to be, (c, 3) m.
    """
    offset = corrected - pairs.position
    near = np.abs(np.einsum("cd,cd->c", pairs.normal, offset)) <= _reach(reach_m, seen.precision)
    on_organ = pairs.facing & near
    return SurfaceRows(
        pairs.normal,
        seen.position,
        pairs.reference,
        pairs.position,
        pairs.nodes,
        pairs.weights,
        seen.precision,
        on_organ & seen.among(on_organ),
    )


def tangent_rows(
    tracks: ObservedPatches,
    places: MaterialPoints,
    normal: FloatArray,
    displacement: FloatArray,
    correction: RigidMotion,
    reach_m: float,
) -> SurfaceRows:
    """Make two equations along the surface of each small patch of points that are followed, (2 t,).

    Parameters
    ----------
    tracks : ObservedPatches
        t of them.
    places : MaterialPoints
        Where they are on the organ.
    normal : (t, 3)
        Of the surface as it has moved.
    displacement : (n, 3) m
        Of the nodes.
    correction : RigidMotion
        From where they are told to be to where they are estimated to be.
    """
    position = places.reference + np.einsum("tk,tkd->td", places.weights, displacement[places.nodes])
    seen = tracks.reference + tracks.displacement
    far = np.linalg.norm(correction.apply(seen) - position, axis=1)
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = unit_rows(np.cross(normal, least))
    both = (first, np.cross(normal, first))

    twice = np.tile(np.arange(len(seen)), 2)
    return SurfaceRows(
        np.concatenate(both),
        seen[twice],
        places.reference[twice],
        position[twice],
        places.nodes[twice],
        places.weights[twice],
        tracks.precision[twice],
        (far <= _reach(reach_m, tracks.precision))[twice],
    )


def _reach(reach_m: float, precision: FloatArray) -> FloatArray:
    return np.asarray(reach_m + NOISE_DEVIATIONS / np.sqrt(precision))
