"""Damaged files that the product itself has written: its cache and weights of networks."""

import json
import random
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from fuzz.damage import damaged_bytes, damaged_tree
from fuzz.kind import Kind, expect
from softtissue_estimator.estimators.paper.checkpoint import (
    load_checkpoint,
    read_provenance,
    save_checkpoint,
)
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.support import cache

_MOST_WEIGHTS = 10_000_000


class CachedFiles(Kind):
    """Cached arrays: whatever is wrong with them, the answer is what is computed."""

    name = "cached files"
    share = 5
    _parameters: Mapping[str, int] = {"spacing": 3}

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._computed = {
            "nodes": np.random.default_rng(0).normal(size=(40, 3)),
            "tets": np.arange(80, dtype=np.int64).reshape(-1, 4) % 40,
        }
        self._folder = cache.cache_folder
        cache.cache_folder = lambda: folder / "cache"
        self._cached()
        (self._file,) = (folder / "cache").glob("*.npz")
        self._template = self._file.read_bytes()

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        return "cached.npz", damaged_bytes(rng, self._template)

    def run(self, name: str, content: bytes) -> str:
        self._file.write_bytes(content)
        found = self._cached()
        for name, array in self._computed.items():
            expect(found[name].dtype == array.dtype and np.array_equal(found[name], array), f"other {name}")
        again = self._file.read_bytes() == self._template
        return "computed anew" if again and content != self._template else "read"

    def check_good(self) -> None:
        expect(self.run("cached.npz", self._template) == "read", "the undamaged file is not read")

    def close(self) -> None:
        cache.cache_folder = self._folder

    def _cached(self) -> dict[str, np.ndarray]:
        return cache.cached_arrays(
            "tetrahedra", "digest", 1, self._parameters, lambda: dict(self._computed), self._fits
        )

    def _fits(self, arrays: Mapping[str, np.ndarray]) -> bool:
        return arrays.keys() == self._computed.keys() and all(
            array.shape == self._computed[name].shape and array.dtype == self._computed[name].dtype
            for name, array in arrays.items()
        )


class Weights(Kind):
    """Checkpoints of the network: their header as bytes and as JSON, their tensors."""

    name = "weights"
    share = 3

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        torch.manual_seed(0)
        spec = NetworkSpec(spacing=0.006, margin_cells=3, architecture=UNetArchitecture(widths=(2, 2, 2, 4)))
        save_checkpoint(folder / "paper.safetensors", UNet(spec.architecture), spec, {"command": "train"})
        self._template = _in_order((folder / "paper.safetensors").read_bytes())

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        name, content = "paper.safetensors", self._template
        if rng.random() < 0.4:
            return name, damaged_bytes(rng, content)
        header, body = _parts(content)
        metadata = header["__metadata__"]
        what = rng.random()
        if what < 0.7:
            spec = damaged_tree(rng, json.loads(metadata["spec"]))
            header = header | {
                "__metadata__": metadata | {"spec": json.dumps(spec, skipkeys=True, default=str)}
            }
        elif what < 0.85:
            header = header | {"__metadata__": damaged_tree(rng, metadata)}
        else:
            header = damaged_tree(rng, header)
        return name, _joined(header, body)

    def run(self, name: str, content: bytes) -> str:
        file = self.folder / name
        file.write_bytes(content)
        read_provenance(file)
        weights = list(load_checkpoint(file).network.state_dict().values())
        expect(sum(w.numel() for w in weights) < _MOST_WEIGHTS, "more weights than the file can hold")
        expect(all(bool(torch.isfinite(w).all()) for w in weights), "weights that are not finite")
        return "read"

    def check_good(self) -> None:
        expect(self.run("paper.safetensors", self._template) == "read", "the undamaged weights are not read")


def _parts(content: bytes) -> tuple[dict, bytes]:
    (length,) = struct.unpack_from("<Q", content)
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def _joined(header: object, body: bytes) -> bytes:
    text = json.dumps(header, skipkeys=True, default=str, sort_keys=False).encode(errors="replace")
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + body


def _in_order(content: bytes) -> bytes:
    """Order what the library writes in any order, so that a seed gives the same bytes every time."""
    header, body = _parts(content)
    metadata = dict(sorted(header.pop("__metadata__").items()))
    return _joined({"__metadata__": metadata, **dict(sorted(header.items()))}, body)
