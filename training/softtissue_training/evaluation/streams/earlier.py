"""Figures of an earlier run, of an estimator that has changed since, to be shown beside those of a new one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError

FIGURES = ("common_frames", "all_frames", "recovery")
"""Keys of a summary under which figures are kept by estimator."""


def earlier_figures(path: Path, digest: str) -> dict[str, dict[str, Any]]:
    """Read the figures of a summary that `run_streams` wrote, by kind and estimator.

    Parameters
    ----------
    digest
        Of the streams that they must be about.

    Raises
    ------
    InvalidInputError
        The file is no such summary, or about other streams.
    """
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        found, figures = summary["digest"], {name: dict(summary[name]) for name in FIGURES}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(
            f"--beside: expected a real.json of an earlier run, got {path} ({type(error).__name__})"
        ) from error
    if found != digest:
        raise InvalidInputError(
            f"--beside: expected figures of the same streams (digest {digest[:12]}), got {path} of others "
            f"({str(found)[:12]})"
        )
    return figures
