"""Judge predictions by the truth, with intervals, and keep the results of all entries in one table.

Definitions of the metrics: benchmarks/open/README.md.
"""

from __future__ import annotations

import csv
import datetime
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from benchmarks.open.real import ANSWER_COLUMNS, PUBLIC_TRUTH, TRACKS, Truths, read_answers
from benchmarks.open.sets import COAL, COLUMNS, GANGUE, LARGEST, LIMIT, OTHER, all_sets, unchanged_digest, write_rows
from cgid._lib.files import read_cells, read_regular
from cgid._lib.validation import suggestion
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.identification.model.confusion import wilson_interval
from cgid.identification.training.card import plain, table
from cgid.store.folder import sha256_of

Floats = NDArray[np.float64]
#: Columns of predictions of frames and of streams; the last of each may be left out.
FRAME_COLUMNS, STREAM_COLUMNS = ("set", "id", COAL, GANGUE, "unknown"), ("set", "id", "time", "share", "shut")
#: Windows of streams: their length and step, and the end of a stream [s].
WINDOW, STEP, DURATION = 10, 1, 60
TIMES = np.arange(WINDOW, DURATION + STEP, STEP)
#: Probabilities may miss a sum of 1 by this much: four digits are enough.
ROUNDING = 1e-3
#: Bins of the calibration error, and resamplings of its interval.
BINS, RESAMPLINGS = 10, 1000
#: Columns of the results.
RESULT_COLUMNS = ("entry", "date", "version", "link", "set", "metric", "value", "low", "high", "n", "truth")
#: Metrics of the time to shut.
_TIMING = ("cost of the wrong time", "gangue let through", "coal lost", "delay")
_NAME = re.compile(r"[\w .,:+()/-]{1,60}")
_LINK, _VERSION = re.compile(r"https://[!-~]{1,200}"), re.compile(r"[\w .+-]{1,40}")


