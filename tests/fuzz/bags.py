"""Damaged bags: MCAP and sqlite3, alone and as a folder, with metadata.yaml or without it."""

import random
import shutil
from pathlib import Path

import numpy as np

from fuzz.damage import damaged_bytes, damaged_text
from fuzz.kind import Kind, MissingError, expect

try:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from softtissue_estimator.ros.tools.bag import Bag, begins_with_header, qos_of
except ImportError as error:
    MISSING = str(error)
else:
    MISSING = ""

_MESSAGES = 20
_MOST_MESSAGE_BYTES = 1 << 24
_UNFINISHED, _UNFINISHED_SHARE = "unfinished-", 0.4


class Bags(Kind):
    """What `replay`, `score` and the demo open, and what they ask of a bag."""

    name = "bags"
    share = 4

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        if MISSING:
            raise MissingError(MISSING)
        self._templates: dict[str, bytes] = {}
        for kind, plugin in (("mcap", StoragePlugin.MCAP), ("db3", StoragePlugin.SQLITE3)):
            _write_bag(folder / kind, plugin)
            (data,) = (folder / kind).glob(f"*.{kind}")
            data = data.rename(folder / kind / f"{kind}.{kind}")
            self._templates[f"{kind}/{data.name}"] = data.read_bytes()
            self._templates[f"{kind}/metadata.yaml"] = (folder / kind / "metadata.yaml").read_bytes()
        self.check_good()

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        name = rng.choice([*sorted(self._templates), "mcap/mcap.mcap", "db3/db3.db3"])
        if name.endswith("mcap") and rng.random() < _UNFINISHED_SHARE:
            # As a killed recorder leaves it, and damaged or not.
            content = self._templates[name]
            content = damaged_bytes(rng, content) if rng.random() < 0.5 else content
            return _UNFINISHED + name.replace("/", "+"), content[: rng.randrange(len(content) + 1)]
        damaged = damaged_text if name.endswith("yaml") and rng.random() < 0.8 else damaged_bytes
        alone = "alone-" if rng.random() < 0.5 and not name.endswith("yaml") else ""
        return alone + name.replace("/", "+"), damaged(rng, self._templates[name])

    def run(self, name: str, content: bytes) -> str:
        folder, _, file = name.removeprefix("alone-").removeprefix(_UNFINISHED).partition("+")
        place = self.folder / folder / file
        place.write_bytes(content)
        if name.startswith(_UNFINISHED):
            (place.parent / "metadata.yaml").unlink()
        try:
            self._read(place if name.startswith("alone-") else place.parent)
        finally:
            place.write_bytes(self._templates[f"{folder}/{file}"])
            if name.startswith(_UNFINISHED):
                (place.parent / "metadata.yaml").write_bytes(self._templates[f"{folder}/metadata.yaml"])
            for beside in place.parent.glob(f"{file}-*"):  # of sqlite3
                beside.unlink()
        return "read"

    def check_good(self) -> None:
        for kind in ("mcap", "db3"):
            for path in (self.folder / kind, self.folder / kind / f"{kind}.{kind}"):
                expect(self._read(path) == _MESSAGES, f"other messages in the undamaged {path.name}")

    def close(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    @staticmethod
    def _read(path: Path) -> int:
        count = 0
        with Bag(path) as bag:
            for connection in bag.connections:
                qos_of(connection, 10)
                begins_with_header(bag.kind_of(connection))
            expect(
                bag.message_count > 0 and bag.duration_ns >= 0 and bag.start_ns >= 0,
                "negative times or counts",
            )
            for _connection, recorded_ns, data in bag.messages():
                expect(recorded_ns >= 0 and len(data) < _MOST_MESSAGE_BYTES, "a message that cannot be one")
                count += 1
        return count


def _write_bag(folder: Path, plugin: "StoragePlugin") -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    point, kind = store.types["geometry_msgs/msg/Point"], "geometry_msgs/msg/PointStamped"
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/points", kind, typestore=store)
        values = np.random.default_rng(0).normal(size=(_MESSAGES, 3))
        for i, (x, y, z) in enumerate(values):
            message = store.types[kind](header(time(i, 0), "organ"), point(x, y, z))
            writer.write(connection, 10**9 * (i + 1), store.serialize_cdr(message, kind))
