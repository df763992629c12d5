"""Where the files that come with the package lie, installed or in the source tree."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError

PACKAGE = "softtissue_estimator"
DEFAULT_ORGAN = "phantom_liver"


def share_folders() -> Iterator[Path]:
    """Folders that may hold the package's data, best first.

    An ament install keeps the code in `<prefix>/lib/python3.x/site-packages/softtissue_estimator` and the
    data in `<prefix>/share/softtissue_estimator`; in the source tree the data lies beside the code's
    folder, also when the code is reached through a link.
    """
    here = Path(__file__).parent  # this room, in the package's folder
    for package in dict.fromkeys([here.parent, here.resolve().parent]):
        yield package.parent
        for parent in package.parents:
            yield parent / "share" / PACKAGE
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix) / "share" / PACKAGE
    yield Path(sys.prefix) / "share" / PACKAGE


def resource(*parts: str) -> Path:
    """Find a file or folder that comes with the package, for example `resource("organs", "phantom_liver")`.

    Raises
    ------
    InvalidInputError
        If it is not there.
    """
    relative = Path(*parts)
    for folder in share_folders():
        if (folder / relative).exists():
            return folder / relative
    raise InvalidInputError(
        f"bundled {relative}: expected it in share/{PACKAGE} of the installation or beside the source, found none"
    )


def bundled_organ() -> Path:
    """Folder of the organ that is used unless another is named."""
    return resource("organs", DEFAULT_ORGAN)


def bundled_checkpoint() -> Path:
    """Weights of the network that estimator 'paper' uses unless others are named."""
    return resource("weights", "paper.safetensors")


def bundled_bag() -> Path:
    """Bag (folder) that the demo replays."""
    return resource("bags", "phantom")


def bundled_scene() -> Path:
    """Bag (folder) of what a moving stereo laparoscope sees of the bundled organ: bare clouds and tracks."""
    return resource("bags", "laparoscope")


def transport_profile() -> Path:
    """Fast DDS profile that lets whole clouds through."""
    return resource("config", "fastdds_profile.xml")