class Stream(NamedTuple):
    """The truth of a stream: times of its rocks [s], whether each is gangue, when the share passes one half [s]."""

    time: Floats
    gangue: NDArray[np.bool_]
    crossing: float

    def shares(self) -> Floats:
        """Return the share of gangue among the rocks that came in each window, nan without any, (n_windows,)."""
        inside = (self.time > TIMES[:, None] - WINDOW) & (self.time <= TIMES[:, None])
        with np.errstate(invalid="ignore"):
            return np.asarray((inside & self.gangue).sum(axis=1) / inside.sum(axis=1))

    def drawn(self, start: float, stop: float) -> tuple[int, int]:
        """Return how many rocks of coal and of gangue came in an interval."""
        inside = (self.time > start) & (self.time <= stop)
        return int(np.sum(inside & ~self.gangue)), int(np.sum(inside & self.gangue))


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Labels of frames and rocks of streams, by set; `digest` tells one truth from another."""

    frames: Mapping[str, NDArray[np.str_]]
    streams: Mapping[str, Sequence[Stream]]
    digest: str

    @classmethod
    def read(cls, folder: Path) -> Truth:
        """Read the folder `truth`, or of the training parts `signals`; raises `NoInput`, or `BadData` if changed."""
        digest = unchanged_digest(folder)
        labels, impacts, crossings = (_table(folder / name) for name in COLUMNS)
        rocks = impacts[impacts[:, 3] == "0"]
        frames = {str(name): labels[labels[:, 0] == name, 2] for name in np.unique(labels[:, 0])}
        streams: dict[str, list[Stream]] = {}
        for name, number, crossing in crossings.tolist():
            own = rocks[(rocks[:, 0] == name) & (rocks[:, 1] == number)]
            one = Stream(own[:, 2].astype(float), own[:, 4] == GANGUE, float(crossing or "nan"))
            streams.setdefault(name, []).append(one)
        return cls(frames=frames, streams=streams, digest=digest)


def _table(path: Path) -> NDArray[np.str_]:
    cells = np.array([cells for _, cells in read_cells(path, "truth", LARGEST)])
    return cells[1:]


# -- predictions -----------------------------------------------------------------------------------------------------


class Frames(NamedTuple):
    """Predictions of the frames of a set, each (n_frames,)."""

    gangue: Floats
    unknown: NDArray[np.bool_]


class Streams(NamedTuple):
    """Predictions of the streams of a set, each (n_streams, n_windows)."""

    share: Floats
    shut: NDArray[np.bool_]


Predictions = dict[str, Frames | Streams]


def read_predictions(path: Path, truth: Truth) -> Predictions:
    """Return the predictions of a file by set.

    Raises `NoInput`, or `BadData` with the line, the rule, the value and the cure.
    """
    lines = _lines(path)
    if not lines:
        raise BadData(f"{path}: must have a header and rows, is empty; write the columns {', '.join(FRAME_COLUMNS)}")
    header = tuple(lines[0][1])
    if header in (FRAME_COLUMNS, FRAME_COLUMNS[:-1]):
        sets, read = {name: len(own) for name, own in truth.frames.items()}, _frames_of
    elif header in (STREAM_COLUMNS, STREAM_COLUMNS[:-1]):
        sets, read = {name: len(own) for name, own in truth.streams.items()}, _streams_of
    else:
        raise BadData(
            f"{path}: the header must be {','.join(FRAME_COLUMNS)} for frames or {','.join(STREAM_COLUMNS)} for "
            f"streams, perhaps without the last column, got {_short(','.join(header))}; there are no other labels"
        )
    found: dict[str, dict[Any, list[float]]] = {}
    first: dict[Any, int] = {}
    for number, cells in lines[1:]:
        place = f"{path}, line {number}"
        if len(cells) != len(header):
            raise BadData(f"{place}: must have {len(header)} cells as the header has, got {len(cells)}; complete it")
        name = _known_set(place, cells[0], sets, truth)
        key, values = read(place, cells[1:], sets[name])
        if (earlier := first.setdefault((name, key), number)) != number:
            raise BadData(f"{place}: {_row(name, key)} must be given once, is also in line {earlier}; take one out")
        found.setdefault(name, {})[key] = values
    if not found:
        raise BadData(f"{path}: must have rows below its header, has none; predict at least one set")
    return {name: _complete(path, name, rows, sets[name], header) for name, rows in found.items()}


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    try:
        return read_cells(path, "predictions", LARGEST)
    except csv.Error as error:
        raise BadData(f"{path}: predictions must be comma-separated values ({error}); save them as CSV") from None


def _known_set(place: str, name: str, sets: Mapping[str, int], truth: Truth) -> str:
    if name in sets:
        return name
    if name in truth.frames or name in truth.streams:
        kind = "streams" if name in truth.streams else "frames"
        raise BadData(f"{place}: {name} has {kind}, whose predictions have another header; give another file")
    cure = suggestion(name, sets) or f"; sets are {', '.join(sets)}"
    raise BadData(f"{place}: set must be one of the benchmark, got {_short(name)}{cure}")


def _frames_of(place: str, cells: Sequence[str], n: int) -> tuple[Any, list[float]]:
    key = _whole(place, "id", cells[0], range(n))
    coal, gangue = (_share(place, name, cell) for name, cell in zip((COAL, GANGUE), cells[1:], strict=False))
    if abs(coal + gangue - 1) > ROUNDING:
        raise BadData(
            f"{place}: probabilities must sum to 1 within {ROUNDING:g}, {coal:g} and {gangue:g} sum to "
            f"{coal + gangue:g}; normalise them"
        )
    return key, [gangue / (coal + gangue), _flag(place, "unknown", cells[3:])]


def _streams_of(place: str, cells: Sequence[str], n: int) -> tuple[Any, list[float]]:
    key = _whole(place, "id", cells[0], range(n)), _whole(place, "time", cells[1], range(WINDOW, DURATION + 1, STEP))
    share = _share(place, "share", cells[2])
    return key, [share, _flag(place, "shut", cells[3:]) if cells[3:] else float(share > LIMIT)]


def _whole(place: str, name: str, cell: str, allowed: range) -> int:
    if not re.fullmatch(r"\d{1,9}", cell, re.ASCII) or int(cell) not in allowed:
        raise BadData(
            f"{place}: {name} must be a whole number from {allowed[0]} to {allowed[-1]}{' s' * (name == 'time')}, got "
            f"{_short(cell)}; number as in the signals"
        )
    return int(cell)


def _share(place: str, name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not 0 <= value <= 1:
        raise BadData(f"{place}: {name} must be a number from 0 to 1, got {_short(cell)}; if unknown, give 0.5")
    return value


def _flag(place: str, name: str, cells: Sequence[str]) -> float:
    if not cells:
        return 0.0
    if cells[0] not in ("0", "1"):
        raise BadData(f"{place}: {name} must be 0 or 1, got {_short(cells[0])}; 1 says yes")
    return float(cells[0])


def _complete(
    path: Path, name: str, rows: Mapping[Any, Sequence[float]], n: int, header: tuple[str, ...]
) -> Frames | Streams:
    frames = header[2] == COAL
    keys = list(range(n)) if frames else [(k, int(time)) for k in range(n) for time in TIMES]
    missing = [key for key in keys if key not in rows]
    if missing:
        raise BadData(
            f"{path}: a set must be complete, {name} has {len(rows)} of {len(keys)} rows and lacks "
            f"{_row(name, missing[0])}; add the rows, or leave out the whole set"
        )
    values = np.array([rows[key] for key in keys])
    if frames:
        return Frames(values[:, 0], values[:, 1] > 0)
    share, shut = values.T.reshape(2, n, len(TIMES))
    return Streams(share, shut > 0)


def _row(name: str, key: Any) -> str:
    return f"{name} {key[0]} at {key[1]} s" if isinstance(key, tuple) else f"{name} {key}"


def _short(text: str) -> str:
    return repr(text if len(text) <= 80 else f"{text[:77]}...")


# -- metrics ---------------------------------------------------------------------------------------------------------


class Result(NamedTuple):
    """A metric with its 95 % interval (nan: none) and the number of frames or streams behind it."""

    metric: str
    value: float
    low: float
    high: float
    n: int


def judged(predictions: Predictions, truth: Truth) -> Iterator[tuple[str, Result]]:
    for name, own in predictions.items():
        if isinstance(own, Frames):
            found = judged_frames(own, truth.frames[name])
        else:
            found = judged_streams(own, truth.streams[name])
        for result in found:
            yield name, result


def judged_frames(own: Frames, labels: NDArray[np.str_]) -> Iterator[Result]:
    n = len(labels)
    yield _share_of("unknown", own.unknown)
    if (labels == OTHER).all():
        return
    truth = labels == GANGUE
    right = np.where(own.gangue == 0.5, 0.5, (own.gangue > 0.5) == truth)
    yield _share_of("accuracy", right)
    if not own.unknown.all():
        yield _share_of("accuracy of the answered", right[~own.unknown])
    error = calibration_error(own.gangue, truth, np.ones((1, n)))[0]
    weights = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), RESAMPLINGS)
    low, high = np.quantile(calibration_error(own.gangue, truth, weights), (0.025, 0.975))
    # Resampling adds the same noise a second time, and this error only grows by noise: mirrored at the estimate.
    yield Result("calibration error", error, max(2 * error - high, 0.0), max(2 * error - low, 0.0), n)


def calibration_error(probability: Floats, truth: NDArray[np.bool_], weights: NDArray[Any]) -> Floats:
    """Return the expected calibration error over `BINS` bins of a probability, for each row of weights (m, n)."""
    place = np.minimum((probability * BINS).astype(int), BINS - 1)
    gaps = np.zeros((len(probability), BINS))
    gaps[np.arange(len(place)), place] = probability - truth
    return np.asarray(np.abs(weights @ gaps).sum(axis=1) / weights.sum(axis=1))


def _share_of(metric: str, hits: NDArray[Any]) -> Result:
    share = float(hits.mean())
    low, high = wilson_interval(share, len(hits))
    # Rounding leaves 1e-19 where the interval begins at 0.
    return Result(metric, share, low if hits.any() else 0.0, min(high, 1.0), len(hits))


def judged_streams(own: Streams, streams: Sequence[Stream]) -> Iterator[Result]:
    """Yield the metrics of a set of streams; intervals are Student's over streams."""
    errors = np.array([np.nanmean((row - one.shares()) ** 2) for row, one in zip(own.share, streams, strict=True)])
    yield _mean_of("share error", errors, lambda square: np.sqrt(np.maximum(square, 0.0)))
    if np.isnan([one.crossing for one in streams]).all():
        false = [row.any() for row, one in zip(own.shut, streams, strict=True) if one.gangue.mean() < LIMIT]
        if false:
            yield _share_of("false shut", np.array(false))
        return
    rows = []
    for row, one in zip(own.shut, streams, strict=True):
        time = float(TIMES[row.argmax()] if row.any() else DURATION)
        coal, gangue = one.drawn(*sorted((one.crossing, time)))
        late = time > one.crossing
        rows.append((*((gangue - coal, gangue, 0) if late else (coal - gangue, 0, coal)), time - one.crossing))
    for metric, values in zip(_TIMING, np.array(rows, float).T, strict=True):
        yield _mean_of(metric, values)


