"""A moving organ as a camera sees it, frame by frame, and where points inside it really are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas, sample_faces
from softtissue_estimator.organ.organ import Organ, make_organ
from softtissue_estimator.organ.volume_mesh import VolumeMesh
from softtissue_training.evaluation.inner_points import inner_points
from softtissue_training.evaluation.observe import ordered_faces
from softtissue_training.organs.surface_patch import draw_faces
from softtissue_training.simulation.moving_organ import MovingOrgan

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

_OBSERVED, _NOISE, _INNER = range(3)  # what a generator is for


@dataclass(frozen=True)
class StreamSettings:
    """How moving organs are observed.

    Attributes
    ----------
    frames, interval_s
        Number of clouds, and the time between two.
    visible_share
        Lowest and highest share of the surface's area that is visible, drawn evenly.
    spacing_m
        Distance of neighbouring observed points.
    noise_m
        Standard deviation of the noise on each component, fresh in each frame; estimators are told.
    inner_points
        Points inside the organ that are asked for; half of them are far from what is seen.
    """

    frames: int = 100
    interval_s: float = 0.1
    visible_share: tuple[float, float] = (0.10, 0.40)
    spacing_m: float = 0.003
    noise_m: float = 0.0005
    inner_points: int = 30


@dataclass(frozen=True, eq=False)
class Stream:
    """Everything about one stream, in metres and the organ's frame.

    Attributes
    ----------
    name, number
        Of the organ.
    organ
        With the attached region that it really has.
    volume
        Tetrahedra of the simulation, whose first nodes are the surface's vertices.
    settings
        See `StreamSettings`.
    times
        (f,) s.
    surface_moved
        (f, v, 3) displacement of the surface's vertices.
    visible
        (m,) true for the faces that are seen.
    reference
        (k, 3) preoperative positions of the tracked points.
    normals
        (k, 3) outward normals of the preoperative surface there.
    noise
        (f, k, 3).
    inner
        (p, 3) preoperative positions that are asked for; first those that were chosen far from what is seen.
    truth
        (f, p, 3) their displacement.
    depth
        (p,) their distance to the nearest visible point of the preoperative surface.
    """

    name: str
    number: int
    organ: Organ
    volume: VolumeMesh
    settings: StreamSettings
    times: FloatArray
    surface_moved: FloatArray
    visible: BoolArray
    reference: FloatArray
    normals: FloatArray
    noise: FloatArray
    inner: FloatArray
    truth: FloatArray
    depth: FloatArray

    @cached_property
    def points(self) -> FloatArray:
        """Observed present positions with noise and nothing else wrong, (f, k, 3) m."""
        return self.present(self.reference) + self.noise

    @property
    def seen(self) -> BoolArray:
        """All of them, (f, k)."""
        return np.ones(self.noise.shape[:2], dtype=bool)

    @property
    def interval_s(self) -> float:
        """Between two clouds."""
        return self.settings.interval_s

    @property
    def told_noise_m(self) -> float:
        """Standard deviation of each component of the noise."""
        return self.settings.noise_m

    def present(self, material: FloatArray) -> FloatArray:
        """Where points (k, 3) m nearest to the preoperative surface are in every frame, (f, k, 3) m."""
        closest, corners, weights = self._located(material)
        return np.asarray(closest + np.einsum("ka,fkac->fkc", weights, self.surface_moved[:, corners]))

    def present_by_frame(self, material: FloatArray) -> FloatArray:
        """Do the same where each frame has points of its own, (f, k, 3) m of the preoperative surface."""
        frames, count, _ = material.shape
        closest, corners, weights = self._located(material.reshape(-1, 3))
        frame = np.repeat(np.arange(frames), count)[:, None]
        moved = np.einsum("ka,kac->kc", weights, self.surface_moved[frame, corners])
        return np.asarray((closest + moved).reshape(material.shape))

    def _located(self, points: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """Find the nearest points of the preoperative surface, (k, 3) m, their faces' corners and weights, (k, 3)."""
        surface = self.organ.surface
        _, face, closest = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces)
        corners = surface.faces[np.asarray(face)]
        ends = (np.ascontiguousarray(surface.vertices[corners[:, i]]) for i in range(3))
        weights = igl.barycentric_coordinates(np.ascontiguousarray(closest), *ends)
        return np.asarray(closest), corners, np.asarray(weights)

    @cached_property
    def centre(self) -> FloatArray:
        """Centre of the organ's volume, (3,) m."""
        volumes = self.volume.volumes
        centroids = self.volume.nodes[self.volume.tets].mean(axis=1)
        return np.asarray(volumes @ centroids / volumes.sum())

    @cached_property
    def viewing_direction(self) -> FloatArray:
        """Direction in which the camera looks, (3,): against the mean normal of what is seen."""
        mean = self.normals.mean(axis=0)
        return np.asarray(-mean / np.linalg.norm(mean))

    @property
    def visible_share(self) -> float:
        """Share of the surface's area that is seen."""
        areas = face_areas(self.organ.surface)
        return float(areas[self.visible].sum() / areas.sum())


def make_stream(motion: MovingOrgan, name: str, seed: tuple[int, int], settings: StreamSettings) -> Stream:
    """Observe a motion; the same arguments give the same stream.

    Parameters
    ----------
    seed
        Of the data set, and the organ's number in it.
    """
    observed, noises, inside = (
        np.random.default_rng([*seed, 100 + part]) for part in (_OBSERVED, _NOISE, _INNER)
    )
    surface = SurfaceMesh(motion.mesh.surface.vertices, ordered_faces(motion.mesh.faces))
    organ = make_organ(name, "organ", surface, (), motion.attached)
    volume = VolumeMesh(motion.mesh.vertices, motion.mesh.tets)
    visible = draw_faces(surface, lambda rng: rng.uniform(*settings.visible_share), observed)
    reference, face, _ = sample_faces(surface, visible, settings.spacing_m)
    times: FloatArray = settings.interval_s * np.arange(settings.frames, dtype=np.float64)
    moved = motion.at(times)
    inner, depth = inner_points(volume, surface, visible, settings.inner_points, inside)
    interpolation = volume.interpolation(inner)
    return Stream(
        name=name,
        number=seed[1],
        organ=organ,
        volume=volume,
        settings=settings,
        times=times,
        surface_moved=moved[:, : len(surface.vertices)],
        visible=visible,
        reference=reference,
        normals=_face_normals(surface)[face],
        noise=settings.noise_m * noises.normal(size=(len(times), len(reference), 3)),
        inner=inner,
        truth=np.stack([interpolation @ state for state in moved]),
        depth=depth,
    )


def _face_normals(surface: SurfaceMesh) -> FloatArray:
    corners = surface.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
