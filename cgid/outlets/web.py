"""One small HTTP server: the metrics of Prometheus, and the live page; or the page as a file."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable, Iterator
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from cgid.errors import CannotCreate
from cgid.outlets.outlet import Address, Service, library
from cgid.outlets.plant import SHUT, Plant

#: What a path returns: a function that makes the bytes, and their type.
Routes = dict[str, tuple[Callable[[], bytes], str]]
#: The page as a file is written this often [s].
_EVERY = 1.0
_HTML = "text/html; charset=utf-8"
#: Nothing is loaded from elsewhere, whatever a name contains.
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'"
_DATA = "/*DATA*/null"


def web_services(
    prometheus: str | None, live: str | None, plant: Plant, warn: Callable[[str], None]
) -> Iterator[Service]:
    """Yield the servers and the file that were asked for; one address may serve both."""
    routes: dict[Address, Routes] = {}
    options: dict[Address, str] = {}
    if prometheus is not None:
        address = Address.of("--prometheus", prometheus)
        own, options[address] = routes.setdefault(address, {}), "--prometheus"
        own["/metrics"] = metrics_of(plant), "text/plain; version=0.0.4; charset=utf-8"
    if live is not None and live.lower().endswith((".html", ".htm")):
        yield PageFile(live, plant, warn)
    elif live is not None:
        address = Address.of("--live", live)
        own, options[address] = routes.setdefault(address, {}), options.get(address, "--live")
        own["/"] = (lambda: page().encode()), _HTML
        own["/state.json"] = (lambda: _json(plant).encode()), "application/json"
    for address, own in routes.items():
        yield WebServer(options[address], address, own, warn)


class WebServer(Service):
    """Serves a few paths by GET."""

    def __init__(self, option: str, address: Address, routes: Routes, warn: Callable[[str], None]) -> None:
        super().__init__(f"{option.removeprefix('--')} {address}", warn)

        class Handler(BaseHTTPRequestHandler):
            timeout = 10
            server_version, sys_version = "cgid", ""

            def do_GET(self) -> None:
                """Answer one request."""
                make, kind = routes.get(self.path.partition("?")[0], (lambda: b"nothing here\n", ""))
                content = make()
                self.send_response(200 if kind else 404)
                self.send_header("Content-Type", kind or "text/plain")
                self.send_header("Content-Length", str(len(content)))
                self.send_header("Content-Security-Policy", _POLICY)
                self.send_header("X-Content-Type-Options", "nosniff")
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, *_: Any) -> None:
                """Be silent."""

        self._server = _Server((address.host, address.port), Handler, bind_and_activate=False)
        self._server.socket.close()
        self._server.socket = address.bound(option)
        self._server.server_address = self._server.socket.getsockname()

    def run(self) -> None:
        """Serve until the end."""
        self._server.serve_forever(poll_interval=0.2)

    def ask_to_end(self) -> None:
        """Close the port."""
        super().ask_to_end()
        if self._thread.ident is not None:
            self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """Ignore readers that go away or send nonsense."""


class PageFile(Service):
    """The page with its data in one file, which reloads itself; replaced as a whole every second."""

    def __init__(self, path: str, plant: Plant, warn: Callable[[str], None]) -> None:
        super().__init__(f"live {path}", warn)
        self._path, self._plant = Path(path), plant
        self._part = self._path.with_name(f".{self._path.name}.part")
        if self._path.exists() and not self._path.is_file():
            raise CannotCreate(f"--live {path}: it must be a file, it is something else; choose another name")
        if self._path.exists() and not self._path.read_bytes()[:200].startswith(page()[:60].encode()):
            raise CannotCreate(f"--live {path}: the file exists already, and is no live page; choose another name")
        try:
            self._write()
        except OSError as error:
            raise CannotCreate(
                f"--live {path}: the page cannot be written ({error.strerror or error}); choose another place"
            ) from None

    def run(self) -> None:
        """Write the page until the end, and once more then."""
        while True:
            with self._changed:
                ending = self._changed.wait_for(lambda: self._ending, _EVERY)
            try:
                self._write()
                self._said = ""
            except OSError as error:
                self.say(f"the page cannot be written ({error.strerror or error}); the answers go on")
            if ending:
                return

    def _write(self) -> None:
        # Text within a script must not end it.
        data = _json(self._plant).replace("<", "\\u003c")
        try:
            self._part.write_text(page().replace(_DATA, data), encoding="utf-8")
            os.replace(self._part, self._path)  # noqa: PTH105 - atomic
        except OSError:
            self._part.unlink(missing_ok=True)
            raise


@cache
def page() -> str:
    """Return the live page, which asks for its data."""
    return (Path(__file__).parent / "live.html").read_text(encoding="utf-8")


def _json(plant: Plant) -> str:
    return json.dumps(plant.page(), allow_nan=False)


def metrics_of(plant: Plant) -> Callable[[], bytes]:
    """Return what makes the text of a scrape; raises `MissingExtra` without prometheus-client."""
    client = library("prometheus_client", "--prometheus", "prometheus-client")
    core = library("prometheus_client.core", "--prometheus", "prometheus-client")
    gauge, counter = core.GaugeMetricFamily, core.CounterMetricFamily

    class Collector:
        def collect(self) -> Iterator[Any]:
            yield from plant.read(lambda supports: list(_families(supports, gauge, counter)))
            yield gauge("cgid_last_block_age_seconds", "Time since the last block of the stream", value=plant.age)
            yield gauge("cgid_behind_seconds", "Delay of the answers behind the stream", value=plant.behind)
            yield counter("cgid_blocks", "Blocks of the stream that were taken", value=plant.beats)
            states = [outlet.status() for outlet in plant.outlets]
            for name, text, family in (
                ("up", "Whether the receiver of an outlet is there", gauge),
                ("passed", "Messages that an outlet has delivered", counter),
                ("dropped", "Messages that an outlet has dropped", counter),
            ):
                found = family(f"cgid_outlet_{name}", text, labels=["outlet"])
                for state in states:
                    found.add_metric([state["name"]], float(state[name]))
                yield found

    registry: Any = client.CollectorRegistry(auto_describe=False)
    registry.register(Collector())
    return lambda: bytes(client.generate_latest(registry))


def _families(supports: dict[str, Any], gauge: Any, counter: Any) -> Iterator[Any]:
    """Yield the metrics of the supports."""
    for name, text, value in (
        ("gangue_share", "Share of gangue in the window", lambda one: one.share),
        ("gangue_share_low", "Lower end of its interval of 95 %", lambda one: one.low),
        ("gangue_share_high", "Upper end of its interval of 95 %", lambda one: one.high),
        ("shut", "1 if the window should be shut", lambda one: float(one.state == SHUT)),
        ("window_impacts", "Identified impacts in the window", lambda one: one.impacts),
        ("window_unknown", "Unknown impacts in the window", lambda one: one.unknown),
    ):
        found = gauge(f"cgid_{name}", text, labels=["channel"])
        for channel, one in supports.items():
            found.add_metric([channel], value(one))
        yield found
    for name, text, label, counts in (
        ("answers", "Answers since the start", "label", "labels"),
        ("turns", "Turns of the decision since the start", "turn", "turns"),
    ):
        found = counter(f"cgid_{name}", text, labels=["channel", label])
        for channel, one in supports.items():
            for key, count in getattr(one, counts).items():
                found.add_metric([channel, key], count)
        yield found
