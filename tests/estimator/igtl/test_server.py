"""The server: what clients get that are quick, slow, late, or gone."""

import os
import socket
import time
import tracemalloc

import numpy as np
import pytest

from estimator.igtl.reference import receive, split
from softtissue_estimator.errors import InvalidInputError

pytest.importorskip("pyigtl", reason="pyigtl, of the extra `igtl`, is not installed")

import pyigtl

from softtissue_estimator.igtl import server as server_module
from softtissue_estimator.igtl.messages import pack_surface, pack_text, pack_transform
from softtissue_estimator.igtl.server import MOST_CLIENTS, Outgoing, Server

POINTS, FACES = np.zeros((50_000, 3), np.float32), np.zeros((100_000, 3), np.int32)


@pytest.fixture
def server():
    crashes, told = [], []
    made = Server("127.0.0.1", 0, crashes.append, told.append)
    made.told = told
    yield made
    assert made.close(5.0)
    assert crashes == []


def connected(server) -> socket.socket:
    before = server.clients
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=5.0)
    until(lambda: server.clients > before)
    return connection


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.01)


def text(word, stamp=1.0):
    return Outgoing(lambda: pack_text("Status", stamp, word))


def large(stamp):
    return Outgoing(lambda: pack_surface("liver", stamp, POINTS, FACES))


def words(message):
    return split(message)[4][4:].decode()


def test_client_of_pyigtl_hears_words_and_transforms(server):
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
    try:
        until(lambda: server.clients == 1)
        motion = np.eye(4)
        motion[:3, 3] = [0.1, 0.2, 0.3]
        server.send(
            {
                "liver": large(1.0),  # of a type that this client does not know
                "Status": text("all is well"),
                "Pose": Outgoing(lambda: pack_transform("Pose", 7.5, motion, "RAS")),
            }
        )
        assert client.wait_for_message("Status", timeout=10).string == "all is well"
        message = client.wait_for_message("Pose", timeout=10)
        assert message.timestamp == 7.5
        np.testing.assert_allclose(message.matrix[:3, 3], [100.0, 200.0, 300.0], rtol=1e-6)
    finally:
        client.stop()
    until(lambda: server.clients == 0)


def test_slow_client_gets_the_newest_and_holds_nothing(server):
    slow = connected(server)
    tracemalloc.start()
    try:
        for number in range(200):
            server.send({"liver": large(float(number)), "Status": text(str(number))})
            time.sleep(0.002)
        held = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert held < 4 * len(large(0.0).data)
    stamps = []
    while stamps[-1:] != [199.0]:
        kind, _, stamp, *_ = split(receive(slow))
        stamps += [stamp] if kind == "POLYDATA" else []
    assert len(stamps) <= 3  # what was under way, perhaps, and the newest
    slow.close()


def test_quick_client_is_not_held_by_a_slow_one(server):
    slow, quick = connected(server), connected(server)
    server.send({"liver": large(1.0)})
    quick.settimeout(5.0)
    receive(quick)
    for number in range(50):
        server.send({"liver": large(2.0), "Status": text(str(number))})
        heard = [split(receive(quick)) for _ in range(2)]
        assert {kind for kind, *_ in heard} == {"POLYDATA", "STRING"}
    slow.close()
    quick.close()


def test_client_that_takes_nothing_is_let_go(server, monkeypatch):
    monkeypatch.setattr(server_module, "PATIENCE_S", 0.5)
    dead = connected(server)
    while server.clients:
        server.send({"liver": large(1.0)})
        time.sleep(0.05)
    assert any("took nothing for 0.5 s" in words for words in server.told)
    dead.close()


def test_client_that_is_idle_stays(server, monkeypatch):
    monkeypatch.setattr(server_module, "PATIENCE_S", 0.1)
    idle = connected(server)
    time.sleep(1.5)
    server.send({"Status": text("still there")})
    assert words(receive(idle)) == "still there"
    idle.close()


def test_who_comes_late_hears_the_newest_of_each_device_unless_withdrawn(server):
    server.send({"Status": text("old"), "liver": Outgoing(lambda: pack_text("liver", 1.0, "surface"))})
    server.send({"Status": text("new")})
    server.withdraw(["liver", "nobody"])
    late = connected(server)
    assert words(receive(late)) == "new"
    late.settimeout(0.2)
    with pytest.raises(TimeoutError):
        late.recv(1)
    late.close()


def test_withdrawn_surface_does_not_reach_a_slow_client(server):
    slow = connected(server)
    server.send({"liver": large(1.0)})
    time.sleep(0.2)
    server.send({"liver": large(2.0)})
    server.withdraw(["liver"])
    server.send({"Status": text("INVALID: lost")})
    got = [split(receive(slow)) for _ in range(2)]
    assert [(kind, stamp) for kind, _, stamp, *_ in got] == [("POLYDATA", 1.0), ("STRING", 1.0)]
    slow.close()


def test_nothing_is_packed_while_nobody_listens(server):
    packed = []
    server.send({"liver": Outgoing(lambda: packed.append(1) or b"")})
    time.sleep(0.1)
    assert packed == []


def test_client_that_talks_is_not_minded(server):
    loud = connected(server)
    loud.sendall(bytes(200_000))
    server.send({"Status": text("hello")})
    assert words(receive(loud)) == "hello"
    loud.close()


def test_no_more_clients_than_that(server):
    clients = [connected(server) for _ in range(MOST_CLIENTS)]
    another = socket.create_connection(("127.0.0.1", server.port), timeout=5.0)
    assert another.recv(1) == b""
    for client in (*clients, another):
        client.close()
    until(lambda: server.clients == 0)


def test_clients_that_come_and_go_leave_no_descriptors(server):
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(30):
        connected(server).close()
        until(lambda: server.clients == 0)
    assert len(os.listdir("/proc/self/fd")) == before


def test_port_that_is_taken_is_one_sentence(server):
    with pytest.raises(InvalidInputError, match=f"a port that is free, got 127.0.0.1 and {server.port}: "):
        Server("127.0.0.1", server.port, print, print)
    with pytest.raises(InvalidInputError, match="expected an address of this machine"):
        Server("192.0.2.1", 0, print, print)
