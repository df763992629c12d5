"""Which source files of the estimator a stored result depends on."""

from __future__ import annotations

from pathlib import Path

import softtissue_estimator

_NODE = "ros"


def core_sources() -> list[Path]:
    """List all modules of the estimator's core, in a fixed order; those of its node are not among them."""
    folder = Path(softtissue_estimator.__file__).parent
    return sorted(path for path in folder.rglob("*.py") if path.relative_to(folder).parts[0] != _NODE)
