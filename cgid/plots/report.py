"""A report on recordings: one HTML page with pictures and a table, which loads nothing from the network."""

from __future__ import annotations

import base64
import hashlib
import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import __version__
from cgid._lib.spelling import as_option
from cgid._lib.terminal import counted, printable
from cgid._lib.validation import UNKNOWN
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.findings import Finding, InWords
from cgid.identification.prediction.fraction import MIN_IMPACTS, Share, Switch, unproven
from cgid.identification.prediction.support import SupportState
from cgid.measure.overview import Overview
from cgid.plots import picture, share_figure
from cgid.plots.answers import drawn_figure
from cgid.plots.figure import COLOURS, NEUTRAL, colours_of, written
from cgid.plots.recording import Mark, hertz, overview_figure
from cgid.recordings import Channel, RecordingFile


@dataclass(frozen=True, kw_only=True)
class Report:
    """The content of a page about one recording."""

    source: str  # its name
    recording: Mapping[str, str]  # `recording_facts`, in the order of the page
    model: Mapping[str, str]  # `model_facts`
    overview: Overview  # waveform, spectrogram and spectrum of the first channels
    channels: Sequence[Channel]  # those of the overview
    answers: Sequence[Answer]  # in order of time
    shares: Sequence[Share] = ()  # gangue shares over sliding windows
    turns: Sequence[Switch] = ()  # when the window should be shut or opened
    states: Sequence[SupportState] = ()  # the last record of each support
    whole: Sequence[Share] = ()  # gangue share of each support over the whole recording
    threshold: float | None = None  # share of gangue above which further caving costs more than it brings
    unit_of_decision: str = "impact"  # subject of an answer, or "window"
    findings: Sequence[Finding] = ()  # what is wrong, in order of time

    @property
    def labels(self) -> list[str]:
        """The labels of the answers in alphabetical order, "unknown" last."""
        return sorted({answer.label for answer in self.answers}, key=lambda label: (label == UNKNOWN, label))

    def tiles(self) -> Iterator[tuple[str, str]]:
        """Yield the figures that the verdict does not have, and their captions."""
        n, counts = len(self.answers), Counter(answer.label for answer in self.answers)
        for label in self.labels:
            yield f"{counts[label]}", f"{label} ({counts[label] / n:.0%})"
        overlapping = sum(answer.overlapping for answer in self.answers)
        if overlapping:
            yield f"{overlapping}", "overlapping another"
        for state in self.states if self.threshold is not None else ():
            where = f", channel {state.share.channel}" if len(self.states) > 1 else ""
            ground = "" if state.ground == "seen" else str(state.ground).replace("_", " ")
            why = ", ".join(part for part in (ground, where.removeprefix(", ")) if part)
            yield str(state.decision), "decision at the end" + (f" ({why})" if why else "")

    @property
    def followed(self) -> list[str]:
        """The channels whose gangue fraction is available at two or more times."""
        counted_by = Counter(share.channel for share in self.shares if share.is_known)
        return [channel for channel, count in counted_by.items() if count > 1]

    def times_of_shares(self) -> dict[str, NDArray[np.float64]]:
        """Return the times of the predictions of channels with several gangue fractions, if enough for a decision."""
        times = {name: np.array([one.time for one in self.answers if one.channel == name]) for name in self.followed}
        return {name: one for name, one in times.items() if len(one) >= MIN_IMPACTS}


def recording_facts(recording: RecordingFile, overview: Overview, channels: Sequence[Channel]) -> dict[str, str]:
    """Describe a recording in words; `channels` are those of `overview`."""
    facts = {
        "file": recording.source,
        "format": recording.format,
        "sampling rate": hertz(recording.sampling_rate),
        "length": f"{overview.duration:.6g} s ({counted(overview.n_samples, 'sample')} per channel)",
    }
    if recording.start_time is not None:
        facts["started"] = recording.start_time.isoformat(sep=" ")
    elif Path(recording.source).is_file():
        facts["file of"] = f"{datetime.fromtimestamp(Path(recording.source).stat().st_mtime):%Y-%m-%d}"
    if len(channels) < len(recording.channels):
        facts["channels"] = f"{len(recording.channels)}, of which {len(channels)} are shown here"
    for k, channel in enumerate(channels):
        facts[f"channel {channel.name}"] = (
            f"{channel.quantity or 'signal'} [{written(channel.unit)}], from {overview.lowest[k].min():.4g} to "
            f"{overview.highest[k].max():.4g}, mean {overview.mean[k]:.3g}, standard deviation "
            f"{overview.deviation[k]:.3g}"
        )
    return facts


