"""Bags that cannot be read are one sentence, wherever they are damaged."""

import contextlib
import re
import shutil
import sqlite3

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.tools.bag import Bag, message_type
from softtissue_estimator.support.resources import resource


@pytest.fixture
def bag(tmp_path):
    shutil.copytree(resource("bags", "phantom"), tmp_path / "bag")
    return tmp_path / "bag"


def read(path):
    """Number of messages."""
    with Bag(path) as opened:
        return sum(len(data) > 0 for _, _, data in opened.messages())


def refused(path):
    with pytest.raises(InvalidInputError, match="^bag .*: expected") as caught:
        read(path)
    assert str(caught.value).isprintable() and len(str(caught.value)) <= 300


def test_whole_bag_is_read(bag):
    assert read(bag) > 100


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.3, 0.999])
def test_bag_that_is_cut_off_is_a_sentence(bag, share):
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    refused(bag)
    refused(file)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "secret",
        "[1, 2",
        "rosbag2_bagfile_information: 5",
        "rosbag2_bagfile_information: {version: x}",
        "\0",
    ],
)
def test_metadata_that_cannot_be_meant_are_a_sentence(bag, text):
    (bag / "metadata.yaml").write_text(text)
    refused(bag)


@pytest.mark.parametrize("value", [".inf", "1e400", "-5", "1.5", "99999999999999999999999999", "[1]", "~"])
@pytest.mark.parametrize("key", ["nanoseconds_since_epoch", "nanoseconds", "message_count"])
def test_numbers_of_metadata_that_are_none_are_a_sentence(bag, key, value):
    file = bag / "metadata.yaml"
    text, replaced = re.subn(rf"(?<={key}: )\d+", value, file.read_text())
    assert replaced >= 1
    file.write_text(text)
    refused(bag)


@pytest.mark.parametrize("time", [-1, -(2**63)])
def test_times_before_zero_are_a_sentence(tmp_path, time):
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "std_msgs/msg/Empty"
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/empty", kind, typestore=store)
        writer.write(connection, 7, store.serialize_cdr(store.types[kind](), kind))
    (file,) = (tmp_path / "bag").glob("*.db3")
    assert read(file) == 1
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.execute("update messages set timestamp = ?", (time,))
        database.commit()
    refused(file)


@pytest.mark.parametrize("name", ["file.db3", "file.mcap", "file.txt", "folder"])
def test_what_is_no_bag_is_a_sentence(tmp_path, name):
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    else:
        path.write_bytes(b"no bag" * 100)
    refused(path)


@pytest.mark.timeout(300)
def test_noise_in_a_bag_is_read_or_a_sentence(bag):
    (file,) = bag.glob("*.mcap")
    whole = np.frombuffer(file.read_bytes(), dtype=np.uint8)
    rng = np.random.default_rng(0)
    for _ in range(20):
        data = whole.copy()
        begin = int(
            rng.choice([rng.integers(len(data)), rng.integers(2000), len(data) - 1 - rng.integers(20000)])
        )
        data[begin : begin + 8] = rng.integers(256, size=len(data[begin : begin + 8]))
        file.write_bytes(data.tobytes())
        with contextlib.suppress(InvalidInputError):
            read(bag)


@pytest.mark.parametrize(
    "name",
    ["", "std_msgs", "std_msgs/msg/", "std_msgs/msg/Nobody", "../x/msg/Y", "a b/msg/C\n", "x" * 999],
)
def test_type_that_is_not_installed_is_a_sentence(name):
    with pytest.raises(InvalidInputError, match="expected an installed message type, got") as caught:
        message_type(name)
    assert len(str(caught.value)) < 200
