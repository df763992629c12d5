"""The command `softtissue-train`: simulate, pack, train, export."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_training.material import LAWS
from softtissue_training.training_config import CONFIGS, get_config


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0, or 2 for input that cannot be used."""
    options = _parser().parse_args(arguments)
    try:
        code: int = options.run(options)
    except SoftTissueError as error:
        print(f"softtissue-train: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nsofttissue-train: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="softtissue-train",
        description="Simulate deformed organs and train the estimator's network on them.",
        epilog="A first run:  softtissue-train generate --count 1000 --seed 1 --out sims;  "
        "softtissue-train train --data sims --out run --time-limit 60",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    generate = commands.add_parser(
        "generate",
        help="simulate random organs",
        description="Simulate random organs, each attached at one patch and pushed at another. About one second a "
        "sample and core, 60 kB each. The same command again adds what is missing.",
    )
    generate.add_argument("--count", type=_positive, required=True, metavar="N", help="samples in all")
    generate.add_argument(
        "--seed", type=int, required=True, metavar="S", help="the same seed gives the same samples"
    )
    generate.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the records")
    generate.add_argument("--workers", type=_positive, default=1, metavar="N", help="processes (default: 1)")
    generate.add_argument(
        "--material", choices=LAWS, default="neo_hookean", help="law at large strain (default: neo_hookean)"
    )
    generate.add_argument(
        "--element-size",
        type=float,
        default=10.0,
        metavar="MM",
        help="edge length of the elements (default: 10)",
    )
    generate.set_defaults(run=_generate)

    pack = commands.add_parser(
        "pack",
        help="put a folder of simulations into one file",
        description="Make one file of a folder's records.",
    )
    pack.add_argument("folder", type=Path, metavar="DIR", help="folder written by `generate`")
    pack.add_argument("file", type=Path, metavar="FILE", help="file to write; `train --data FILE` reads it")
    pack.set_defaults(run=_pack)
    _add_train(commands)
    export = commands.add_parser(
        "export",
        help="write a run's best weights for the node",
        description="Write a run's best weights in half precision, half the size, for the node's parameter "
        "`checkpoint`.",
    )
    export.add_argument("run_folder", type=Path, metavar="DIR", help="OUT of `train`")
    export.add_argument("file", type=Path, metavar="FILE", help="file to write, ending in .safetensors")
    export.set_defaults(run=_export)
    return parser


def _add_train(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
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
    train.add_argument(
        "--threads", type=_positive, metavar="N", help="processor threads (default: all cores)"
    )
    train.add_argument(
        "--workers",
        type=_positive,
        default=1,
        metavar="N",
        help="processes that voxelise simulations (default: 1)",
    )
    train.add_argument("--bfloat16", action="store_true", help="convolutions in bfloat16")
    train.add_argument("--batch-size", type=_positive, metavar="N", help="samples a step")
    train.add_argument("--learning-rate", type=float, metavar="R", help="highest learning rate")
    train.add_argument(
        "--validate-every", type=float, default=4.0, metavar="MINUTES", help="also saves (default: 4)"
    )
    train.set_defaults(run=_train)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {text}")
    return value


def _generate(options: argparse.Namespace) -> int:
    from softtissue_training.generate import generate

    rejected = generate(
        options.out,
        options.count,
        options.seed,
        law=options.material,
        workers=options.workers,
        edge_length_m=1e-3 * options.element_size,
    )
    print(f"{options.count} simulations in {options.out}")
    for reason, times in sorted(rejected.items()):
        print(f"  {times} draws rejected: {reason}")
    return 0


def _pack(options: argparse.Namespace) -> int:
    from softtissue_training.archive import pack

    print(f"{pack(options.folder, options.file)} simulations in {options.file}")
    return 0


def _export(options: argparse.Namespace) -> int:
    from softtissue_training.export import export
    from softtissue_training.train import WEIGHTS

    provenance = export(options.run_folder / WEIGHTS, options.file)
    print(f"{options.file}: validation error {provenance['validation_error_mm']:.2f} mm")
    return 0


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
