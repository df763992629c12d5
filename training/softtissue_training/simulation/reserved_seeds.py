"""Seeds that only the benchmark simulates with, so that no estimator is ever trained on what it is measured on."""

from __future__ import annotations

from softtissue_estimator.errors import InvalidInputError

FIRST_RESERVED_SEED = 1_000_000


def check_not_reserved(seed: int) -> None:
    """Refuse a seed of the benchmark.

    Raises
    ------
    InvalidInputError
        The seed is reserved.
    """
    if seed >= FIRST_RESERVED_SEED:
        raise InvalidInputError(
            f"--seed must be below {FIRST_RESERVED_SEED}, because the seeds from there on are those of the "
            f"benchmark, which nothing may be trained on; got {seed}"
        )
