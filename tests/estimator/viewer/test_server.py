"""Where the page is served, and to whom."""

import socket
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="the packages of requirements-viewer.txt are not installed")

import http.client

import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from estimator.viewer.moments import moment, organ
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.viewer.export import recording_page
from softtissue_estimator.viewer.server import LOOPBACK, PageServer, is_own


@pytest.fixture
def server():
    served = PageServer(LOOPBACK, 0)
    yield served
    served.stop()


def answer(server, **headers):
    connection = http.client.HTTPConnection(LOOPBACK, server.get_port(), timeout=10.0)
    connection.request("GET", "/", headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


def test_page_is_served_at_the_loopback_alone(server, capsys):
    assert server.address == f"http://127.0.0.1:{server.get_port()}"
    assert answer(server) == 200
    port = f":{server.get_port():04X} "
    sockets = Path("/proc/net/tcp").read_text().splitlines()
    listening = [line.split()[1] for line in sockets if port in line and " 0A " in line]
    assert [place.partition(":")[0] for place in listening] == ["0100007F"]
    assert capsys.readouterr().out == ""


def test_pages_of_other_sites_are_refused(server):
    here = f"127.0.0.1:{server.get_port()}"
    assert answer(server, Origin=f"http://{here}") == 200
    assert answer(server, Origin="http://elsewhere.example") == 403
    assert answer(server, Host="elsewhere.example") == 403


def test_page_served_to_a_network_is_called_by_any_name_but_asked_by_itself_alone():
    assert is_own("http://theatre-3:8080", "theatre-3:8080", "0.0.0.0")
    assert not is_own("http://elsewhere.example", "theatre-3:8080", "0.0.0.0")


def drain(client):
    while True:
        client.recv(timeout=10.0)


@pytest.mark.parametrize(("origin", "called"), [("http://[", "127.0.0.1:80"), (None, "["), (None, "")])
def test_headers_that_are_no_addresses_are_refused(origin, called):
    assert not is_own(origin, called, LOOPBACK)


def test_client_that_sends_something_else_ends_its_connection_and_writes_no_log(server, capfd):
    here = f"127.0.0.1:{server.get_port()}"
    with connect(f"ws://{here}", subprotocols=[f"viser-v{viser.__version__}"]) as client:
        client.send(b"nonsense")
        with pytest.raises(ConnectionClosed):
            drain(client)
    assert answer(server) == 200
    assert capfd.readouterr() == ("", "")


def test_no_tunnel_is_opened_to_another_server(server):
    assert server.request_share_url() is None


def test_taken_port_is_one_sentence(server):
    with pytest.raises(
        InvalidInputError, match=rf"port: expected one that is free at 127.0.0.1, got {server.get_port()} "
    ):
        PageServer(LOOPBACK, server.get_port())


@pytest.mark.parametrize("host", ["203.0.113.7", "no.such.host.invalid"])
def test_address_of_another_machine_is_one_sentence(host):
    with pytest.raises(InvalidInputError, match=f"(host|port): expected .*{host}"):
        PageServer(host, 0)


def test_socket_is_free_again_afterwards():
    server = PageServer(LOOPBACK, 0)
    port = server.get_port()
    server.stop()
    with socket.socket() as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind((LOOPBACK, port))


def test_exported_recording_is_a_page_with_all_that_it_needs():
    structures = organ()
    moments = tuple(moment(0.1 * number, shift=0.001 * number) for number in range(5))
    page = recording_page(structures, moments, 0.005)
    assert page.lstrip().lower().startswith("<!doctype html>") and "__VISER_EMBED_DATA__" in page
    longer = recording_page(structures, (*moments, moment(0.6, shift=0.5)), 0.005)
    assert len(longer) > len(page)
