"""The report: one page, nothing of anybody's runs or is fetched, and its table can be sorted."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import socketserver
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from cgid import load_model, shipped
from cgid.cli.main import run
from cgid.identification.model.model import StoredModel, stored
from cgid.identification.prediction import Answer
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.fraction import FIRST, ShareWindow, ShutDecision
from cgid.measure.overview import OverviewStream
from cgid.plots import report as page
from cgid.plots.report import Report, model_facts, recording_facts, report_page
from cgid.recordings import open_recording

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
#: A name that would do harm wherever it is not escaped.
EVIL = """"><img src="http://127.0.0.1:PORT/x"><script>document.title="broken"</script>'&amp;\x00\ud800 煤 $x"""


def answer(time: float, label: str, probability: float, **more: object) -> Answer:
    other = "gangue" if label == "coal" else "coal"
    told = {"coal": 0.0, "gangue": 0.0} | {label: probability, other: 1 - probability}
    return Answer(time=time, label=label, probabilities=told, novelty=0.5, in_training_range=True, **more)


def told(text: str) -> Finding:
    return Finding(kind="reading", fields={"text": text})


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Two channels of half a second, thirty answers, shares that turn."""
    path = tmp_path_factory.mktemp("report") / "two.npy"
    rng = np.random.default_rng(0)
    np.save(path, rng.normal(size=(2, 12_800)).astype(np.float32))
    recording = open_recording(path, sampling_rate=25600.0, unit="m/s^2")
    model = StoredModel.load(shipped.path_of("models", shipped.ACCELERATION_MODEL))
    stream = OverviewStream(25600.0, 2)
    for block in recording.blocks():
        stream.feed(block)
    overview = stream.overview()
    answers = [
        answer(0.016 * k, "gangue" if k > 12 else "coal", 0.99 - 0.01 * k, channel=str(1 + k % 2), end=0.016 * k + 0.01)
        for k in range(29)
    ]
    answers.append(
        Answer(time=0.49, label="unknown", probabilities={}, novelty=float("nan"), problem="too <short>", cut=True)
    )
    window, rule = ShareWindow(0.2), ShutDecision()
    rule._begun = -FIRST  # its first seconds are over
    shares, turns = [], []
    for one in answers:
        window.add(one.time, one.probabilities.get("gangue", float("nan")))
        shares.append(window.at(one.time))
        turns += [turn for turn in [rule.watch(shares[-1])] if turn is not None]
    assert turns[0].shut
    return Report(
        source=str(path),
        recording=recording_facts(recording, overview, recording.channels),
        model=model_facts(model, "mine.npz"),
        overview=overview,
        channels=recording.channels,
        answers=answers,
        shares=shares,
        turns=turns,
        threshold=rule.threshold,
        findings=[told("the last frame was cut off")],
    )


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("overview_figure", "share_figure", "drawn_figure"):
        monkeypatch.setattr(page, name, lambda *_, **__: None)
    monkeypatch.setattr(page, "picture", lambda *_, **__: b"\x89PNG")


class Page(HTMLParser):
    """What a page holds: texts of cells, what it refers to, tags that are open."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.heads: list[str] = []
        self.references: list[str] = []
        self.open: list[str] = []
        self.texts: list[str] = []
        self.tags: set[str] = set()
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in ("meta", "img"):
            self.open.append(tag)
        for name, value in attributes:
            assert not name.startswith("on") and name != "style"
            if name in ("src", "href", "action", "data", "srcset"):
                self.references.append(value or "")
        if tag == "tr":
            self.rows.append([])
        elif tag == "td":
            self.rows[-1].append("")
        elif tag == "th":
            self.heads.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)
        if "td" in self.open:
            self.rows[-1][-1] += data
        elif "th" in self.open:
            self.heads[-1] += data