def model_facts(model: StoredModel, name: str, gangue: Collection[str] = ("gangue",)) -> dict[str, str]:
    """Describe a model in words, by which `gangue` is told from other labels; `name` is that of its file."""
    ends = dict.fromkeys(hertz(rate, 3) for rate in (min(model.sampling_rates), max(model.sampling_rates)))
    facts = {
        "model": name,
        "tells apart": ", ".join(model.labels),
        "from": f"{model.quantity} [{written(model.unit)}], {model.kind}s, trained at {' to '.join(ends)}",
        "family": model.family,
    }
    metrics = model.training.get("metrics", {})
    if metrics.keys() >= {"accuracy", "accuracy_interval_95"}:
        low, high = metrics["accuracy_interval_95"]
        facts["test accuracy"] = f"{metrics['accuracy']:.3f} (95 % interval {low:.3f} to {high:.3f})"
    if reason := unproven(model, gangue):
        facts["unproven"] = reason
    return facts


#: File name endings of a report.
ENDINGS = (".html", ".htm")
#: Maximum number of rows of a table; more make browsers slow.
MAX_ROWS = 20_000
_DPI = 130


def report_page(reports: Sequence[Report], *, title: str = "") -> str:
    """Return one self-contained HTML page about some recordings; equal reports give equal pages."""
    title = title or _title([Path(report.source).name for report in reports])
    style, script = _resource("report.css") + _swatches(), _resource("report.js")
    allowed = f"default-src 'none'; img-src data:; style-src '{_hash(style)}'; script-src '{_hash(script)}'"
    return Template(_resource("report.html")).substitute(
        # The file may be untrusted: only this page's own style and script run, and nothing is fetched.
        allowed=allowed,
        title=_text(title),
        style=style,
        version=__version__,
        sections="\n".join(line for report in reports for line in _section(report, named=len(reports) > 1)),
        script=script,
    )


def _title(names: Sequence[str]) -> str:
    """Return the names of the recordings, or the first name and the number of others."""
    different = list(dict.fromkeys(names))
    return ", ".join(different) if len(different) < 4 else f"{different[0]} and {len(different) - 1} other recordings"


def _section(report: Report, *, named: bool) -> Iterator[str]:
    yield "<section>"
    if named:  # else the title of the page is its name
        yield f"<h2>{_text(Path(report.source).name)}</h2>"
    yield from _verdict(report)
    yield from _findings(report)
    yield '<ul class="tiles">'
    yield from (f"<li><strong>{_text(figure)}</strong> {_text(what)}</li>" for figure, what in report.tiles())
    yield "</ul>"
    yield from _switches(report)
    yield '<div class="facts">'
    yield from _facts("Recording", report.recording)
    yield from _facts("Model", report.model)
    yield "</div>"
    yield from _pictures(report)
    yield from _table(report)
    yield "</section>"


def _verdict(report: Report) -> Iterator[str]:
    """Yield the result in a sentence for each support, if it has enough answers for one."""
    subject = "rock" if report.unit_of_decision == "impact" else "window"
    dates = (("started", "recorded from"), ("file of", "file of"))
    when = "".join(f", {words} {report.recording[key]}" for key, words in dates if key in report.recording)
    for share in report.whole:
        if share.n_impacts < MIN_IMPACTS:
            continue
        where = f"channel {share.channel}: " if len(report.whole) > 1 else ""
        unknown = f", {share.n_unknown} more unknown" if share.n_unknown else ""
        gangue = "gangue fraction not known"
        if share.is_known:
            gangue = f"{share.share:.0%} gangue ({share.low:.0%} to {share.high:.0%})"
        text = f"{where}{counted(share.n_impacts, subject)}: {gangue}"
        yield f'<p class="verdict"><strong>{_text(text)}</strong>{_text(unknown + when)}</p>'


