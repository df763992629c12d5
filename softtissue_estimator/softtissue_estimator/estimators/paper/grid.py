"""Regular voxel grid: where its cell centres lie, and which cell a point falls into."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class VoxelGrid:
    """Axis-aligned grid of cubic cells in the organ's frame.

    Attributes
    ----------
    origin
        Centre of cell (0, 0, 0), x y z in metres.
    spacing
        Distance between neighbouring cell centres, metres.
    shape
        Number of cells along x, y and z.
    """

    origin: tuple[float, float, float]
    spacing: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        if not (math.isfinite(self.spacing) and self.spacing > 0.0):
            raise InvalidInputError(f"grid spacing must be a positive number of metres, got {self.spacing}")
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise InvalidInputError(f"grid shape must be three positive cell counts, got {self.shape}")
        if len(self.origin) != 3 or not all(math.isfinite(c) for c in self.origin):
            raise InvalidInputError(
                f"grid origin must be three finite coordinates in metres, got {self.origin}"
            )

    @classmethod
    def cube(cls, centre: FloatArray, side_m: float = 0.30, cells: int = 64) -> VoxelGrid:
        """Return the paper's cube of `cells` a side around `centre` (section "Grid": 0.30 m, 64 cells).

        Parameters
        ----------
        centre
            (3,) middle of the cube, metres.

        Examples
        --------
        >>> grid = VoxelGrid.cube(np.zeros(3))
        >>> round(grid.spacing * 1000, 4)
        4.6875
        """
        spacing = side_m / cells
        first = np.asarray(centre, dtype=float) - 0.5 * spacing * (cells - 1)
        return cls((float(first[0]), float(first[1]), float(first[2])), spacing, (cells, cells, cells))

    @classmethod
    def covering(
        cls, lower: FloatArray, upper: FloatArray, spacing: float, *, multiple: int = 8, margin_cells: int = 2
    ) -> VoxelGrid:
        """Return the smallest grid around a box whose cell counts are multiples of `multiple`.

        The box is centred in the grid, so that the padding is the same on both sides.

        Parameters
        ----------
        lower, upper
            (3,) corners of the box, metres.
        multiple
            The network halves the grid three times, so that its cell counts must be multiples of 8.
        margin_cells
            Cells kept free on each side of the box.
        """
        low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        if low.shape != (3,) or high.shape != (3,) or not np.all(high >= low):
            raise InvalidInputError(
                f"box corners must be two points with lower <= upper, got {low} and {high}"
            )
        needed = np.ceil((high - low) / spacing).astype(int) + 1 + 2 * margin_cells
        cells = (np.ceil(needed / multiple).astype(int) * multiple).tolist()
        first = 0.5 * (low + high) - 0.5 * spacing * (np.array(cells) - 1)
        return cls(
            (float(first[0]), float(first[1]), float(first[2])), spacing, (cells[0], cells[1], cells[2])
        )

    @property
    def cells(self) -> int:
        """Number of cells in all."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    def points(self) -> FloatArray:
        """Return the cell centres, (X*Y*Z, 3) in metres, z varying fastest."""
        axes = [self.origin[a] + self.spacing * np.arange(self.shape[a]) for a in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def index(self, points: FloatArray) -> FloatArray:
        """Return the continuous cell index of points.

        Parameters
        ----------
        points
            (n, 3) in metres.

        Returns
        -------
        FloatArray
            (n, 3); whole numbers at cell centres.

        Examples
        --------
        >>> VoxelGrid((0.0, 0.0, 0.0), 0.5, (8, 8, 8)).index(np.array([[0.5, 1.0, 1.25]]))
        array([[1. , 2. , 2.5]])
        """
        result: FloatArray = (np.asarray(points, dtype=float) - np.array(self.origin)) / self.spacing
        return result
