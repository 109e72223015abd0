"""The metrics of Prometheus and the live page, served or as a file."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from cgid._lib.files import write_whole
from cgid._lib.spelling import spelled
from cgid.errors import CannotCreate
from cgid.identification.prediction.support import Decision, Ground
from cgid.pages.http import COMMON, JSON, HttpServer, Route, of_bytes, of_file
from cgid.pages.server import Address, Service
from cgid.plant.output import library
from cgid.plant.state import PlantState, Record, Support, age

#: Interval at which the page is written to a file [s].
_EVERY = 1.0
_FOLDER = Path(__file__).parent
_DATA = "/*DATA*/null"


def web_services(
    prometheus: str | None, live: str | None, plant: PlantState, warn: Callable[[str], None]
) -> Iterator[Service]:
    """Yield the servers and the file that were requested; one address may serve both."""
    routes: dict[Address, dict[str, Route]] = {}
    settings: dict[Address, str] = {}
    if prometheus is not None:
        address = Address.of("prometheus", prometheus)
        its_routes, settings[address] = routes.setdefault(address, {}), "prometheus"
        its_routes["/metrics"] = of_bytes(metrics_of(plant), "text/plain; version=0.0.4; charset=utf-8")
    if live is not None and live.lower().endswith((".html", ".htm")):
        yield PageFile(live, plant, warn)
    elif live is not None:
        address = Address.of("live", live)
        its_routes, settings[address] = routes.setdefault(address, {}), settings.get(address, "live")
        its_routes |= {**COMMON, "/": of_file(_FOLDER / "live.html")}
        its_routes |= {f"/{name}": of_file(_FOLDER / name) for name in ("live.css", "live.js")}
        its_routes["/state.json"] = of_bytes(lambda: _json(plant).encode(), JSON)
    for address, its_routes in routes.items():
        yield HttpServer(settings[address], address, its_routes, warn)


class PageFile(Service):
    """The page with its data in one file, which reloads itself and is replaced every second."""

    def __init__(self, path: str, plant: PlantState, warn: Callable[[str], None]) -> None:
        super().__init__(f"live {path}", warn)
        self._path, self._plant = Path(path), plant
        if self._path.exists() and not self._path.is_file():
            raise CannotCreate(f"{spelled('live')} {path}: it must be a regular file; choose another name")
        if self._path.exists():
            begin = page()[:60].encode()
            with self._path.open("rb") as file:
                if file.read(len(begin)) != begin:
                    raise CannotCreate(
                        f"{spelled('live')} {path}: the file exists already and is not a live page; choose another name"
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
    """Return the live page as one file that loads no other."""
    text, common = (_FOLDER / "live.html").read_text(encoding="utf-8"), _FOLDER.parent / "pages"
    for name in ("common.css", "live.css", "common.js", "live.js"):
        content = ((common if name.startswith("common") else _FOLDER) / name).read_text(encoding="utf-8")
        if name.endswith(".css"):
            text = text.replace(f'<link rel="stylesheet" href="{name}">', f"<style>\n{content}</style>")
        else:
            text = text.replace(f'<script src="{name}"></script>', f"<script>\n{content}</script>")
    return text


def _json(plant: PlantState) -> str:
    return json.dumps(plant.page(), allow_nan=False)


def metrics_of(plant: PlantState) -> Callable[[], bytes]:
    """Return a function for the text of a scrape; raises `MissingExtra` without prometheus-client."""
    what = spelled("prometheus")
    client = library("prometheus_client", what, "prometheus-client")
    core = library("prometheus_client.core", what, "prometheus-client")
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
        ("last_sound_age_seconds", "Time since the last valid sample", lambda one: age(one, one["last_sound_s"])),
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
    metric = gauge("cgid_finding", "1 for what stands of a support", labels=["channel", "finding"])
    for support, record in supports:
        for found in support.findings:
            metric.add_metric([record["channel"], found], 1.0)
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