def _findings(report: Report) -> Iterator[str]:
    """Yield what is wrong, those with next steps in boxes of their own."""
    for one in sorted(report.findings, key=lambda one: one.begin if one.begin > 0 else 0.0):
        line = replace(one, commands=()).line("", len(report.channels), as_option).removeprefix(":").strip()
        if not line or one.is_note:
            continue
        box = "hint" if one.commands else "warnings"
        yield f'<div class="{box}"><strong>{_text(one.kind.replace("_", " "))}</strong><p>{_text(line)}.</p>'
        for number, way in enumerate(filter(None, (one.commands, one.instead))):
            steps = (_text(step) if isinstance(step, InWords) else f"<code>{_text(step)}</code>" for step in way)
            yield "<p>Or:</p>" * number + "<ol>" + "".join(f"<li>{step}</li>" for step in steps) + "</ol>"
        yield "</div>"


def _switches(report: Report) -> Iterator[str]:
    many = len({share.channel for share in report.shares}) > 1
    for switch in report.turns:
        where = f", channel {switch.share.channel}" if many else ""
        what, other = ("Shut the window", "going on") if switch.shut else ("Open it again", "staying shut")
        limit = "" if report.threshold is None else f", beside the limit of {report.threshold:.0%}"
        text = (
            f"{what} at {switch.time:.2f} s{where}: {other} is expected to lose more coal than it wins, at a gangue "
            f"fraction of {switch.share.share:.0%} ({switch.share.low:.0%} to {switch.share.high:.0%}){limit}"
        )
        yield f'<p class="turn">{_text(text)}</p>'


def _facts(title: str, facts: Mapping[str, str]) -> Iterator[str]:
    yield f"<div><h3>{title}</h3><dl>"
    yield from (f"<dt>{_text(name)}</dt><dd>{_text(value)}</dd>" for name, value in facts.items())
    yield "</dl></div>"


def _pictures(report: Report) -> Iterator[str]:
    figure = overview_figure(report.overview, report.channels, title="", marks=list(_marks(report)))
    what = f"Each {report.unit_of_decision} by its label, waveform, spectrogram and mean spectrum"
    yield _figure(figure, f"{what} of each channel." if len(report.channels) > 1 else f"{what}.")
    if report.followed:
        shares = share_figure(report.shares, report.turns, report.overview.duration, threshold=report.threshold)
        yield _figure(shares, "Gangue fraction over a sliding window, with its interval.")
    times = report.times_of_shares()
    if times:
        yield _figure(
            drawn_figure(times, report.shares, report.turns),
            "Operators' curve: cumulative gangue fraction against recovered coal, each prediction counted as a rock.",
        )


def _marks(report: Report) -> Iterator[Mark]:
    """Yield a mark for each prediction, in every shown channel that it is of."""
    names = [channel.name for channel in report.channels]
    for answer in report.answers:
        # An unknown end is nan.
        end = answer.end if answer.end >= answer.time else answer.time
        members = [answer.channel] if answer.channel in names else answer.channel.split("+")
        for name in members:
            if name in names:
                yield Mark(time=answer.time, end=end, label=answer.label, channel=name)


def _figure(figure: Any, caption: str) -> str:
    data = base64.b64encode(picture(figure, ".png", dpi=_DPI)).decode()
    image = f'<div class="picture"><img alt="{_text(caption)}" src="data:image/png;base64,{data}"></div>'
    return f"<figure>{image}<figcaption>{_text(caption)}</figcaption></figure>"


