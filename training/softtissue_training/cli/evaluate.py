"""`softtissue-train evaluate`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from softtissue_training.cli import evaluate_breathing, evaluate_phantom
from softtissue_training.cli.arguments import Commands, positive


def add(commands: Commands) -> None:
    """Add the command."""
    evaluate = commands.add_parser(
        "evaluate",
        help="measure how far estimators are off",
        description="Measure how far estimators are off where the truth is known.",
    )
    experiments = evaluate.add_subparsers(required=True, metavar="EXPERIMENT")
    _add_insilico(experiments)
    evaluate_phantom.add(experiments)
    evaluate_breathing.add(experiments)


def _add_insilico(experiments: Commands) -> None:
    insilico = experiments.add_parser(
        "insilico",
        help="on simulated organs",
        description="Show every estimator the same random patch of each simulated organ, with the same noise, and "
        "compare its answer with the simulation. Writes OUT/samples.csv, OUT/evaluation.json and OUT/figures. The "
        "same command again goes on where it was stopped; estimators that are added to the list are computed alone.",
        epilog="Evaluate on simulations that the checkpoints were not trained on: generate them with another seed.",
    )
    insilico.add_argument(
        "--data", type=Path, required=True, metavar="PATH", help="folder or packed file of simulations"
    )
    insilico.add_argument(
        "--estimators",
        default="zero,rigid,rbf,fem,elastic,paper",
        metavar="LIST",
        help="separated by commas: zero (no displacement), rigid (rigid fit of the observation), rbf (radial basis "
        "interpolation), fem (finite elements with the visible displacement prescribed), elastic, paper or another "
        "estimator of the product; NAME=FILE.safetensors for weights of your own (default: %(default)s)",
    )
    insilico.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the reports")
    insilico.add_argument("--count", type=positive, metavar="N", help="organs (default: all)")
    insilico.add_argument(
        "--skip", type=int, default=0, metavar="N", help="leave out the first N organs (default: 0)"
    )
    _add_observation_options(insilico)
    insilico.add_argument(
        "--workers", type=positive, default=1, metavar="N", help="processes of one thread (default: 1)"
    )
    insilico.add_argument("--device", default="auto", help="of networks: auto, cpu or cuda (default: auto)")
    insilico.set_defaults(run=_insilico)


def _add_observation_options(insilico: argparse.ArgumentParser) -> None:
    insilico.add_argument(
        "--seed", type=int, default=0, metavar="S", help="the observation and its noise (default: 0)"
    )
    insilico.add_argument(
        "--visible",
        type=float,
        nargs=2,
        default=(8.0, 60.0),
        metavar=("LO", "HI"),
        help="visible share of the surface in percent, drawn evenly between (default: 8 60)",
    )
    insilico.add_argument(
        "--noise",
        type=float,
        default=0.0,
        metavar="MM",
        help="standard deviation of each component of each observed displacement (default: 0)",
    )
    insilico.add_argument(
        "--spacing",
        type=float,
        default=3.0,
        metavar="MM",
        help="between observed points; 0 observes the mesh's own vertices (default: 3)",
    )
    insilico.add_argument(
        "--sparse", type=positive, metavar="N", help="observe only N random points of the patch"
    )


def _insilico(options: argparse.Namespace) -> int:
    from softtissue_estimator.errors import InvalidInputError
    from softtissue_training.evaluation.insilico import evaluate_in_silico
    from softtissue_training.evaluation.methods import parse_methods
    from softtissue_training.evaluation.observe import ObservationSettings

    low, high = options.visible
    settings = ObservationSettings(
        visible_share=(0.01 * low, 0.01 * high),
        noise_m=1e-3 * options.noise,
        spacing_m=1e-3 * options.spacing,
        sparse=options.sparse,
    )
    if options.seed < 0 or options.skip < 0:
        raise InvalidInputError(
            f"--seed and --skip: expected whole numbers from 0, got {options.seed} and {options.skip}"
        )
    print(
        evaluate_in_silico(
            options.data,
            parse_methods(options.estimators, options.device),
            options.out,
            settings,
            seed=options.seed,
            count=options.count,
            skip=options.skip,
            workers=options.workers,
            command=shlex.join(["softtissue-train", *sys.argv[1:]]),
        )
    )
    return 0
