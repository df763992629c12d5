"""What an organ needs computed once for the elastic posterior: tetrahedra, springs that hold it, possible loads."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.closest_points import MovedSurface
from softtissue_estimator.estimators.elastic.elasticity import nodal_volumes
from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody, RestingBody, to_tensor
from softtissue_estimator.estimators.elastic.loads import attachment_basis, load_basis
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError, expected_error
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.estimators.elastic.tissue import RatioPrior, ratio_prior
from softtissue_estimator.estimators.estimator import Progress
from softtissue_estimator.organ.mesh import FloatArray, IntArray, vertex_areas
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.organ.surface_lookup import SurfaceLookup
from softtissue_estimator.organ.volume_mesh import VolumeMesh, tetrahedralise
from softtissue_estimator.support.cache import Arrays, cached_arrays

_CACHE_VERSION = 3  # of the tetrahedra and what is located in them
# Stiffness of the springs to the surroundings over the organ's own: next to nothing where the organ is attached, and
# where nobody says where it is attached as much as attachments somewhere hold it on average.
_GROUND_SHARE_HELD, _GROUND_SHARE_FREE = 1e-5, 0.3

_ATTACHMENT_SHARE = 0.3
"""How far what holds the organ moves by a unit load over how far all unit loads that push move the organ."""

_LINEAR_M = 0.001  # that no node has moved by: so far an organ is linear


@dataclass(frozen=True, eq=False)
class ElasticModel:
    """An organ, prepared for the elastic estimator.

    Parameters
    ----------
    organ : Organ
    lookup : SurfaceLookup
    mesh : VolumeMesh
    body : HyperelasticBody
    resting : RestingBody
        With the expected Poisson's ratio.
    pushing : int
        How many of the loads push; those behind move what the organ is attached to.
    ratios : RatioPrior
        What Poisson's ratio may be.
    registration : RegistrationError
        What is supposed of it at worst, before any observation.
    sample_tet : (s,) int64
        Tetrahedron of every sample of the lookup.
    query : (q, n) sparse
        Interpolation from the nodes to `organ.query_points`.
    moved_surface : MovedSurface
    device : torch.device
        Where the body is.
    """

    organ: Organ
    lookup: SurfaceLookup
    mesh: VolumeMesh
    body: HyperelasticBody
    resting: RestingBody
    pushing: int
    ratios: RatioPrior
    registration: RegistrationError
    sample_tet: IntArray
    query: csr_array
    moved_surface: MovedSurface
    device: torch.device

    @cached_property
    def nodes(self) -> Tensor:
        """Nodes of the mesh, (n, 3) float64 m, on the device."""
        return to_tensor(self.mesh.nodes, self.device)

    @property
    def held(self) -> bool:
        """Whether something holds the organ."""
        return 3 * self.pushing < self.resting.response.shape[1]

    def following(self, tangent: Tangent, state: Tensor, rest: Tensor, ratio: int) -> Tangent:
        """Return the body linear about a state (n, 3) m near that of `tangent`; about the same where it is very near.

        `ratio` is the number of Poisson's ratio. See `HyperelasticBody.linearise_on`.
        """
        if float((state - tangent.state).abs().max()) <= _LINEAR_M:
            return tangent
        return self.body.linearise_on(tangent, state, rest, self.ratios.ratios[ratio])

    def surface_interpolation(self, points: FloatArray) -> csr_array:
        """Interpolate from the nodes to points (k, 3) m near the surface, (k, n); one table access a point."""
        return self.mesh.interpolation_in(points, self.sample_tet[self.lookup.nearest_sample(points)])

    def compliances(
        self, points: FloatArray, directions: FloatArray, poisson_ratio: float
    ) -> tuple[NDArray[np.float32], ...]:
        """Displacement of points near the surface by each load that pushes, at rest; see `Estimator.compliances`.

        Takes a fraction of a second, for another factorisation if the organ is held.
        """
        interpolation = self.surface_interpolation(points).astype(np.float32)
        along = directions.astype(np.float32)
        found = [_along(self.resting.response[:, : 3 * self.pushing], interpolation, along)]
        if self.held:
            springs = _springs(self.mesh, csr_array((0, len(self.mesh.nodes))), np.zeros(0))
            free = HyperelasticBody(self.mesh, springs, load_basis(self.mesh), self.device)
            found.append(_along(free.at_rest(poisson_ratio).response, interpolation, along))
        return tuple(found)


def build_model(
    organ: Organ, config: EstimatorConfig, device: torch.device, progress: Progress
) -> ElasticModel:
    """Prepare an organ: seconds the first time, afterwards the tetrahedra that it does not bring come from the cache.

    Another attached region of the same organ keeps the tetrahedra and takes a fraction of a second.

    Raises
    ------
    MeshError
        If the organ cannot be filled with tetrahedra.
    """
    if not organ.attached.any():
        progress("the organ is attached nowhere: it may be anywhere near, and bends freely")
    # By the surface and the query points alone: another attached region keeps the mesh.
    stored = cached_arrays(
        "tetrahedra",
        organ.geometry_digest,
        _CACHE_VERSION,
        {},
        lambda: _fill(organ, progress),
        lambda arrays: _fits(arrays, organ),
    )
    mesh = VolumeMesh(stored["nodes"], stored["tets"])
    attached = mesh.interpolation(organ.surface.vertices[organ.attached])
    areas = vertex_areas(organ.surface)[organ.attached]
    held = _springs(mesh, attached, areas / config.attachment_length_m)
    attached_areas = np.asarray(attached.T @ areas)
    loads = load_basis(mesh, attached_areas)
    body = HyperelasticBody(mesh, held, loads, device)
    resting = body.at_rest(config.poisson_ratio)
    moving = attachment_basis(mesh, held, attached_areas)
    if moving.shape[1]:
        further = _ATTACHMENT_SHARE * resting.usual_displacement * moving
        body, resting = body.with_more_loads(resting, further)
    ratios = ratio_prior(config.poisson_ratio, config.poisson_ratio_sigma)
    query = mesh.interpolation_in(organ.query_points, stored["query_tet"])
    return ElasticModel(
        organ,
        organ.surface_lookup,
        mesh,
        body,
        resting,
        loads.shape[1],
        ratios,
        expected_error(organ.centre, config.registration_sigma_m, config.registration_sigma_rad),
        stored["sample_tet"],
        query,
        MovedSurface(organ, mesh, stored["sample_tet"]),
        device,
    )


def _along(
    response: Tensor, interpolation: csr_array, directions: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Interpolate a response (3 n, p) to points, along directions (k, 3) there, (k, p)."""
    by_axis = response.reshape(interpolation.shape[1], 3, -1).cpu().numpy()
    moved = [(interpolation @ by_axis[:, axis]) * directions[:, axis, None] for axis in range(3)]
    return np.asarray(moved[0] + moved[1] + moved[2], dtype=np.float32)


