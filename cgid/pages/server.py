"""Threads, addresses and TCP servers, for the outputs of `cgid monitor` and for pages in a browser."""

from __future__ import annotations

import re
import socket
import socketserver
import time
from collections.abc import Callable
from contextlib import suppress
from threading import Condition, Lock, Thread
from typing import Any, NamedTuple

from cgid._lib.spelling import spelled
from cgid.errors import CannotCreate, InvalidValue

#: Maximum number of clients of a server; after one was disconnected, the next is accepted after this time [s], so that
#: predictions keep the processor.
MAX_CLIENTS, _PAUSE_AFTER_EVICTION = 10, 0.01
#: An equal line about an output is repeated after this time [s].
_REPEAT = 3600.0


class Service:
    """A thread that runs until stopped; its errors become warnings and never end the monitor."""

    def __init__(self, name: str, warn: Callable[[str], None]) -> None:
        self.name, self._warn = name, warn
        self._changed = Condition()
        self._ending = False
        self._thread = Thread(target=self._guarded, name=name, daemon=True)
        self._last_message, self._reported_at = "", 0.0

    def run(self) -> None:
        """Work until `_ending`."""
        raise NotImplementedError

    def start(self) -> None:
        """Start the thread, if it has not been."""
        if self._thread.ident is None:
            self._thread.start()

    def request_end(self) -> None:
        """Tell the thread to stop; returns at once."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()

    def wait(self, grace: float) -> None:
        """Wait for the end of the thread, at most for this time [s]."""
        if self._thread.ident is not None:
            self._thread.join(grace)

    def report(self, text: str) -> None:
        """Print a line about this output, unless it is the same as the last one within an hour."""
        if text != self._last_message or since(self._reported_at) > _REPEAT:
            self._last_message, self._reported_at = text, time.monotonic()
            with suppress(OSError, ValueError):  # stderr is gone
                self._warn(f"{self.name}: {text}")

    def _guarded(self) -> None:
        try:
            self.run()
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            self.report(f"this output has ended ({reason}); predictions continue without it")


class Address(NamedTuple):
    """Address of a server."""

    host: str
    port: int

    @classmethod
    def of(cls, setting: str, text: str) -> Address:
        """Return HOST:PORT or :PORT as an address; raises `InvalidValue`."""
        match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.%]+)\]|([^\s:/\[\]]*)):(\d{1,5})", text)
        if match is None or not 1 <= int(match[3]) <= 65535:
            file = ", or a file .html" if setting == "live" else ""
            raise InvalidValue(
                f"{spelled(setting)} must be HOST:PORT with a port from 1 to 65535{file}, such as :8080 (this machine "
                f"alone) or 0.0.0.0:8080 (all of the network), got {text!r}"
            )
        return cls(match[1] or match[2] or "127.0.0.1", int(match[3]))

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    def bound(self, setting: str) -> socket.socket:
        """Return a socket bound to this address; raises `CannotCreate` if impossible."""
        try:
            family = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0][0]
            bound_socket = socket.socket(family, socket.SOCK_STREAM)
            try:
                bound_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                bound_socket.bind(self[:2])
                bound_socket.listen(64)
            except OSError:
                bound_socket.close()
                raise
        except PermissionError:
            raise CannotCreate(
                f"{spelled(setting)} {self}: this user may not listen on a port below 1024; choose a higher one"
            ) from None
        except OSError as error:
            raise CannotCreate(
                f"{spelled(setting)} {self}: the address must be free and of this machine ({error.strerror or error}); "
                "choose another, or stop the program that listens there"
            ) from None
        return bound_socket


class Server(Service):
    """A TCP server with a thread for each of at most `MAX_CLIENTS` clients."""

    # A client without a complete request for `timeout` [s] is disconnected; a new one beyond the maximum replaces the
    # one idle for longest. `handler` reads `self.request`, and may call `self.server.completed(self.request)`.

    def __init__(
        self,
        setting: str,
        address: Address,
        handler: Callable[..., socketserver.BaseRequestHandler],
        timeout: float,
        warn: Callable[[str], None],
    ) -> None:
        super().__init__(f"{setting} {address}", warn)
        self._listener = _Listener(address.bound(setting), handler, timeout, self.report)

    def run(self) -> None:
        """Serve until stopped."""
        self._listener.serve_forever(poll_interval=0.2)

    def request_end(self) -> None:
        """Close the port."""
        super().request_end()
        if self._thread.ident is not None:
            self._listener.shutdown()
        self._listener.server_close()


class _Listener(socketserver.ThreadingTCPServer):
    """Accepts the clients of a `Server`, and disconnects them."""

    def __init__(
        self,
        listening: socket.socket,
        handler: Callable[..., socketserver.BaseRequestHandler],
        timeout: float,
        report: Callable[[str], None],
    ) -> None:
        socketserver.BaseServer.__init__(self, listening.getsockname(), handler)
        self.socket, self._timeout, self._report = listening, timeout, report
        self._is_crowded = False
        self._clients: dict[socket.socket, tuple[Thread, float]] = {}  # with the time of the last complete request
        self._lock = Lock()

    def completed(self, request: socket.socket) -> None:
        """Record that a client has completed a request."""
        with self._lock:
            if request in self._clients:
                self._clients[request] = self._clients[request][0], time.monotonic()

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a client."""
        try:
            return super().get_request()
        except OSError:  # such as no descriptor left: retrying at once would keep the processor busy
            time.sleep(0.1)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start the thread of a client, instead of another one if there are too many."""
        with self._lock:
            oldest = min(self._clients, key=lambda one: self._clients[one][1]) if self._is_full() else None
            before = None if oldest is None else self._clients[oldest][0]
        if oldest is not None and before is not None:
            _disconnect(oldest)
            self._is_crowded = True
            before.join(1.0)
            time.sleep(_PAUSE_AFTER_EVICTION)
        thread = Thread(target=self.process_request_thread, args=(request, client_address), daemon=True)
        with self._lock:
            refused = self._is_full()
            if not refused:
                self._clients[request] = thread, time.monotonic()
        if refused:
            self._is_crowded = True
            self.shutdown_request(request)
        else:
            thread.start()

    def _is_full(self) -> bool:
        return len(self._clients) >= MAX_CLIENTS

    def service_actions(self) -> None:
        """Disconnect clients that complete no request, and report displaced ones; called five times a second."""
        if self._is_crowded:
            self._is_crowded = False
            self._report(
                f"at most {MAX_CLIENTS} clients at a time, a newer one takes the place of another; let some disconnect "
                "after each request, or stop those that are not needed"
            )
        with self._lock:
            late = [one for one, (_, at) in self._clients.items() if time.monotonic() - at > self._timeout]
        for one in late:
            _disconnect(one)

    def shutdown_request(self, request: Any) -> None:
        """Close the connection of a client."""
        with self._lock:
            self._clients.pop(request, None)
        super().shutdown_request(request)

    def server_close(self) -> None:
        """Close the port and disconnect all clients."""
        self.socket.close()
        with self._lock:
            clients = list(self._clients)
        for one in clients:
            _disconnect(one)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that disconnect or send nonsense."""


def _disconnect(client: socket.socket) -> None:
    """Wake the thread of a client, which closes the connection."""
    with suppress(OSError):
        client.shutdown(socket.SHUT_RDWR)


def since(moment: float | None) -> float:
    """Return the time since a moment of the monotonic clock [s]; infinite if there was none."""
    return float("inf") if moment is None else time.monotonic() - moment