def judged_answers(own: Truths, truth: Truths) -> Result:
    """Return the metric of a track of real recordings: of whole recordings the share right, of taps the error."""
    pairs = [(own[key], value) for key, value in truth.items()]
    if isinstance(pairs[0][1], str):
        return _share_of("accuracy", np.array([answer == value for answer, value in pairs]))
    answers, values = np.array(pairs, np.float64).T
    return _mean_of("peak error", np.log(answers / values) ** 2, lambda square: np.sqrt(np.maximum(square, 0.0)))


def _mean_of(metric: str, values: Floats, scale: Callable[[Floats], Floats] = np.asarray) -> Result:
    mean, n = values.mean(), len(values)
    half = stats.t.ppf(0.975, n - 1) * values.std(ddof=1) / np.sqrt(n) if n > 1 else np.nan
    low, value, high = scale(np.array([mean - half, mean, mean + half])).tolist()
    return Result(metric, value, low, high, n)


# -- the table -------------------------------------------------------------------------------------------------------


class Entry(NamedTuple):
    """What the table says of an entry beside its results: date (ISO 8601), version, and where its method is."""

    name: str
    date: str = ""
    version: str = ""
    link: str = ""

    def check(self) -> None:
        """Raise `InvalidValue` unless all can stand in a table."""
        _require_name(self.name)
        try:
            datetime.date.fromisoformat(self.date)
        except ValueError:
            raise InvalidValue(f"--date must be a day such as 2026-11-28, got {_short(self.date)}") from None
        if self.version and not _VERSION.fullmatch(self.version):
            raise InvalidValue(f"--version must be 1 to 40 letters, digits, spaces or .+-_, got {_short(self.version)}")
        if self.link and not _LINK.fullmatch(self.link):
            raise InvalidValue(f"--link must be an address that begins with https://, got {_short(self.link)}")


