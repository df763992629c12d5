"""A drawn patient with known geometry: an organ that no mirror maps onto itself, on grids of every kind."""

from dataclasses import dataclass

import numpy as np

from estimator.shapes import rotation

CENTRE = np.array([-60.0, 35.0, 210.0])  # LPS, mm
HALF_AXES = np.array([70.0, 50.0, 40.0])
TUMOUR, TUMOUR_RADIUS = CENTRE + np.array([38.0, 14.0, 9.0]), 11.0
VEIN_AXIS, VEIN_RADIUS = (
    CENTRE[1:] + np.array([-12.0, 6.0]),
    5.0,
)  # along x, from the middle to beyond the surface
SPLEEN, SPLEEN_RADIUS = CENTRE + np.array([0.0, 78.0, 0.0]), 24.0
NAMES = ("liver", "portal vein", "tumor 1", "spleen")


@dataclass(frozen=True)
class Grid:
    """Voxels: how many, and the way from their indices to LPS, mm."""

    shape: tuple[int, int, int]
    affine: np.ndarray

    @property
    def voxel_volume(self) -> float:
        return abs(np.linalg.det(self.affine[:3, :3]))

    def places(self) -> np.ndarray:
        """Centres of all voxels, (a, b, c, 3) LPS mm."""
        index = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1)
        return index @ self.affine[:3, :3].T + self.affine[:3, 3]


def grid(spacing=(1.5, 2.0, 2.5), directions=None) -> Grid:
    """A grid around organ and spleen whose axes are the columns of a matrix of directions."""
    edges = (np.eye(3) if directions is None else np.asarray(directions)) * np.asarray(spacing)
    middle = CENTRE + np.array([0.0, 22.0, 0.0])
    extents = np.abs(np.linalg.inv(edges)) @ np.array([170.0, 175.0, 110.0])
    shape = tuple(int(n) for n in np.ceil(extents))
    affine = np.eye(4)
    affine[:3, :3] = edges
    affine[:3, 3] = middle - edges @ (np.array(shape) - 1.0) / 2.0
    return Grid(shape, affine)


OBLIQUE = rotation([1.0, 2.0, -0.5], 0.4)
GRIDS = {
    "anisotropic": grid(),
    "oblique": grid(directions=OBLIQUE),
    "left-handed": grid(directions=np.diag([1.0, 1.0, -1.0])),
    "left-handed oblique": grid(directions=OBLIQUE @ np.diag([-1.0, 1.0, 1.0])),
    "sagittal": grid((2.0, 1.5, 2.5), [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}


def masks(where: Grid, exclusive: bool = False) -> dict[str, np.ndarray]:
    """Voxels of each thing by name; exclusive ones are cut out of the organ, as 3D Slicer does by default."""
    at = where.places()
    liver = (((at - CENTRE) / HALF_AXES) ** 2).sum(axis=-1) <= 1.0
    tumour = np.linalg.norm(at - TUMOUR, axis=-1) <= TUMOUR_RADIUS
    vein = (np.linalg.norm(at[..., 1:] - VEIN_AXIS, axis=-1) <= VEIN_RADIUS) & (
        (at[..., 0] <= CENTRE[0]) & (at[..., 0] >= CENTRE[0] - 75.0)
    )
    spleen = np.linalg.norm(at - SPLEEN, axis=-1) <= SPLEEN_RADIUS
    if exclusive:
        liver = liver & ~tumour & ~vein
    return dict(zip(NAMES, (liver, vein, tumour, spleen & ~liver), strict=True))


def labels(where: Grid) -> np.ndarray:
    """One label map, 1 to 4 in the order of the names."""
    found = np.zeros(where.shape, dtype=np.uint8)
    for number, mask in enumerate(masks(where, exclusive=True).values(), 1):
        found[mask] = number
    return found


def places_of(segment, affine_m: np.ndarray) -> np.ndarray:
    """Centres of the voxels of a segment that was read, (n, 3) LPS mm."""
    index = np.argwhere(segment.mask) + np.array(segment.start)
    return 1e3 * (index @ affine_m[:3, :3].T + affine_m[:3, 3])


def mask_of(segment, affine_m: np.ndarray, where: Grid) -> np.ndarray:
    """Voxels of a segment that was read, on the grid it was drawn on; each must be at a centre of one of its voxels."""
    places = places_of(segment, affine_m)
    index = (places - where.affine[:3, 3]) @ np.linalg.inv(where.affine[:3, :3]).T
    nearest = np.rint(index).astype(int)
    off = np.abs((index - nearest) @ where.affine[:3, :3].T).max()
    assert off < 0.01, f"a voxel is {off:.3g} mm off"
    found = np.zeros(where.shape, dtype=bool)
    found[tuple(nearest.T)] = True
    return found
