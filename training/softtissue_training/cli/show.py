"""`softtissue-train show`."""

from __future__ import annotations

import argparse
from pathlib import Path

from softtissue_training.cli.arguments import Commands, positive
from softtissue_training.cli.recipe_options import add_recipe_options, recipe_from


def add(commands: Commands) -> None:
    """Add the command."""
    show = commands.add_parser(
        "show",
        help="draw the first simulations of a seed",
        description="Simulate the first organs of a seed, with the same options as `generate`, and draw them before "
        "and deformed.",
    )
    show.add_argument("seed", type=int, metavar="SEED", help="seed of the data set")
    show.add_argument("--organs", type=positive, default=5, metavar="N", help="how many (default: 5)")
    show.add_argument(
        "--out", type=Path, metavar="FILE", help="picture to write (default: simulations_SEED.png)"
    )
    add_recipe_options(show)
    show.set_defaults(run=_show)


def _show(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from softtissue_training.simulation.simulate import simulate
    from softtissue_training.simulation.simulation_picture import draw_simulations

    recipe = recipe_from(options)
    file = options.out or Path(f"simulations_{options.seed}.png")
    numbers = tqdm(range(options.organs), desc="simulating", unit="organ", leave=False)
    samples = [simulate(options.seed, number, recipe).simulations[0] for number in numbers]
    draw_simulations(file, samples, f"Simulations of seed {options.seed}")
    print(f"{file}: {options.organs} simulations of seed {options.seed}")
    return 0
