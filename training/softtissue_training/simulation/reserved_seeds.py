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
            f"seed of the simulations: expected below {FIRST_RESERVED_SEED}, because those from there on are the "
            f"benchmark's, which nothing may be trained on; got {seed}"
        )
