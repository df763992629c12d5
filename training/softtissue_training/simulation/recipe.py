"""What simulations are made of: every setting of `softtissue-train generate`; the defaults are the paper's recipe."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.organs.organ_shape import SHAPES, Shapes
from softtissue_training.physics.material import LAWS, Law, Material

Range = tuple[float, float]


@dataclass(frozen=True)
class Recipe:
    """Settings that simulations are drawn with; a range is drawn from evenly, and one of equal ends is a fixed value.

    Attributes
    ----------
    shapes
        Family of organs.
    laws
        Material laws, drawn with equal probability.
    youngs_modulus_pa, poisson_ratio
        Ranges of the material's constants at small strain.
    forces
        Lowest and highest number of pushed patches.
    force_n
        Range of the force on each patch, newtons.
    gravity
        Range of a uniform acceleration in a random direction, in units of 9.81 m/s^2.
    pressure_pa
        Range of a pressure on one more patch; it follows the surface.
    load_cases
        Simulations of one organ, each attached and loaded anew.
    element_size_m
        Edge length of the elements, metres.
    """

    shapes: Shapes = "random"
    laws: tuple[Law, ...] = ("neo_hookean",)
    youngs_modulus_pa: Range = (1700.0, 1700.0)
    poisson_ratio: Range = (0.35, 0.35)
    forces: tuple[int, int] = (1, 1)
    force_n: Range = (0.0, 1.0)
    gravity: Range = (0.0, 0.0)
    pressure_pa: Range = (0.0, 0.0)
    load_cases: int = 1
    element_size_m: float = 0.010

    def __post_init__(self) -> None:
        if self.shapes not in SHAPES:
            raise InvalidInputError(f"shapes must be one of {', '.join(SHAPES)}, got {self.shapes!r}")
        if not self.laws or not set(self.laws) <= set(LAWS):
            raise InvalidInputError(f"laws must be some of {', '.join(LAWS)}, got {', '.join(self.laws)!r}")
        for name, (lowest, highest) in _LIMITS.items():
            low, high = getattr(self, name)
            if not lowest <= low <= high <= highest:
                raise InvalidInputError(
                    f"{name} must be a range within {lowest:g} to {highest:g}, got {low:g} to {high:g}"
                )
        if self.load_cases < 1:
            raise InvalidInputError(f"load_cases must be at least 1, got {self.load_cases}")
        if not 0.004 <= self.element_size_m <= 0.05:
            raise InvalidInputError(f"element size must be 4 to 50 mm, got {1e3 * self.element_size_m:g} mm")
        if self.forces[0] == 0 and not self.gravity[1] and not self.pressure_pa[1]:
            raise InvalidInputError("something must load the organ: forces, gravity or pressure, got none")

    def draw_material(self, rng: np.random.Generator) -> Material:
        """Draw what one simulation is made of."""
        law = self.laws[int(rng.integers(len(self.laws)))]
        return Material(law, rng.uniform(*self.youngs_modulus_pa), rng.uniform(*self.poisson_ratio))

    def to_json(self) -> dict[str, Any]:
        """Return the settings as JSON values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Recipe:
        """Return what `to_json` made; unknown names are refused."""
        unknown = set(values) - {field.name for field in fields(cls)}
        if unknown:
            raise InvalidInputError(f"a recipe has no setting {', '.join(sorted(unknown))}")
        settings: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
        }
        return cls(**settings)


_LIMITS: dict[str, Range] = {
    "youngs_modulus_pa": (1.0, 1e9),
    "poisson_ratio": (0.0, 0.49),
    "forces": (0, 20),
    "force_n": (0.0, 100.0),
    "gravity": (0.0, 10.0),
    "pressure_pa": (0.0, 1e6),
}
