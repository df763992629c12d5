"""What the suite `clouds` simulates and asks."""

from __future__ import annotations

from dataclasses import dataclass, field

from softtissue_training.evaluation.clouds.views import ViewLimits
from softtissue_training.simulation.recipe import Recipe

ORGANS, VIEWS, ASKED_VIEWS = 20, 10, 3
QUICK_ORGANS, QUICK_VIEWS = 3, 3
_RECIPE = Recipe(shapes="liver", forces=(1, 2), force_n=(0.2, 0.8), youngs_modulus_pa=(3000.0, 5000.0))


@dataclass(frozen=True)
class CloudPlan:
    """Organs, and how they are looked at.

    Attributes
    ----------
    seed
        Of all organs and views.
    organs, views
        How many, and how many views of each.
    asked
        Estimators are shown the first so many views of each organ.
    recipe
        Of the simulations.
    mean_displacement_m
        Between these lies the mean over an organ's surface; others are drawn anew.
    limits
        Of the views.
    """

    seed: int
    organs: int = ORGANS
    views: int = VIEWS
    asked: int = ASKED_VIEWS
    recipe: Recipe = _RECIPE
    mean_displacement_m: tuple[float, float] = (0.005, 0.015)
    limits: ViewLimits = field(default_factory=ViewLimits)
