"""An organ as scanned: its surface, what lies inside it and where it is attached."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import OrganError
from softtissue_estimator.mesh import BoolArray, FloatArray, SurfaceMesh
from softtissue_estimator.surface_lookup import SurfaceLookup, build_surface_lookup


@dataclass(frozen=True, eq=False)
class Structure:
    """Something inside the organ, such as a vessel tree or a tumour.

    Parameters
    ----------
    name, kind : str
    mesh : SurfaceMesh
        m, organ frame.
    colour : tuple of four floats
        Red, green, blue, opacity; 0 to 1.
    """

    name: str
    kind: str
    mesh: SurfaceMesh
    colour: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Organ:
    """A preoperative organ. Everything is in metres, in the frame named `frame`.

    Parameters
    ----------
    name, frame : str
    surface : SurfaceMesh
    structures : tuple of Structure
    attached : (n,) bool
        For every surface vertex, whether it is held in place.
    folder : Path or None
        Where it was read from.
    digest : str
        Hash of geometry, attachment and structures; equal digests mean equal organs.
    """

    name: str
    frame: str
    surface: SurfaceMesh
    structures: tuple[Structure, ...]
    attached: BoolArray
    folder: Path | None
    digest: str

    def __post_init__(self) -> None:
        if self.attached.shape != (len(self.surface.vertices),):
            raise OrganError(
                f"organ {self.name!r}, attached: expected one flag for each of the "
                f"{len(self.surface.vertices)} surface vertices, got shape {self.attached.shape}"
            )

    @cached_property
    def structure_points(self) -> FloatArray:
        """Vertices of all structures, in order, (k, 3) m."""
        return np.concatenate([np.empty((0, 3)), *(s.mesh.vertices for s in self.structures)])

    @cached_property
    def structure_index(self) -> NDArray[np.uint32]:
        """Which structure each of `structure_points` belongs to, (k,)."""
        sizes = [len(s.mesh.vertices) for s in self.structures]
        return np.repeat(np.arange(len(sizes), dtype=np.uint32), sizes)

    @cached_property
    def query_points(self) -> FloatArray:
        """Where every estimator answers: `structure_points`, then the surface vertices, (k + n, 3) m."""
        return np.concatenate([self.structure_points, self.surface.vertices])

    @cached_property
    def surface_lookup(self) -> SurfaceLookup:
        """Table for finding the nearest surface of many points at once; built when first asked for."""
        return build_surface_lookup(self.surface)
