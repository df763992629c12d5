"""All surfaces of the scene at a moment, in the organ's frame."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.view.rendering import vertex_normals
from softtissue_training.phantom.anatomy import Anatomy
from softtissue_training.phantom.motion import Motion
from softtissue_training.scene.instrument import GrasperPath, grasper, joined, probe, probe_pose
from softtissue_training.scene.motion import breath
from softtissue_training.scene.spec import SceneSpec
from softtissue_training.scene.surroundings import Neighbour, moved_outwards

Array = NDArray[np.float64]

SURFACES = ("organ", "wall", "stomach", "fat", "probe", "grasper")
"""Names by label."""
ORGAN = 0


@dataclass(frozen=True)
class Moment:
    """All surfaces at once.

    Attributes
    ----------
    mesh
        n vertices and m triangles of all surfaces, m, organ's frame.
    rest
        (n, 3) m, where each vertex is when nothing moves; on an instrument, in its own frame.
    label
        (m,) of each triangle, index of `SURFACES`.
    """

    mesh: SurfaceMesh
    rest: Array
    label: NDArray[np.uint8]

    def part(self, label: int) -> SurfaceMesh:
        """One of the surfaces; its triangles keep their order."""
        faces = self.mesh.faces[self.label == label]
        first, last = int(faces.min()), int(faces.max())
        return SurfaceMesh(self.mesh.vertices[first : last + 1], faces - first)


class World:
    """The scene at any moment.

    Parameters
    ----------
    anatomy, motion
        The organ and how it moves.
    neighbours
        Around it.
    spec
    """

    def __init__(
        self, anatomy: Anatomy, motion: Motion, neighbours: tuple[Neighbour, ...], spec: SceneSpec
    ) -> None:
        self.anatomy, self.motion, self._neighbours, self._spec = anatomy, motion, neighbours, spec
        self._grasper = GrasperPath()

    def organ(self, time: float) -> SurfaceMesh:
        """Return the organ's true surface at a time (s)."""
        surface = self.anatomy.surface
        return SurfaceMesh(surface.vertices + self.motion.at(self._weights, time), surface.faces)

    def at(self, time: float) -> Moment:
        """All surfaces at a time (s)."""
        organ = self.organ(time)
        size = breath(self._spec.breathing, time)
        rested = self.anatomy.surface
        outwards = moved_outwards(rested, organ.vertices - rested.vertices)
        touched = self._touched
        rod, tool = probe(), grasper(self._grasper.opening(time))
        rod_pose = probe_pose(organ.vertices[touched], vertex_normals(organ)[touched])
        parts = [organ, *(SurfaceMesh(one.at(size, outwards), one.mesh.faces) for one in self._neighbours)]
        parts += [
            SurfaceMesh(rod_pose.outer(rod.vertices), rod.faces),
            SurfaceMesh(self._grasper.pose(time).outer(tool.vertices), tool.faces),
        ]
        rest = [rested.vertices, *(one.mesh.vertices for one in self._neighbours)]
        rest += [rod.vertices, grasper(0.0).vertices]
        labels = [np.full(len(part.faces), label, dtype=np.uint8) for label, part in enumerate(parts)]
        return Moment(joined(parts), np.concatenate(rest), np.concatenate(labels))

    @cached_property
    def _weights(self) -> sparse.csr_array:
        return self.motion.interpolator.weights(self.anatomy.surface.vertices)

    @cached_property
    def _touched(self) -> int:
        """Vertex that the probe touches: the middle of the pushed area."""
        offset = self.anatomy.surface.vertices - np.array(self._spec.push.point)
        return int(np.argmin(np.linalg.norm(offset, axis=1)))
