"""The page's server: at the address that was asked for or nowhere, and for pages of its own alone."""

import http
import socket
from collections.abc import Callable
from functools import wraps
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.viewer.libraries import Headers, Request, Response, viser, websocket_server

LOOPBACK = "127.0.0.1"
_LOCAL_NAMES = {"127.0.0.1", "localhost", "::1"}


class PageServer(viser.ViserServer):  # type: ignore[misc, unused-ignore]
    """A viser server on a socket of our own, which tells no other computer of itself.

    viser itself takes the next port where one is taken.

    Parameters
    ----------
    host : str
        Address to serve at.
    port : int
        0: any free one.

    Raises
    ------
    InvalidInputError
        If there is no such address or the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        listening = listening_socket(host, port)
        serve = websocket_server.serve

        def serve_on_it(handler: Any, _host: str, _port: int, **options: Any) -> Any:
            options["process_request"] = _own_pages_alone(options["process_request"], host)
            return serve(handler, sock=listening, **options)

        try:
            with mock.patch.object(websocket_server, "serve", serve_on_it):
                super().__init__(host=host, port=listening.getsockname()[1], label=None, verbose=False)
        except BaseException:
            listening.close()
            raise

    @property
    def address(self) -> str:
        """What to open in a browser."""
        host = self.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.get_port()}"

    def run_in_pages(self, script: str) -> None:
        """Run JavaScript once in every page that is open or will be."""
        self._websock_server.queue_message(viser._messages.RunJavascriptMessage(source=script))

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Open no tunnel to a server elsewhere, whoever asks for one."""
        return None


def listening_socket(host: str, port: int) -> socket.socket:
    """Bind a socket.

    Raises
    ------
    InvalidInputError
        If there is no such address or the port is taken.
    """
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, kind, protocol)
    except OSError as error:
        raise InvalidInputError(f"host: expected an address of this machine, got {host} ({error})") from None
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(place)
        bound.listen()
    except (OSError, OverflowError) as error:
        bound.close()
        raise InvalidInputError(
            f"port: expected one that is free at {host}, got {port} ({error}); another one: -p port:=8081"
        ) from None
    return bound


def _own_pages_alone(answer: Callable[..., Any], host: str) -> Callable[..., Any]:
    """Let no page of another site, which the same browser may show, press the buttons of this one.

    A browser says in `Origin` which site a page is from, and in `Host` by which name it calls this server: another
    site can give its own name the address of this machine.
    """

    @wraps(answer)
    def checked(connection: Any, request: Request) -> Any:
        if not is_own(request.headers.get("Origin"), request.headers.get("Host", ""), host):
            return Response(http.HTTPStatus.FORBIDDEN, "FORBIDDEN", Headers({"Content-Length": "0"}), b"")
        return answer(connection, request)

    return checked


def is_loopback(host: str) -> bool:
    """Say whether an address is reached from this machine alone.

    Examples
    --------
    >>> is_loopback("localhost"), is_loopback("0.0.0.0")
    (True, False)
    """
    return host in _LOCAL_NAMES


def is_own(origin: str | None, called: str, host: str) -> bool:
    """Say whether a request comes from the page that this server serves.

    Parameters
    ----------
    origin : str or None
        Header `Origin`: which site the page is from that asks; None for the page itself and for other programs.
    called : str
        Header `Host`: the name and port by which this server is called.
    host : str
        Address at which the page is served.

    Examples
    --------
    >>> is_own("http://localhost:8080", "localhost:8080", "127.0.0.1")
    True
    >>> is_own("http://elsewhere.example", "127.0.0.1:8080", "127.0.0.1")
    False
    >>> is_own("http://elsewhere.example:8080", "elsewhere.example:8080", "127.0.0.1")
    False
    """
    try:
        name = urlsplit(f"//{called}").hostname
        site = called if origin is None else urlsplit(origin).netloc
    except ValueError:  # neither is an address
        return False
    return site == called and (not is_loopback(host) or name in _LOCAL_NAMES)