def require_sums(files: Sequence[Path], sums: Path) -> None:
    """Raise `BadData` unless each file of an entry has the SHA-256 that came with it, as `sha256sum` writes it."""
    lines = read_regular(sums, "sums", LARGEST, "send them with the files").decode(errors="replace").splitlines()
    sent = {name.lstrip(" *").rpartition("/")[2]: digest for digest, _, name in (line.partition(" ") for line in lines)}
    for path in files:
        digest = sha256_of(path)
        if sent.get(path.name) != digest:
            raise BadData(
                f"{path}: must have the SHA-256 {sent.get(path.name, 'of a line')} in {sums}, has {digest}; "
                "send file and sums again"
            )


def enter(entry: Entry, files: Iterable[Path], truth: Truth | None, results: Path, real: Path | None = None) -> int:
    """Judge an entry, put it into the results in place of an earlier one of that name, return its number of sets.

    Raises `InvalidValue` for a bad name, `NoInput` or `BadData` if a file is unusable, two files predict one set, or
    the results are of another truth; `MissingOption` if the truth or the recordings of a file are not given.
    """
    entry.check()
    found: dict[str, tuple[list[Result], str]] = {}
    for path in files:
        lines = _lines(path)
        if lines and tuple(lines[0][1]) == ANSWER_COLUMNS:
            new = {name: ([judged_answers(*both)], PUBLIC_TRUTH) for name, both in read_answers(path, real).items()}
        elif truth is None:
            raise MissingOption(f"{path}: predictions need the sets that they are of; give --sets with their folder")
        else:
            new = {}
            for name, one in judged(read_predictions(path, truth), truth):
                new.setdefault(name, ([], truth.digest))[0].append(one)
        if twice := sorted(found.keys() & new.keys()):
            raise BadData(f"{path}: a set must be predicted once, {twice[0]} is also in another file; take one out")
        found |= new
    kept = read_results(results, None if truth is None else truth.digest) if results.exists() else []
    own = [
        (*entry, of, one.metric, *(f"{value:.5g}" for value in (one.value, one.low, one.high)), one.n, digest)
        for of, (metrics, digest) in found.items()
        for one in metrics
    ]
    order = list(dict.fromkeys([*(row["entry"] for row in kept), entry.name]))  # an earlier one's place is kept
    rows = [*(tuple(row.values()) for row in kept if row["entry"] != entry.name), *own]
    write_rows(results, RESULT_COLUMNS, sorted(rows, key=lambda row: order.index(row[0])))
    return len(found)


