"""`softtissue-train`, also as `python -m softtissue_training`."""

import sys


def main() -> int:
    """Run the command; 2 if the estimator is not there, as in a checkout whose environment is not set."""
    try:
        from softtissue_training.cli import main as run
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "softtissue_estimator":
            raise
        print(
            "softtissue-train: expected the package softtissue_estimator, got none; in a checkout: scripts/run"
            " softtissue-train ...",
            file=sys.stderr,
        )
        return 2
    return run()


if __name__ == "__main__":
    sys.exit(main())