def _table(report: Report) -> Iterator[str]:
    """Yield the table of predictions, without columns that do not apply to this recording."""
    answers = report.answers[:MAX_ROWS]
    has_ends = any(answer.end == answer.end for answer in answers)
    has_sets = any(answer.prediction_set is not None for answer in answers)
    labels = list(dict.fromkeys(label for answer in answers for label in answer.probabilities))
    kinds = (
        ("number", "number", True),
        ("time [s]", "number", True),
        ("channel", "", len({answer.channel for answer in answers}) > 1),
        ("length [ms]", "number", has_ends),
        ("label", "", True),
        *((f"p({label})", "number", True) for label in labels),
        ("cannot be ruled out", "long", has_sets),
        ("novelty", "number", True),
        ("range", "", True),
        ("note", "long", True),
    )
    columns = {name: kind for name, kind, shown in kinds if shown}
    yield f'<div class="impacts"><h3>{report.unit_of_decision.capitalize()}s</h3>'
    if len(answers) < len(report.answers):
        yield f"<p>The first {len(answers)} of {len(report.answers)}; cgid predict --json lists them all.</p>"
    yield from _choices(answers, list(columns))
    yield '<div class="table"><table class="answers"><thead><tr>'
    yield "".join(f'<th scope="col" class="{kind}">{_text(name)}</th>' for name, kind in columns.items())
    yield "</tr></thead><tbody>"
    swatches = {label: _swatch(colour) for label, colour in colours_of(report.labels).items()}
    for number, answer in enumerate(answers, start=1):
        cells = _cells(number, answer, labels)
        yield "<tr>" + "".join(_cell(name, kind, cells[name], swatches) for name, kind in columns.items()) + "</tr>"
    yield "</tbody></table></div></div>"


def _choices(answers: Sequence[Answer], columns: Sequence[str]) -> Iterator[str]:
    """Yield the controls that filter rows; they are hidden until the script runs."""
    yield '<p class="choose" hidden>Show '
    for name in ("label", "channel"):
        if name in columns:
            values = sorted({getattr(answer, name) for answer in answers})
            options = "".join(f"<option>{_text(value)}</option>" for value in values)
            yield f'<label>{name} <select data-column="{columns.index(name)}"><option value="">all</option>'
            yield f"{options}</select></label> "
    yield '<output class="faint"></output></p>'


def _cells(number: int, answer: Answer, labels: Sequence[str]) -> dict[str, str]:
    marks = [name for name in ("overlapping", "clipped", "cut") if getattr(answer, name)]
    return {
        "number": str(number),
        "time [s]": f"{answer.time:.4f}",
        "length [ms]": _number(1e3 * (answer.end - answer.time), ".3g"),
        "channel": answer.channel,
        "label": answer.label,
        **{f"p({label})": _number(answer.probabilities.get(label, math.nan), ".3f") for label in labels},
        "cannot be ruled out": ", ".join(answer.prediction_set or ()),
        "novelty": _number(answer.novelty, ".3g"),
        "range": "in" if answer.in_training_range else "out",
        "note": "; ".join([*marks, *([answer.problem] if answer.problem else [])]),
    }


def _cell(name: str, kind: str, value: str, swatches: Mapping[str, str]) -> str:
    swatch = f'<span class="swatch {swatches[value]}"></span>' if name == "label" else ""
    return f'<td class="{kind}">{swatch}{_text(value)}</td>'


def _number(value: float, form: str) -> str:
    return "-" if value != value else format(value, form)


def _text(value: str) -> str:
    """Return untrusted text as HTML, with unprintable characters escaped."""
    return escape(printable(value))


def _swatches() -> str:
    """Return the style of the coloured squares, with the colours of the labels in the pictures."""
    return "".join(f".{_swatch(colour)} {{ background: {colour}; }}\n" for colour in (*COLOURS, NEUTRAL))


def _swatch(colour: str) -> str:
    return f"colour-{colour[1:]}"


def _resource(name: str) -> str:
    return (resources.files("cgid.plots") / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """Return the hash by which the page's policy admits its own style or script."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
