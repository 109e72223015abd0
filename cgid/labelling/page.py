"""The page of `cgid label`: its routes, and the threads that read, learn and write behind it."""

from __future__ import annotations

import json
import secrets
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cgid._lib import validation
from cgid.errors import CgidError, InvalidValue, Stopped
from cgid.identification.model.model import StoredModel
from cgid.identification.training.manifest import Manifest, read_manifest
from cgid.labelling.learning import BASE, NEW, Learning, fraction, predictions
from cgid.labelling.recording import LabelledRecording, ListedImpact, read_all
from cgid.labelling.table import Cells, LabelTable, key_of, number_of
from cgid.pages.http import COMMON, HttpServer, PageAnswer, Request, Route, of_file, of_json
from cgid.pages.server import Address

_FOLDER = Path(__file__).parent
#: How an impact came to be labelled; `unsure` was drawn and stays without a label.
CHOICES = ("random", "picked", "stretch", "unsure", "")
#: The table is written so long after a label, and at least as often as this fraction of the time it takes [s].
_WAIT, _LEARN_AFTER = 0.5, 1.0
#: Longest label and name of a person.
_MAX_WORD = 40
#: A table row and an impact are one if their times agree to this [s].
_SAME = 10e-3


class Workbench:
    """Everything behind the page."""

    def __init__(
        self,
        table: LabelTable,
        recordings: Sequence[LabelledRecording],
        base: StoredModel | None,
        *,
        labels: Sequence[str],
        saved_as: Path,
    ) -> None:
        self.table, self.recordings, self._saved_as = table, recordings, saved_as
        self._ended = threading.Event()
        self.learning = Learning(base, self._ended.is_set)
        self._labels = list(dict.fromkeys(labels))
        self._changed = threading.Condition()
        self._rows: dict[int, dict[int, Cells]] = {}
        self._sent: dict[int, dict[int, tuple[int, list[Any]]]] = {}
        self._saved: list[str] = []
        self._lock = threading.Lock()
        self._threads = [
            threading.Thread(target=run, name=run.__name__, daemon=True)
            for run in (self._read, self._learn, self._write)
        ]

    def start(self) -> None:
        """Begin to read, learn and write."""
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        """End all threads and write the table."""
        self._ended.set()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(5.0)
        self.table.close()

    def _read(self) -> None:
        read_all(self.recordings, NEW, self._ended.is_set)
        if not self._ended.is_set():
            with self.table.lock:
                for number in range(len(self.recordings)):
                    self.table.add(self._rows_of(number).values())
            self.table.flush()
            read_all(self.recordings, BASE, self._ended.is_set)  # through a beam, this takes longer

    def _write(self) -> None:
        took = 0.0
        while not self._ended.wait(max(_WAIT, 5 * took)):
            begin = time.monotonic()
            self.table.flush()
            took = time.monotonic() - begin

    def _learn(self) -> None:
        learned = (-1, -1)
        while not self._ended.is_set():
            ready = all(one.ended for one in self.recordings)
            state = self.table.version, sum(len(one.measured) for one in self.recordings)
            if state == learned or not ready:
                self._ended.wait(0.2)
                continue
            self._ended.wait(_LEARN_AFTER)
            learned = self.table.version, state[1]
            try:
                manifest = self._manifest()
                self.learning.learn(self.recordings, manifest)
                self.learning.hear(self.recordings, manifest)
            except Stopped:
                return
            except Exception as error:  # the page goes on without
                self.learning.why = dict.fromkeys((NEW, BASE), " ".join(f"{type(error).__name__}: {error}".split()))
                self.learning.version += 1

    def _manifest(self) -> Manifest | None:
        """Return the labels as `cgid train` would read them from the table."""
        with self.table.lock:
            text = self.table.text()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                return read_manifest(self.table.path, text)
            except CgidError:
                return None

    # -- impacts ------------------------------------------------------------------------------------------

    def _rows_of(self, number: int) -> dict[int, Cells]:
        """Return the row of the table of each impact, its own where the table has none."""
        recording, rows = self.recordings[number], self._rows.setdefault(number, {})
        if len(rows) < len(recording.impacts):
            mine = [
                (at, row)
                for row in self.table.rows.values()
                if recording.has(row) and (at := number_of(row.get("time_s", ""))) is not None
            ]
            mine.sort(key=lambda one: one[0])
            times = np.array([at for at, _ in mine])
            for k in range(len(rows), len(recording.impacts)):
                impact = recording.impacts[k]
                near = int(np.argmin(np.abs(times - impact.time))) if len(times) else -1
                same = near >= 0 and abs(times[near] - impact.time) <= _SAME
                rows[k] = mine[near][1] if same else impact.cells
        return rows

    def _impact(self, request: dict[str, Any]) -> tuple[int, int, ListedImpact]:
        number = _whole(request, "r", len(self.recordings))
        k = _whole(request, "k", len(self.recordings[number].impacts))
        return number, k, self.recordings[number].impacts[k]

    def _stretches(self, number: int) -> list[list[Any]]:
        found = []
        for row in self.table.rows.values():
            if self.recordings[number].has(row) and number_of(row.get("time_s", "")) is None:
                start, end = number_of(row.get("start_s", "")) or 0.0, number_of(row.get("end_s", ""))
                found.append([start, self.recordings[number].duration if end is None else end, row.get("label", "")])
        return found

    def _done(self, number: int) -> int:
        """Return how many impacts of a recording have a label, are in a stretch, or were left as not sure."""
        stretches = self._stretches(number)
        rows = [(self.table.rows.get(key_of(row), row), k) for k, row in self._rows_of(number).items()]
        times = [impact.time for impact in self.recordings[number].impacts]
        return sum(
            bool(row.get("label"))
            or row.get("chosen") == "unsure"
            or any(start <= times[k] < end for start, end, _ in stretches)
            for row, k in rows
        )

    def impacts(self, request: Request) -> PageAnswer:
        """Return the impacts of a recording that have changed since a version."""
        number = _whole(request.query, "r", len(self.recordings))
        since, name = _int(request.query, "since", -1), self.learning.best
        recording, model = self.recordings[number], self.learning.model(self.learning.best)
        with self.table.lock, self._lock:
            rows, sent = self._rows_of(number), self._sent.setdefault(number, {})
            stamp = max((one[0] for one in sent.values()), default=0) + 1
            which = BASE if name == "base" else name
            found, novelty = self._predicted(number, which, self.learning.version, len(recording.impacts) // 50)
            for k, row in rows.items():
                current = self.table.rows.get(key_of(row), row)
                p = found[k] if k < len(found) else None
                content = [
                    *(k, recording.impacts[k].time, recording.impacts[k].channel, recording.impacts[k].peak),
                    *(recording.impacts[k].flags, current.get("label", ""), current.get("by", "")),
                    current.get("chosen", ""),
                    None if p is None else np.round(p, 3).tolist(),
                    None if p is None or not np.isfinite(novelty[k]) else round(float(novelty[k]), 3),
                ]
                if sent.get(k, (0, None))[1] != content:
                    sent[k] = stamp, content
            changed = [content for version, content in sent.values() if version > since]
            latest = max((one[0] for one in sent.values()), default=0)
            labels = [] if model is None else list(model.labels)
            stretches = self._stretches(number)
        return of_json({"version": latest, "impacts": changed, "labels": labels, "stretches": stretches})

    def _predicted(self, number: int, name: str, version: int, size: int) -> tuple[Any, Any]:
        model = self.learning.model(name)
        return ([], []) if model is None else _predictions(self.recordings[number], model, name, version, size)

    def state(self, _: Request) -> PageAnswer:
        """Return what the page shows beside the impacts."""
        with self.table.lock:
            labelled = [row for row in self.table.rows.values() if row.get("label")]
            problem, version = self.table.problem, self.table.version
            unsure = sum(row.get("chosen") == "unsure" for row in self.table.rows.values())
            names = list(dict.fromkeys([*self._labels, *(row["label"] for row in labelled)]))
            done = [self._done(number) for number in range(len(self.recordings))]
        if not problem and self.table.is_open_elsewhere:
            problem = f"{self.table.path.name} is open in a spreadsheet: close it there without saving, or save it now"
        return of_json(
            {
                "recordings": [
                    {
                        "name": one.name,
                        "duration": one.duration,
                        "read": one.n_read / one.rate,
                        "ended": one.ended,
                        "fault": one.fault,
                        "n": len(one.impacts),
                        "done": done[number],
                        "channels": [channel.name for channel in one.file.recording.channels],
                        "unit": one.file.unit,
                        "rate": one.rate,
                    }
                    for number, one in enumerate(self.recordings)
                ],
                "labels": names[:20],
                "table": self.table.path.name,
                "version": version,
                "n_labels": len(labelled),
                "n_unsure": unsure,
                "problem": problem,
                "learning": self.learning.content(),
                "saved": self._saved,
            }
        )

    def view(self, request: Request) -> PageAnswer:
        """Return the waveform of a recording between two times."""
        query = request.query
        number = _whole(query, "r", len(self.recordings))
        start, end = _number(query, "from"), _number(query, "to")
        if not 0 <= start < end:
            raise InvalidValue(f"from and to must rise from 0 s, got {start:g} and {end:g} s")
        return of_json(self.recordings[number].view(start, end, _int(query, "n", 1000)))

    def detail(self, request: Request) -> PageAnswer:
        """Return one impact."""
        number, _, impact = self._impact(request.query)
        return of_json(self.recordings[number].detail(impact))

    def sound(self, request: Request) -> PageAnswer:
        """Return the sound of one impact."""
        number, _, impact = self._impact(request.query)
        return PageAnswer(self.recordings[number].sound(impact), "application/octet-stream")

    def fraction(self, request: Request) -> PageAnswer:
        """Return the gangue fraction of a recording over time."""
        number, name = _whole(request.query, "r", len(self.recordings)), self.learning.best
        model = self.learning.model(name)
        if model is None:
            return of_json({"shares": [], "turns": [], "threshold": None, "why": "no model yet"})
        return of_json(fraction(self.recordings[number], model, BASE if name == "base" else name))

    # -- what the page changes ----------------------------------------------------------------------------

    def label(self, request: Request) -> PageAnswer:
        """Label an impact, or a stretch between two times; on the disk when this returns."""
        body = request.body
        label, by, chosen = (_word(body, name) for name in ("label", "by", "chosen"))
        if label:
            validation.label("label", label)
        if chosen not in CHOICES:
            raise InvalidValue(f"chosen must be one of {', '.join(CHOICES)}, got {chosen!r}")
        if "from" in body:
            number = _whole(body, "r", len(self.recordings))
            start, end = _number(body, "from"), _number(body, "to")
            if not 0 <= start < end <= self.recordings[number].duration + 1:
                raise InvalidValue(f"a stretch must rise within the recording, got {start:g} to {end:g} s")
            row = {**self.recordings[number].cells, "start_s": f"{start:.6f}", "end_s": f"{end:.6f}"}
        else:
            number, k, _ = self._impact(body)
            with self.table.lock:
                row = dict(self._rows_of(number)[k])
        self.table.label(row, label, by, chosen)
        return of_json({"version": self.table.version})

    def save(self, request: Request) -> PageAnswer:
        """Write a model under the name that the command line gave."""
        name = _word(request.body, "which")
        if name == NEW:  # which is not saved without its control
            self.learning.hear(self.recordings, self._manifest(), now=True)
        written = self.learning.save(
            validation.choice("which", name, (NEW, BASE)), self._saved_as, overwrite=bool(self._saved)
        )
        self._saved = [one.name for one in written]
        return of_json({"saved": self._saved})

    def routes(self) -> dict[str, Route]:
        """Return the routes of the page."""
        files = {f"/{name}": of_file(_FOLDER / name) for name in ("label.js", "label.css", "words.json")}
        asked = {"state": self.state, "impacts": self.impacts, "view": self.view, "impact": self.detail}
        asked |= {"sound": self.sound, "fraction": self.fraction}
        posted = {"label": self.label, "save": self.save}
        return {
            **COMMON,
            **files,
            "/": of_file(_FOLDER / "label.html"),
            **{f"/api/{name}": Route(answer, secret=True) for name, answer in asked.items()},
            **{f"/api/{name}": Route(answer, secret=True, posts=True) for name, answer in posted.items()},
        }


def serve(workbench: Workbench, address: Address, warn: Callable[[str], None]) -> tuple[HttpServer, str]:
    """Return the started server of a page, and the address with its key."""
    key = secrets.token_urlsafe(24)
    server = HttpServer("port", address, workbench.routes(), warn, key)
    server.start()
    return server, f"http://{Address(address.host, server.port)}/#{key}"


_KEPT: dict[int, tuple[Any, Any]] = {}


def _predictions(
    recording: LabelledRecording, model: StoredModel, name: str, version: int, size: int
) -> tuple[Any, Any]:
    """Return the predictions of a recording, computed again for other models and some impacts more."""
    key = (id(model), name, version, size, recording.ended)
    kept = _KEPT.get(id(recording))
    if kept is None or kept[0] != key:
        kept = _KEPT[id(recording)] = key, predictions(recording, model, name)
    return kept[1]


@cache
def words() -> dict[str, dict[str, str]]:
    """Return the words of the page by language."""
    found: dict[str, dict[str, str]] = json.loads((_FOLDER / "words.json").read_text(encoding="utf-8"))
    return found


def _word(body: dict[str, Any], name: str) -> str:
    value = body.get(name, "")
    if not isinstance(value, str) or len(value) > _MAX_WORD or not value.isprintable():
        raise InvalidValue(f"{name} must be text of at most {_MAX_WORD} characters")
    return value.strip()


def _number(values: dict[str, Any], name: str) -> float:
    value = values.get(name)
    try:
        number = float(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else np.nan
    except (ValueError, OverflowError):
        number = np.nan
    if not np.isfinite(number):
        raise InvalidValue(f"{name} must be a number")
    return float(number)


def _int(values: dict[str, Any], name: str, default: int) -> int:
    return default if name not in values else int(_number(values, name))


def _whole(values: dict[str, Any], name: str, n: int) -> int:
    number = _number(values, name)
    if number != int(number) or not 0 <= number < n:
        raise InvalidValue(f"{name} must be a whole number below {n}, got {number:g}")
    return int(number)