def _springs(mesh: VolumeMesh, attached: csr_array, stiffness: FloatArray) -> FloatArray:
    """Stiffness of the springs that hold an organ, over Young's modulus, (n, n) 1/m.

    Attached surface is held by springs as stiff as the organ's own tissue of the given thickness, which resolves an
    attached region finer than the coarse mesh does and needs no node exactly on its edge. Weak springs between the
    organ and its surroundings keep rigid motions finite. Where nothing is attached they are all that holds; an organ
    then follows the rigid motion of the observed surface.

    Parameters
    ----------
    attached : (a, n) sparse
        Interpolation from the nodes to the attached vertices; a may be 0.
    stiffness : (a,) m
        Attached area over the thickness, of each of these.
    """
    held = (attached.T @ attached.multiply(stiffness[:, None])).toarray()
    ground = _GROUND_SHARE_HELD if len(stiffness) else _GROUND_SHARE_FREE
    # Per volume, Young's modulus over the square of the organ's size is the stiffness of the organ itself.
    held[np.diag_indices(len(held))] += nodal_volumes(mesh) * (ground / mesh.volumes.sum() ** (2.0 / 3.0))
    return np.asarray(held, dtype=np.float64)


def _fits(arrays: Arrays, organ: Organ) -> bool:
    """Say whether arrays are such as `_fill` makes for an organ."""
    if arrays.keys() != {"nodes", "tets", "sample_tet", "query_tet"}:
        return False
    nodes, tets = arrays["nodes"], arrays["tets"]
    if nodes.dtype != np.float64 or nodes.ndim != 2 or nodes.shape[1] != 3 or not np.isfinite(nodes).all():
        return False
    if not _indices(tets, (len(tets), 4), len(nodes)) or not (VolumeMesh(nodes, tets).volumes > 0.0).all():
        return False
    places = {"sample_tet": len(organ.surface_lookup.samples), "query_tet": len(organ.query_points)}
    return all(_indices(arrays[name], (count,), len(tets)) for name, count in places.items())


def _indices(array: NDArray[Any], shape: tuple[int, ...], count: int) -> bool:
    """Say whether an array has a shape and holds indices of `count` things."""
    if array.dtype != np.int64 or array.shape != shape or array.size == 0:
        return False
    return bool(array.min() >= 0 and array.max() < count)


def _fill(organ: Organ, progress: Progress) -> Arrays:
    mesh = organ.tetrahedra
    if mesh is None:
        mesh = tetrahedralise(organ.surface, progress)
    progress(f"finding where the organ's points lie in {len(mesh.tets)} tetrahedra")
    return {
        "nodes": mesh.nodes,
        "tets": mesh.tets,
        "sample_tet": mesh.locate(organ.surface_lookup.samples),
        "query_tet": mesh.locate(organ.query_points),
    }