def test_the_page_holds_everything(report: Report) -> None:
    seen = Page(report_page([report]))
    assert not seen.open and seen.rows.pop(0) == []
    columns = "number|time [s]|channel|length [ms]|label|p(coal)|p(gangue)|novelty|range|note"
    assert "|".join(seen.heads) == columns
    assert len(seen.rows) == 30
    assert seen.rows[3] == ["4", "0.0480", "2", "10", "coal", "0.960", "0.040", "0.5", "in", ""]
    assert seen.rows[29] == ["30", "0.4900", "1", "-", "unknown", "-", "-", "-", "out", "cut; too <short>"]
    text = " ".join(seen.texts)
    for told in (
        "coal (43%)",
        "gangue (53%)",
        "unknown (3%)",
        "the last frame was cut off",
        "mine.npz",
        "25.6 kHz",
    ):
        assert told in text
    assert "30 impacts" not in text and "out of distribution" not in text  # what the verdict says is said once
    model = stored(load_model())
    assert not any(name in value for value in model_facts(model, "m.npz").values() for name in model.features)
    (turn,) = re.findall(r"Shut the window at (\d\.\d\d) s", text)
    assert float(turn) == pytest.approx(report.turns[0].time, abs=0.006)
    assert text.count(Path(report.source).name) == 3  # twice as titles of the page, once in its path
    assert len(seen.references) == 3
    for reference in seen.references:
        kind, data = reference.split(",")
        drawn = base64.b64decode(data)
        assert kind == "data:image/png;base64" and drawn.startswith(b"\x89PNG")
        assert int.from_bytes(drawn[16:20]) >= 1200


def test_text_of_strangers_is_only_text(report: Report) -> None:
    evil = replace(
        report,
        source=EVIL,
        recording={EVIL: EVIL},
        model={EVIL: EVIL},
        findings=[told(EVIL)],
        answers=[replace(one, label=EVIL, problem=EVIL, channel=EVIL) for one in report.answers[:2]],
        channels=[replace(channel, name=EVIL) for channel in report.channels],
        shares=[replace(share, channel=EVIL) for share in report.shares],
    )
    page = report_page([evil], title=EVIL)
    page.encode()
    seen = Page(page)
    assert not seen.open
    assert all(reference.startswith("data:image/png") for reference in seen.references)
    assert "\x00" not in page and page.count("<script>") == 1
    assert any('"><img src="http://127.0.0.1' in text for text in seen.texts)


