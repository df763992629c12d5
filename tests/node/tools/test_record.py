"""Bags that are recorded: their definitions, their quality of service, and disks that take no more."""

import contextlib
import resource
import shutil
import signal

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from node.tools.answered_bag import status
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.tools.bag import Bag, qos_of
from softtissue_estimator.ros.tools.record import bag_file
from softtissue_estimator.ros.tools.record.bag_file import BagFile
from softtissue_estimator.ros.tools.record.definitions import definition_of
from softtissue_estimator.ros.tools.record.recorder import accepting

STATUS = "softtissue_msgs/msg/EstimatorStatus"
RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
KEPT, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE


def offer(reliability=RELIABLE, durability=VOLATILE):
    return QoSProfile(depth=1, reliability=reliability, durability=durability)


OFFER = offer()


def record(folder, count=3, offers=(OFFER,)):
    """Record as many messages; return their bytes."""
    sent = [serialize_message(status(number)) for number in range(count)]
    with BagFile(folder) as bag:
        connection = bag.connect("/status", STATUS, offers)
        for number, data in enumerate(sent):
            bag.write(connection, 1000 + number, data)
    return sent


def test_what_was_recorded_is_read_again(tmp_path):
    sent = record(tmp_path / "above" / "bag")
    with Bag(tmp_path / "above" / "bag") as bag:
        (connection,) = bag.connections
        assert bag.kind_of(connection).__name__ == "EstimatorStatus"
        told = [(c.topic, time_ns, data) for c, time_ns, data in bag.messages()]
    assert told == [("/status", 1000 + number, data) for number, data in enumerate(sent)]


@pytest.mark.parametrize(
    "name", [STATUS, "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseWithCovarianceStamped"]
)
def test_definition_is_whole_and_has_the_hash_of_its_text(name):
    text, known = definition_of(name)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    assert store.hash_rihs01(name) == known


def test_type_that_is_not_installed_is_a_sentence():
    with pytest.raises(InvalidInputError, match="expected an installed message type"):
        definition_of("nobody_msgs/msg/Nothing")


def test_quality_of_service_is_kept_for_whoever_plays_the_bag(tmp_path):
    for number, one in enumerate([offer(), offer(durability=KEPT), offer(BEST_EFFORT)]):
        record(tmp_path / str(number), offers=[one])
        with Bag(tmp_path / str(number)) as bag:
            played = qos_of(bag.connections[0], 1)
        assert (played.reliability, played.durability) == (one.reliability, one.durability)


def test_offers_of_several_publishers_are_recorded_once_each(tmp_path):
    record(tmp_path / "bag", offers=[offer(), offer(BEST_EFFORT), offer()])
    with Bag(tmp_path / "bag") as bag:
        profiles = bag.connections[0].ext.offered_qos_profiles
    assert [(p.reliability, p.durability) for p in profiles] == [
        (QosReliability.RELIABLE, QosDurability.VOLATILE),
        (QosReliability.BEST_EFFORT, QosDurability.VOLATILE),
    ]


@pytest.mark.parametrize(
    ("offers", "expected"),
    [
        ([offer()], (RELIABLE, VOLATILE)),
        ([offer(durability=KEPT)], (RELIABLE, KEPT)),
        ([offer(), offer(durability=KEPT)], (RELIABLE, VOLATILE)),
        ([offer(), offer(BEST_EFFORT)], (BEST_EFFORT, VOLATILE)),
    ],
)
def test_subscription_asks_for_what_every_publisher_offers(offers, expected):
    wanted = accepting(offers)
    assert (wanted.reliability, wanted.durability) == expected
    assert accepting([*offers, wanted]) == wanted


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_bag_that_exists_is_a_sentence_and_stays(tmp_path, kind):
    place = tmp_path / "bag"
    place.mkdir() if kind == "folder" else place.write_text("kept")
    with pytest.raises(InvalidInputError, match="expected a new folder, got one that exists"):
        BagFile(place)
    assert place.exists()


def test_place_that_cannot_be_written_is_a_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match="expected a disk that can be written, got: Not a directory"):
        BagFile(tmp_path / "file" / "bag")


def test_bag_without_messages_is_removed(tmp_path):
    with BagFile(tmp_path / "bag") as bag:
        bag.connect("/status", STATUS, [offer()])
    assert not (tmp_path / "bag").exists()


