"""A small HTTP server for the metrics of Prometheus and the live page; or the page as a file."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from http.server import BaseHTTPRequestHandler
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from cgid._lib.files import write_whole
from cgid.errors import CannotCreate
from cgid.identification.prediction.support import Decision, Ground
from cgid.plant.output import Address, Server, Service, library
from cgid.plant.state import PlantState, Record, Support, age

#: Response of a path: a function that returns the bytes, and their type.
Routes = dict[str, tuple[Callable[[], bytes], str]]
#: Interval at which the page is written to a file [s].
_EVERY = 1.0
#: Time for a request and its response [s].
TIMEOUT = 10.0
_HTML = "text/html; charset=utf-8"
#: Nothing is loaded from other sites, whatever a name contains, and no other page may embed this one.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
    "frame-ancestors 'none'"
)
_DATA = "/*DATA*/null"


def web_services(
    prometheus: str | None, live: str | None, plant: PlantState, warn: Callable[[str], None]
) -> Iterator[Service]:
    """Yield the servers and the file that were requested; one address may serve both."""
    routes: dict[Address, Routes] = {}
    options: dict[Address, str] = {}
    if prometheus is not None:
        address = Address.of("--prometheus", prometheus)
        its_routes, options[address] = routes.setdefault(address, {}), "--prometheus"
        its_routes["/metrics"] = metrics_of(plant), "text/plain; version=0.0.4; charset=utf-8"
    if live is not None and live.lower().endswith((".html", ".htm")):
        yield PageFile(live, plant, warn)
    elif live is not None:
        address = Address.of("--live", live)
        its_routes, options[address] = routes.setdefault(address, {}), options.get(address, "--live")
        its_routes["/"] = (lambda: page().encode()), _HTML
        its_routes["/state.json"] = (lambda: _json(plant).encode()), "application/json"
    for address, its_routes in routes.items():
        yield WebServer(options[address], address, its_routes, warn)


class WebServer(Server):
    """Serve a few paths by GET and HEAD; on a loopback address only under loopback names (DNS rebinding)."""

    def __init__(self, option: str, address: Address, routes: Routes, warn: Callable[[str], None]) -> None:
        class PageHandler(BaseHTTPRequestHandler):
            server_version, sys_version = "cgid", ""
            default_request_version = "HTTP/1.0"  # an answer to HTTP/0.9, or to nonsense, would have no headers

            def _answer(self) -> None:
                """Answer one request."""
                make, kind = routes.get(self.path.partition("?")[0], (lambda: b"nothing here\n", ""))
                status = 200 if kind else 404
                listening: Any = self.server.server_address
                names = map(_host, self.headers.get_all("Host", []))
                if _is_loopback(listening[0]) and not all(_is_loopback(name, address.host) for name in names):
                    make, kind, status = (lambda: b"this server answers loopback names only\n"), "", 421
                content = make()
                self.send_response(status)
                self.send_header("Content-Type", kind or "text/plain")
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                if self.command == "GET":
                    self.wfile.write(content)

            def end_headers(self) -> None:
                """Add the headers of every answer, also of errors that `http.server` finds."""
                self.send_header("Content-Security-Policy", _POLICY)
                self.send_header("X-Content-Type-Options", "nosniff")
                self.send_header("Cache-Control", "no-store")
                super().end_headers()

            do_GET = do_HEAD = _answer  # noqa: N815 - names that http.server looks for

            def log_message(self, *_: Any) -> None:
                """Log nothing."""

        super().__init__(option, address, PageHandler, TIMEOUT, warn)


def _host(header: str) -> str:
    """Return the name in a Host header, without its port."""
    match = re.fullmatch(r"\[(.*)\](?::\d*)?|([^:]*)(?::\d*)?", header.strip())
    return (match[1] or match[2] or "") if match else header.strip()


def _is_loopback(name: str, given: str = "localhost") -> bool:
    """Return whether a name or an address is of this machine alone: a loopback one, or the one `given`."""
    with suppress(ValueError):
        return ip_address(name).is_loopback
    return name.lower() in ("localhost", given.lower())


class PageFile(Service):
    """The page with its data in one file, which reloads itself and is replaced every second."""

    def __init__(self, path: str, plant: PlantState, warn: Callable[[str], None]) -> None:
        super().__init__(f"live {path}", warn)
        self._path, self._plant = Path(path), plant
        if self._path.exists() and not self._path.is_file():
            raise CannotCreate(f"--live {path}: it must be a regular file; choose another name")
        if self._path.exists():
            begin = page()[:60].encode()
            with self._path.open("rb") as file:
                if file.read(len(begin)) != begin:
                    raise CannotCreate(
                        f"--live {path}: the file exists already and is not a live page; choose another name"
                    )
        self._write()

    def run(self) -> None:
        """Write the page until stopped, and once more at the end."""
        while True:
            with self._changed:
                ending = self._changed.wait_for(lambda: self._ending, _EVERY)
            try:
                self._write()
                self._last_message = ""
            except OSError as error:
                self.report(f"{error}; predictions continue")
            if ending:
                return

    def _write(self) -> None:
        # Text within a script must not close it.
        data = _json(self._plant).replace("<", "\\u003c")
        write_whole(self._path, page().replace(_DATA, data).encode())


@cache
def page() -> str:
    """Return the live page, which requests its data."""
    return (Path(__file__).parent / "live.html").read_text(encoding="utf-8")


def _json(plant: PlantState) -> str:
    return json.dumps(plant.page(), allow_nan=False)


def metrics_of(plant: PlantState) -> Callable[[], bytes]:
    """Return a function for the text of a scrape; raises `MissingExtra` without prometheus-client."""
    client = library("prometheus_client", "--prometheus", "prometheus-client")
    core = library("prometheus_client.core", "--prometheus", "prometheus-client")
    gauge, counter = core.GaugeMetricFamily, core.CounterMetricFamily

    class Collector:
        def collect(self) -> Iterator[Any]:
            yield from plant.read(lambda supports: list(_families(supports, gauge, counter)))
            yield gauge("cgid_last_block_age_seconds", "Time since the last block of the stream", value=plant.age)
            yield gauge("cgid_behind_seconds", "Delay of the predictions after the stream", value=plant.behind)
            yield counter("cgid_blocks", "Blocks of the stream that were taken", value=plant.beats)
            states = [status for output in plant.outputs for status in output.statuses()]
            for name, text, family in (
                ("up", "Whether the receiver of an output is there", gauge),
                ("passed", "Messages that an output has delivered", counter),
                ("dropped", "Messages that an output has dropped", counter),
            ):
                metric = family(f"cgid_outlet_{name}", text, labels=["outlet"])
                for state in states:
                    metric.add_metric([state["name"]], float(state[name]))
                yield metric

    registry: Any = client.CollectorRegistry(auto_describe=False)
    registry.register(Collector())
    return lambda: bytes(client.generate_latest(registry))


def _families(supports: list[tuple[Support, Record]], gauge: Any, counter: Any) -> Iterator[Any]:
    """Yield the metrics of the supports."""
    shut = {Decision.SHUT: 1.0, Decision.DRAW: 0.0}
    for name, text, value in (
        ("gangue_share", "Gangue fraction in the window", lambda one: one["gangue_share"]),
        ("gangue_share_low", "Lower end of its interval of 95 %", lambda one: one["low"]),
        ("gangue_share_high", "Upper end of its interval of 95 %", lambda one: one["high"]),
        ("shut", "1 to shut the window, 0 to draw, NaN without a decision", lambda one: shut.get(one["decision"])),
        ("window_impacts", "Identified impacts in the window", lambda one: one["impacts"]),
        ("window_unknown", "Unknown impacts in the window", lambda one: one["unknown"]),
        ("ground_age_seconds", "Time since the ground began", lambda one: age(one, one["ground_since_s"])),
        ("last_sound_age_seconds", "Time since the last sound sample", lambda one: age(one, one["last_sound_s"])),
        (
            "last_identified_age_seconds",
            "Time since the last identified impact",
            lambda one: age(one, one["last_identified_s"]),
        ),
    ):
        metric = gauge(f"cgid_{name}", text, labels=["channel"])
        for _, record in supports:
            number = value(record)
            metric.add_metric([record["channel"]], math.nan if number is None else number)
        yield metric
    for name, text, kinds in (
        ("decision", "1 for the present decision", Decision),
        ("ground", "1 for what the decision rests on at present", Ground),
    ):
        metric = gauge(f"cgid_{name}", text, labels=["channel", name])
        for _, record in supports:
            for kind in kinds:
                metric.add_metric([record["channel"], str(kind)], float(record[name] == kind))
        yield metric
    for name, text, label, counts in (
        ("answers", "Predictions since the start", "label", "labels"),
        ("turns", "Switches of the decision since the start", "turn", "turns"),
    ):
        metric = counter(f"cgid_{name}", text, labels=["channel", label])
        for support, record in supports:
            for key, count in getattr(support, counts).items():
                metric.add_metric([record["channel"], key], count)
        yield metric