@pytest.fixture
def visitors() -> Iterator[tuple[int, list[bytes]]]:
    """A port on this machine, and what anybody has asked there."""
    asked: list[bytes] = []

    class Door(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            asked.append(self.rfile.readline())
            self.wfile.write(b"HTTP/1.0 404 no\r\n\r\n")

    with socketserver.TCPServer(("127.0.0.1", 0), Door) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server.server_address[1], asked
        server.shutdown()
        thread.join()


def browse(page: Path, folder: Path, *more: str) -> str:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium to look at the page with")
    options = "--headless --no-sandbox --disable-gpu --disable-background-networking --disable-component-update"
    command = [CHROMIUM, *options.split(), "--disable-sync", "--no-first-run", f"--user-data-dir={folder}", *more]
    done = subprocess.run(
        [*command, "--virtual-time-budget=2000", "--dump-dom", page.as_uri()],
        capture_output=True,
        timeout=300,
        check=True,
    )
    return done.stdout.decode()


@pytest.mark.usefixtures("undrawn")
def test_a_browser_shows_it_and_asks_nobody(report: Report, tmp_path: Path, visitors: tuple[int, list[bytes]]) -> None:
    port, asked = visitors
    evil = EVIL.replace("PORT", str(port))
    page_of = replace(report, source=evil, findings=[told(evil)], answers=[replace(report.answers[0], problem=evil)])
    text = report_page([page_of], title="quiet")
    # The same without care: its picture is asked for, so the door is heard, unless the page's own rules forbid it.
    careless = text.replace("<body>", f"<body><img src='http://127.0.0.1:{port}/y'>")
    rules = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')
    for name, content in (("kept", text), ("ruled", careless), ("open", rules.sub("", careless))):
        (tmp_path / f"{name}.html").write_text(content, encoding="utf-8")
        shown = browse(tmp_path / f"{name}.html", tmp_path / f"browser-{name}")
        assert "<title>quiet</title>" in shown
        # The script has run, so the rules allow it.
        assert '<button type="button">time [s]</button>' in shown and "1 of 1 rows" in shown
        assert bool(asked) == (name == "open")


def test_the_result_stands_first_in_a_sentence(report: Report) -> None:
    whole = [replace(share, channel=channel, n_impacts=40, n_unknown=2, share=0.55, low=0.4, high=0.69)
             for share, channel in zip(report.shares, "12", strict=False)]  # fmt: skip
    text = " ".join(Page(report_page([replace(report, whole=whole[:1])])).texts)
    assert text.index("40 rocks: 55% gangue (40% to 69%)") < text.index("coal (43%)")
    assert "recorded from" not in text
    day = f"{datetime.fromtimestamp(Path(report.source).stat().st_mtime):%Y-%m-%d}"
    assert f"file of {day}" in text
    dated = report.recording | {"started": "2026-11-27 06:00:00"}
    text = " ".join(Page(report_page([replace(report, whole=whole, recording=dated)])).texts)
    assert "channel 2: 40 rocks" in text and "2 more unknown, recorded from 2026-11-27 06:00:00" in text
    few = [replace(whole[0], n_impacts=3)]
    assert "3 rocks" not in " ".join(Page(report_page([replace(report, whole=few)])).texts)


@pytest.mark.usefixtures("undrawn")
def test_long_tables_have_pages(report: Report, tmp_path: Path) -> None:
    steps = """
      const rows = () => [...document.querySelectorAll("tbody tr")].filter(row => !row.hidden);
      const seen = () => `${rows().length}:${rows()[0].cells[0].textContent}`;
      const turn = text => [...document.querySelectorAll(".pages button")].find(b => b.textContent === text);
      const told = [seen()];
      turn("Next").click(); told.push(seen()); turn("Next").click(); told.push(seen(), turn("Next").disabled);
      turn("Back").click(); told.push(seen());
      document.querySelector("th button").click(); document.querySelector("th button").click(); told.push(seen());
      document.title = JSON.stringify(told);
    """
    answers = [answer(0.001 * k, "coal", 0.9) for k in range(450)]
    text = re.sub(
        r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", report_page([replace(report, answers=answers)])
    )
    (tmp_path / "page.html").write_text(text.replace("</body>", f"<script>{steps}</script></body>"), "utf-8")
    shown = browse(tmp_path / "page.html", tmp_path / "browser")
    told = json.loads(html.unescape(re.search("<title>(.*?)</title>", shown)[1]))
    assert told == ["200:1", "200:201", "50:401", True, "200:201", "200:450"]


@pytest.mark.usefixtures("undrawn")
def test_the_table_sorts_and_chooses(report: Report, tmp_path: Path) -> None:
    steps = """
      const heads = [...document.querySelectorAll("th button")], of = name => heads.find(b => b.textContent === name);
      const rows = () => [...document.querySelectorAll("tbody tr")].filter(row => !row.hidden);
      const seen = () => rows().map(row => row.cells[0].textContent);
      const told = {}, note = name => { told[name] = seen().join(" "); };
      of("p(coal)").click(); note("up"); of("p(coal)").click(); note("down");
      of("label").click(); note("label"); of("number").click(); note("number");
      const select = document.querySelector("select"); select.value = "unknown";
      select.dispatchEvent(new Event("change")); note("chosen");
      document.title = JSON.stringify(told);
    """
    text = report_page([report])
    ruleless = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)
    (tmp_path / "page.html").write_text(ruleless.replace("</body>", f"<script>{steps}</script></body>"), "utf-8")
    shown = browse(tmp_path / "page.html", tmp_path / "browser")
    told = json.loads(html.unescape(re.search("<title>(.*?)</title>", shown)[1]))
    ordered = {name: [int(number) for number in numbers.split()] for name, numbers in told.items()}
    # The probability of coal falls with the number, then rises from 0.14; what has none is last both ways.
    assert ordered["up"] == [*range(14, 30), *range(13, 0, -1), 30]
    assert ordered["down"] == [*range(1, 14), *range(29, 13, -1), 30]
    assert ordered["label"] == [*range(1, 31)]
    assert ordered["number"] == [*range(1, 31)]
    assert ordered["chosen"] == [30]


def test_a_recording_of_one_impact_has_a_page(tmp_path: Path) -> None:
    sample, path = shipped.path_of("datasets", "sample.csv"), tmp_path / "one.csv"
    path.write_text("".join(sample.read_text().splitlines(keepends=True)[:4002]))
    assert run(["predict", str(path), "--report", str(tmp_path / "one.html")]) == 0
    assert Page((tmp_path / "one.html").read_text()).rows[-1]


def test_report_says_that_a_model_is_no_better_than_chance() -> None:
    model = StoredModel.load(shipped.path_of("models", shipped.DEFAULT_MODEL))
    assert "unproven" not in model_facts(model, "mine.npz")
    metrics = {"accuracy": 0.55, "accuracy_interval_95": [0.42, 0.67], "confusion": [[15, 15], [12, 18]]}
    facts = model_facts(replace(model, training={**model.training, "metrics": metrics}), "mine.npz")
    assert "0.60 of the gangue" in facts["unproven"]
