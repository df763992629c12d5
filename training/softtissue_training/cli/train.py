"""`softtissue-train train`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.cli.arguments import Commands, positive
from softtissue_training.learning.precision import PRECISIONS
from softtissue_training.learning.training_config import CONFIGS, get_config

_DESCRIPTION = """\
Train the network on simulations made by `generate`. One organ in ten is held out for validation.

The run ends after --steps, or at --time-limit, or when --patience validations in a row have not improved; give at
least one. With --steps the whole run depends on the data and the seed alone: killed and started again with --resume,
it leaves the same OUT/loss.csv as one that was not. With --time-limit alone, the learning rate follows the clock.
"""

_EPILOG = """\
OUT then holds best.safetensors (lowest validation error), state.safetensors (for --resume), config.json, loss.csv (each
step), log.csv (each validation) and summary.json.

examples:
  softtissue-train train --data sims --out run --config paper --time-limit 600
  softtissue-train train --data sims.pack --out run --config paper-coarse --steps 20000 --patience 10 --tensorboard
  softtissue-train train --data sims --out run --config paper-coarse --steps 20000 --resume
  torchrun --nproc-per-node 2 -m softtissue_training train --data sims --out run --steps 20000

next: softtissue-train evaluate --help, and softtissue-train export OUT FILE for the node
"""


def add(commands: Commands) -> None:
    """Add the command."""
    train = commands.add_parser(
        "train",
        help="train the network on simulations",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    train.add_argument(
        "--data",
        type=Path,
        required=True,
        metavar="PATH",
        help="folder or packed file of simulations",
    )
    train.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder of the run")
    train.add_argument(
        "--config",
        choices=tuple(CONFIGS),
        default="paper",
        help="paper: 4.7 mm cells, for a GPU; paper-coarse: 9.4 mm, a fifth of the work; paper-original: as "
        "published, in the organ's frame; tiny: for trying out; overfit: a few organs by heart (default: "
        "paper)",
    )
    train.add_argument("--resume", action="store_true", help="go on with the unfinished run in OUT")
    train.add_argument(
        "--start", type=Path, metavar="FILE", help="weights of the paper's network that a new run begins with"
    )
    _add_ends(train.add_argument_group("when it ends"))
    _add_machine(train.add_argument_group("on what it runs"))
    _add_changes(train.add_argument_group("changes to the configuration"))
    train.set_defaults(run=_train)


def _add_ends(group: Any) -> None:
    group.add_argument("--steps", type=positive, metavar="N", help="optimisation steps")
    group.add_argument(
        "--time-limit",
        type=float,
        metavar="MINUTES",
        help="learning and validating, over all parts of the run; a run with --steps can be resumed afterwards",
    )
    group.add_argument(
        "--patience", type=positive, metavar="N", help="validations in a row without improvement"
    )
    group.add_argument(
        "--validate-every",
        type=positive,
        metavar="STEPS",
        help="steps between validations, each of which saves (default: a twentieth of --steps)",
    )
    group.add_argument(
        "--validate-minutes",
        type=float,
        metavar="MINUTES",
        help="the same by the clock (default without --steps: 4, or a twentieth of --time-limit if that is less)",
    )


def _add_machine(group: Any) -> None:
    group.add_argument("--device", default="auto", help="auto, cpu or cuda (default: auto)")
    group.add_argument(
        "--precision",
        choices=PRECISIONS,
        default="auto",
        help="of the convolutions; auto: bfloat16 where the device has instructions for it (default: auto)",
    )
    group.add_argument("--threads", type=positive, metavar="N", help="processor threads (default: all cores)")
    group.add_argument(
        "--workers",
        type=positive,
        default=1,
        metavar="N",
        help="processes that voxelise the simulations at the start (default: 1)",
    )
    group.add_argument(
        "--drawers",
        type=int,
        default=0,
        metavar="N",
        help="processes that draw what is seen, for the paper's network on a GPU (default: a thread)",
    )
    group.add_argument(
        "--watch",
        action="store_true",
        help="use simulations that are added to PATH meanwhile; the run can then not be repeated",
    )
    group.add_argument("--tensorboard", action="store_true", help="curves in OUT/tensorboard too")


def _add_changes(group: Any) -> None:
    group.add_argument("--seed", type=int, metavar="S", help="of weights, order and patches (default: 1)")
    group.add_argument("--batch-size", type=positive, metavar="N", help="samples a step")
    group.add_argument("--learning-rate", type=float, metavar="R", help="highest learning rate")
    group.add_argument(
        "--ema-decay",
        type=float,
        metavar="D",
        help="decay a step of the moving average of the weights, which is what is validated and kept",
    )
    group.add_argument(
        "--noise",
        type=float,
        nargs=2,
        metavar=("MIN", "MAX"),
        help="range of the standard deviation of noise on the visible displacement, mm",
    )
    group.add_argument(
        "--correspondences",
        type=positive,
        nargs=2,
        metavar=("MIN", "MAX"),
        help="range of the number of visible points that are known (default: all)",
    )
    group.add_argument(
        "--larger-boxes",
        type=float,
        metavar="SHARE",
        help="share of the batches that see more than the organ's box, up to the whole cube",
    )


def _config_changes(options: argparse.Namespace) -> dict[str, Any]:
    changes = {
        "seed": options.seed,
        "batch_size": options.batch_size,
        "learning_rate": options.learning_rate,
        "ema_decay": options.ema_decay,
        "noise_m": None if options.noise is None else tuple(1e-3 * value for value in options.noise),
        "correspondences": None if options.correspondences is None else tuple(options.correspondences),
        "larger_box_share": options.larger_boxes,
    }
    return {name: value for name, value in changes.items() if value is not None}


def _seconds(minutes: float | None) -> float | None:
    return None if minutes is None else 60.0 * minutes


def _train(options: argparse.Namespace) -> int:
    import torch

    from softtissue_estimator.inference.device import choose_device
    from softtissue_training.learning.distributed import joined, local_device
    from softtissue_training.learning.precision import choose_bfloat16
    from softtissue_training.learning.run_files import STATE
    from softtissue_training.learning.schedule import Schedule
    from softtissue_training.learning.train import RunOptions, train

    if (options.out / STATE).exists() and not options.resume:
        raise InvalidInputError(f"{options.out} holds a run already; add --resume to go on with it")
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    schedule = Schedule(
        steps=options.steps,
        time_limit_s=_seconds(options.time_limit),
        patience=options.patience,
        validate_every_steps=options.validate_every,
        validate_every_s=_seconds(options.validate_minutes),
    )
    device = local_device(choose_device(options.device))
    run_options = RunOptions(
        device=str(device),
        bfloat16=choose_bfloat16(options.precision, device),
        workers=options.workers,
        drawers=options.drawers,
        start=options.start,
        watch=options.watch,
        tensorboard=options.tensorboard,
        command=" ".join(["softtissue-train", *sys.argv[1:]]),
    )
    config = get_config(options.config, **_config_changes(options))
    with joined(device) as ranks:
        summary = train(options.data, options.out, config, schedule, run_options, ranks)
    if ranks.writes:
        print(summary.text())
        print(
            f"weights   {options.out}/best.safetensors; for the node: softtissue-train export {options.out} FILE"
        )
    return 0