def _require_name(name: str) -> None:
    if not _NAME.fullmatch(name) or name != name.strip():
        raise InvalidValue(f"NAME must be 1 to 60 letters, digits, spaces or .,:+()/-_, got {_short(name)}")


def read_results(path: Path, digest: str | None = None) -> list[dict[str, str]]:
    """Return the rows of the results; raises `NoInput`, or `BadData` if they are none or of another truth."""
    lines = read_cells(path, "results", LARGEST)
    if not lines or tuple(lines[0][1]) != RESULT_COLUMNS or any(len(c) != len(RESULT_COLUMNS) for _, c in lines):
        raise BadData(f"{path}: results must have the columns {','.join(RESULT_COLUMNS)}; give a file made by enter")
    rows = [dict(zip(RESULT_COLUMNS, cells, strict=True)) for _, cells in lines[1:]]
    try:
        _ = [float(row[key]) for row in rows for key in ("value", "low", "high")]
    except ValueError as error:
        raise BadData(f"{path}: results must be numbers ({error}); give a file made by enter") from None
    truths = {row["truth"] for row in rows} - {PUBLIC_TRUTH}
    others = truths - ({digest} if digest else set(sorted(truths)[:1]))
    if others:
        raise BadData(f"{path}: results must be of one truth, got {min(others)}; give another file with --results")
    return rows


Metrics = Mapping[str, Mapping[str, str]]


def _interval(found: Mapping[str, str]) -> str:
    value, low, high = (f"{float(found[key]):.3f}" for key in ("value", "low", "high"))
    return f"{value} ({low} to {high})"


def _unknown(found: Metrics) -> str:
    values = [found[key]["value"] for key in ("unknown", "accuracy of the answered") if key in found]
    return "; ".join(f"{float(value):.3f}" for value in values)


def _cost(found: Metrics) -> str:
    cost, gangue, coal, late = (float(found[key]["value"]) for key in _TIMING)
    low, high = (float(found[_TIMING[0]][key]) for key in ("low", "high"))
    return f"{cost:.0f} ({low:.0f} to {high:.0f}); {gangue:.0f}, {coal:.0f}; {late:+.1f} s"


#: By the metric that a set must have to be in a table: its title, and what a cell shows, by default with an interval.
_TABLES: dict[str, tuple[str, Callable[[Metrics], str] | None]] = {
    "accuracy": ("Accuracy", None),
    "calibration error": ("Calibration error", None),
    "peak error": ("Real taps: root mean square of ln(peak force / that of the hammer)", None),
    "unknown": ("Share unknown; accuracy of the others. Of strangers all should be unknown", _unknown),
    "share error": ("Streams: error of the share", None),
    "false shut": ("Streams shut although their share stays below one half", None),
    _TIMING[0]: (
        "Cost of the wrong time to shut, a stream, in rocks of coal; gangue let through, coal lost; delay",
        _cost,
    ),
}


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Return the tables of all entries: a row for each set, a column for each entry."""
    entries = list(dict.fromkeys(row["entry"] for row in rows))
    found: dict[tuple[str, str], dict[str, Mapping[str, str]]] = {}
    for row in rows:
        found.setdefault((row["entry"], row["set"]), {})[row["metric"]] = row
    about = {row["entry"]: [row["date"], row["version"] or "-", row["link"] or "-"] for row in rows}
    lines = [(plain(entry), *map(plain, own)) for entry, own in about.items()]
    parts = ["\n".join(["**Entries**", "", *table(("", "date", "version", "link"), lines)])]
    for metric, (title, form) in _TABLES.items():
        lines = []
        for name in (*all_sets(), *TRACKS):
            own = [found.get((entry, name), {}) for entry in entries]
            if any(metric in one for one in own):
                cells = ((form(one) if form else _interval(one[metric])) if metric in one else "-" for one in own)
                lines.append((f"`{name}`", *cells))
        if lines:
            parts.append("\n".join([f"**{title}**", "", *table(("", *map(plain, entries)), lines)]))
    return "\n\n".join(parts) + "\n"
