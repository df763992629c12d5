"""`softtissue-train train`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.cli.arguments import Commands, positive
from softtissue_training.training_config import CONFIGS, get_config


def add(commands: Commands) -> None:
    """Add the command."""
    train = commands.add_parser(
        "train",
        help="train the network on simulations",
        description="Train the network. Simulations that are added meanwhile are used as they come. One in twenty is "
        "held out for validation; the weights with the lowest validation error are kept in OUT/best.safetensors.",
    )
    train.add_argument(
        "--data", type=Path, required=True, metavar="PATH", help="folder or packed file of simulations"
    )
    train.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of weights, log and settings"
    )
    train.add_argument(
        "--config",
        choices=tuple(CONFIGS),
        default="paper",
        help="paper: 4.7 mm cells; paper-coarse: 9.4 mm, a fifth of the work; tiny: for trying out (default: paper)",
    )
    train.add_argument(
        "--time-limit",
        type=float,
        required=True,
        metavar="MINUTES",
        help="the run ends then, with the best weights",
    )
    train.add_argument("--resume", action="store_true", help="go on with the unfinished run in OUT")
    train.add_argument("--device", default="auto", help="auto, cpu or cuda (default: auto)")
    train.add_argument("--threads", type=positive, metavar="N", help="processor threads (default: all cores)")
    train.add_argument(
        "--workers",
        type=positive,
        default=1,
        metavar="N",
        help="processes that voxelise simulations (default: 1)",
    )
    train.add_argument("--bfloat16", action="store_true", help="convolutions in bfloat16")
    train.add_argument("--batch-size", type=positive, metavar="N", help="samples a step")
    train.add_argument("--learning-rate", type=float, metavar="R", help="highest learning rate")
    train.add_argument(
        "--validate-every", type=float, default=4.0, metavar="MINUTES", help="also saves (default: 4)"
    )
    train.set_defaults(run=_train)


def _train(options: argparse.Namespace) -> int:
    import torch

    from softtissue_estimator.device import choose_device
    from softtissue_training.train import STATE, RunOptions, train

    if (options.out / STATE).exists() and not options.resume:
        raise InvalidInputError(f"{options.out} holds a run already; add --resume to go on with it")
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    changes = {"batch_size": options.batch_size, "learning_rate": options.learning_rate}
    config = get_config(
        options.config, **{name: value for name, value in changes.items() if value is not None}
    )
    result = train(
        options.data,
        options.out,
        config,
        RunOptions(
            time_limit_s=60.0 * options.time_limit,
            validate_every_s=60.0 * options.validate_every,
            device=str(choose_device(options.device)),
            mixed_precision=options.bfloat16,
            workers=options.workers,
            command=" ".join(["softtissue-train", *sys.argv[1:]]),
        ),
    )
    print(
        f"validation error {1e3 * result.error:.2f} mm; no estimate {1e3 * result.displacement:.2f} mm, "
        f"rigid fit of the visible patch {1e3 * result.rigid_error:.2f} mm"
    )
    return 0
