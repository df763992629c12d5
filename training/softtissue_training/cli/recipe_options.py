"""The options of commands that simulate, and the recipe they give."""

from __future__ import annotations

import argparse

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.organs.organ_shape import SHAPES
from softtissue_training.physics.material import LAWS
from softtissue_training.simulation.recipe import Recipe

_PAPER = Recipe()


def add_recipe_options(parser: argparse.ArgumentParser) -> None:
    """Add one option for each setting of `Recipe`; those that the paper's recipe lacks are off."""
    organs = parser.add_argument_group("organs")
    organs.add_argument(
        "--shapes",
        choices=SHAPES,
        default=_PAPER.shapes,
        help="random organs, liver-like ones, or three in ten liver-like (default: random)",
    )
    organs.add_argument(
        "--element-size",
        type=float,
        default=1e3 * _PAPER.element_size_m,
        metavar="MM",
        help="edge length of the tetrahedra (default: 10)",
    )
    organs.add_argument(
        "--load-cases",
        type=int,
        default=_PAPER.load_cases,
        metavar="N",
        help="simulations of each organ, attached and loaded anew; the mesh is stored once (default: 1)",
    )
    material = parser.add_argument_group("material")
    material.add_argument(
        "--material",
        choices=LAWS,
        nargs="+",
        default=_PAPER.laws,
        help="laws at large strain; of several, one is drawn for each simulation (default: neo_hookean)",
    )
    _add_range(material, "--youngs-modulus", _PAPER.youngs_modulus_pa, "PA", "Young's modulus in pascals")
    _add_range(material, "--poisson-ratio", _PAPER.poisson_ratio, "NU", "Poisson's ratio, up to 0.49")
    loads = parser.add_argument_group("loads")
    loads.add_argument(
        "--forces",
        type=int,
        nargs="+",
        default=_PAPER.forces,
        metavar="N",
        help="number of pushed patches, or its range (default: 1)",
    )
    _add_range(loads, "--force", _PAPER.force_n, "NEWTON", "force on each patch in newtons")
    _add_range(
        loads,
        "--gravity",
        _PAPER.gravity,
        "G",
        "gravity in a random direction, in units of 9.81 m/s^2",
    )
    _add_range(loads, "--pressure", _PAPER.pressure_pa, "PA", "pressure on one more patch in pascals")


def _add_range(
    group: argparse._ArgumentGroup, name: str, default: tuple[float, float], unit: str, what: str
) -> None:
    shown = f"{default[0]:g}" if default[0] == default[1] else f"{default[0]:g} {default[1]:g}"
    group.add_argument(
        name,
        type=float,
        nargs="+",
        default=default,
        metavar=unit,
        help=f"{what}: one value, or the two ends of a range (default: {shown})",
    )


def recipe_from(options: argparse.Namespace) -> Recipe:
    """Return the recipe that the options describe.

    Raises
    ------
    InvalidInputError
        A value is out of its range, or a range has more than two ends.
    """
    low, high = _ends(options.forces, "--forces")
    return Recipe(
        shapes=options.shapes,
        laws=tuple(options.material),
        youngs_modulus_pa=_ends(options.youngs_modulus, "--youngs-modulus"),
        poisson_ratio=_ends(options.poisson_ratio, "--poisson-ratio"),
        forces=(int(low), int(high)),
        force_n=_ends(options.force, "--force"),
        gravity=_ends(options.gravity, "--gravity"),
        pressure_pa=_ends(options.pressure, "--pressure"),
        load_cases=options.load_cases,
        element_size_m=1e-3 * options.element_size,
    )


def _ends(values: tuple[float, ...] | list[float], name: str) -> tuple[float, float]:
    if len(values) > 2:
        raise InvalidInputError(
            f"{name} must be one value or the two ends of a range, got {len(values)} values"
        )
    return values[0], values[-1]
