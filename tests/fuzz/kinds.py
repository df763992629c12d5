"""The kinds of damaged input, and how many inputs of each make a number of them."""

from fuzz.bags import Bags
from fuzz.images import Images
from fuzz.kind import Kind
from fuzz.meshes import LibraryMeshes, Meshes
from fuzz.messages import Messages
from fuzz.over_dds import OverDds
from fuzz.pages import Pages
from fuzz.stores import CachedFiles, Weights
from fuzz.tables import Tables
from fuzz.tetrahedra import Tetrahedra
from fuzz.yaml_files import YamlFiles

KINDS: tuple[type[Kind], ...] = (
    Meshes,
    LibraryMeshes,
    Tetrahedra,
    YamlFiles,
    Tables,
    CachedFiles,
    Weights,
    Bags,
    Messages,
    Images,
    Pages,
    OverDds,
)


def kind_called(name: str) -> type[Kind]:
    """Return the kind of a name, with any signs between its words."""
    return next(kind for kind in KINDS if kind.name.split() == name.replace("_", " ").split())


def inputs_of(kind: type[Kind], count: int) -> int:
    """How many inputs of a kind are among so many damaged files and messages."""
    return max(1, round(count * kind.share / (sum(k.share for k in KINDS) * kind.each)))
