"""A server that many clients may listen to: of each device every client gets the newest message, and no queue grows.

pyigtl's own server serves one client, keeps a hundred messages for one that comes later, and takes the signals of the
process; so sockets are served here, by one thread that never waits for a client.
"""

import contextlib
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property

from softtissue_estimator.errors import InvalidInputError

MOST_CLIENTS = 16
PATIENCE_S = 5.0
"""A client that takes nothing for so long is let go."""
_LOOK_S = 1.0
_KERNEL_BYTES = 1 << 18  # beside this, the kernel would hold seconds of old surfaces for a slow client


class Outgoing:
    """A message that is packed when the first client takes it; nobody who listens costs nothing.

    Parameters
    ----------
    pack : callable
        Returns the whole message.
    """

    def __init__(self, pack: Callable[[], bytes]) -> None:
        self._pack = pack

    @cached_property
    def data(self) -> bytes:
        """The message."""
        return self._pack()


class _Client:
    """What one client still has to get: of each device the newest, and the rest of the message that is under way."""

    def __init__(self, connection: socket.socket, latest: Mapping[str, Outgoing]) -> None:
        self.connection = connection
        self.waiting = dict(latest)
        self.rest = memoryview(b"")
        self.moved_s = time.monotonic()

    @property
    def wants(self) -> bool:
        return bool(self.rest or self.waiting)


class Server:
    """Listens on a port from its beginning to `close`. Methods may be called by any thread, and return at once.

    Parameters
    ----------
    host, port : str, int
        0 for any port that is free.
    on_crash : callable
        Takes what nobody expected; the thread goes on.
    tell : callable
        Takes a sentence when a client comes or goes.

    Raises
    ------
    InvalidInputError
        If the address cannot be listened on.
    """

    def __init__(
        self,
        host: str,
        port: int,
        on_crash: Callable[[BaseException], object],
        tell: Callable[[str], object],
    ) -> None:
        self._on_crash, self._tell = on_crash, tell
        self._lock = threading.Lock()
        self._latest: dict[str, Outgoing] = {}
        self._clients: dict[socket.socket, _Client] = {}
        self._closing = False
        try:
            self._listener = socket.create_server((host, port))
        except (OSError, OverflowError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or str(error)
            raise InvalidInputError(
                f"host, port: expected an address of this machine and a port that is free, got {host} and {port}: {why}"
            ) from error
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._alarm, self._wake = socket.socketpair()
        self._alarm.setblocking(False)
        self._wake.setblocking(False)
        self._selector.register(self._alarm, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="igtl", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return int(self._listener.getsockname()[1])

    @property
    def clients(self) -> int:
        """How many listen."""
        return len(self._clients)

    def send(self, messages: Mapping[str, Outgoing]) -> None:
        """Send the newest messages of some devices; they replace those that are not yet under way."""
        if not messages:
            return
        with self._lock:
            self._latest.update(messages)
            now = time.monotonic()
            for client in self._clients.values():
                if not client.wants:
                    client.moved_s = now
                client.waiting.update(messages)
        self._alert()

    def withdraw(self, devices: Iterable[str]) -> None:
        """Let no client get what is not yet under way of some devices, nor who comes later."""
        with self._lock:
            for device in devices:
                self._latest.pop(device, None)
                for client in self._clients.values():
                    client.waiting.pop(device, None)

    def close(self, timeout_s: float) -> bool:
        """End; return whether the thread ended in time."""
        self._closing = True
        self._alert()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _alert(self) -> None:
        with contextlib.suppress(OSError):  # full means that it is awake already
            self._wake.send(b"x")

    def _run(self) -> None:
        while not self._closing:
            try:
                self._turn()
            except Exception as error:  # the owner of the thread reports it
                self._on_crash(error)
                time.sleep(0.1)
        for client in list(self._clients.values()):
            self._let_go(client, "")
        for one in (self._listener, self._alarm, self._wake):
            one.close()
        self._selector.close()

    def _turn(self) -> None:
        for client in list(self._clients.values()):
            events = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.wants else 0)
            self._selector.modify(client.connection, events, client)
        for key, events in self._selector.select(_LOOK_S):
            if key.fileobj is self._listener:
                self._welcome()
            elif key.fileobj is self._alarm:
                with contextlib.suppress(BlockingIOError):
                    self._alarm.recv(4096)
            else:
                self._serve(key.data, events)
        now = time.monotonic()
        for client in list(self._clients.values()):
            if client.wants and now - client.moved_s > PATIENCE_S:
                self._let_go(client, f", which took nothing for {PATIENCE_S:g} s")

    def _welcome(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            connection, address = self._listener.accept()
            if len(self._clients) >= MOST_CLIENTS:
                connection.close()
                self._tell(f"refused a client: expected at most {MOST_CLIENTS}, got another")
                return
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL_BYTES)
            with self._lock:
                client = self._clients[connection] = _Client(connection, self._latest)
            self._selector.register(connection, selectors.EVENT_READ, client)
            self._tell(f"client {address[0]}:{address[1]} listens")

    def _serve(self, client: _Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ and not client.connection.recv(1 << 16):
                self._let_go(client, ", which closed the connection")  # what a client says is not listened to
                return
            if events & selectors.EVENT_WRITE:
                self._write(client)
        except BlockingIOError:
            pass
        except OSError as error:
            self._let_go(client, f": {error.strerror}")

    def _write(self, client: _Client) -> None:
        if not client.rest:
            with self._lock:
                device = next(iter(client.waiting), None)
                if device is None:
                    return
                message = client.waiting.pop(device)
            client.rest = memoryview(message.data)
        sent = client.connection.send(client.rest)
        client.rest = client.rest[sent:]
        client.moved_s = time.monotonic()

    def _let_go(self, client: _Client, why: str) -> None:
        with self._lock:
            self._clients.pop(client.connection, None)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(client.connection)
        client.connection.close()
        if why:
            self._tell(f"let go of a client{why}")