def test_recording_ends_while_there_is_room_for_its_index(tmp_path, monkeypatch):
    free = [bag_file.SPARE_BYTES + 1, bag_file.SPARE_BYTES - 1]
    used = shutil._ntuple_diskusage(1, 1, 0)
    monkeypatch.setattr(bag_file.shutil, "disk_usage", lambda _folder: used._replace(free=free.pop(0)))

    def filled():
        with BagFile(tmp_path / "bag") as bag:
            bag.write(bag.connect("/status", STATUS, [offer()]), 1000, serialize_message(status(0)))
            bag.check_space()
            bag.check_space()

    with pytest.raises(InvalidInputError, match="expected 64 MiB of free disk, got 63; what was recorded"):
        filled()
    with Bag(tmp_path / "bag") as bag:
        assert bag.message_count == 1


def test_disk_that_takes_no_more_is_a_sentence(tmp_path):
    old, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, old[1]))
        with pytest.raises(
            InvalidInputError, match="expected a disk that can be written, got: File too large"
        ):
            record(tmp_path / "bag", count=3000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
        signal.signal(signal.SIGXFSZ, handler)


def cut_off(folder, seconds=(1, 2, 3), unordered=False):
    """Record a message every second, each flushed, and leave the bag as a killed process does; return its file."""
    bag = BagFile(folder)
    connection = bag.connect("/status", STATUS, (OFFER,))
    for number in seconds:
        bag.write(
            connection, (10 - number if unordered else number) * 10**9, serialize_message(status(number))
        )
        bag.flush()
    bag.write(connection, 20 * 10**9, serialize_message(status(20)))  # never flushed
    bag._writer.abort()
    (file,) = folder.glob("*.mcap")
    return file, file.read_bytes()


def told(path):
    with Bag(path) as bag:
        assert bag.cut_off
        (connection,) = bag.connections
        assert bag.kind_of(connection).__name__ == "EstimatorStatus"
        found = [(time_ns // 10**9, data) for _, time_ns, data in bag.messages(bag.connections)]
        assert bag.message_count == connection.msgcount == len(found)
        assert bag.start_ns == 10**9 * found[0][0]
    return found


def test_recording_that_was_cut_off_is_read_up_to_its_last_flush(tmp_path):
    file, before = cut_off(tmp_path / "bag")
    expected = [(number, serialize_message(status(number))) for number in (1, 2, 3)]
    assert told(tmp_path / "bag") == expected
    assert list((tmp_path / "bag").iterdir()) == [file] and file.read_bytes() == before


def test_file_that_was_whole_once_is_damaged_without_its_end(tmp_path):
    file, _ = cut_off(tmp_path / "bag")
    for path in (file, file.rename(tmp_path / "other.mcap")):
        with pytest.raises(InvalidInputError, match="expected"):
            Bag(path)
    record(tmp_path / "whole")
    (file,) = (tmp_path / "whole").glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(InvalidInputError, match="expected MCAP or sqlite3 that can be read"):
        Bag(tmp_path / "whole")


def test_recording_that_was_cut_off_anywhere_is_read_up_to_there(tmp_path):
    file, data = cut_off(tmp_path / "bag")
    counts = []
    for length in sorted({*range(0, len(data), len(data) // 80), *range(len(data) - 30, len(data) + 1)}):
        file.write_bytes(data[:length])
        found = []
        with contextlib.suppress(InvalidInputError):  # nothing is there yet
            found = told(tmp_path / "bag")
        assert [number for number, _ in found] == list(range(1, len(found) + 1))
        counts.append(len(found))
    assert counts == sorted(counts) and set(counts) == {0, 1, 2, 3}


def test_messages_of_a_recording_that_was_cut_off_come_in_order_of_time(tmp_path):
    cut_off(tmp_path / "bag", unordered=True)
    assert [number for number, _ in told(tmp_path / "bag")] == [7, 8, 9]


def test_recording_that_was_cut_off_before_its_last_file_is_whole(tmp_path):
    sent = record(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    with Bag(tmp_path / "bag") as bag:
        assert bag.cut_off and [data for _, _, data in bag.messages()] == sent


def test_whole_recording_is_not_cut_off(tmp_path):
    record(tmp_path / "bag")
    (file,) = (tmp_path / "bag").glob("*.mcap")
    for path in (tmp_path / "bag", file):
        with Bag(path) as bag:
            assert not bag.cut_off


def test_flushed_recording_ends_as_any_other(tmp_path):
    with BagFile(tmp_path / "bag") as bag:
        bag.flush()
        connection = bag.connect("/status", STATUS, (OFFER,))
        for number in range(4):
            bag.flush()
            bag.write(connection, 1000 + number, serialize_message(status(number)))
    bag.flush()
    with Bag(tmp_path / "bag") as bag:
        assert [time_ns for _, time_ns, _ in bag.messages()] == [1000, 1001, 1002, 1003]
