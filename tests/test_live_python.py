"""`cgid.Monitor`: what is told of a stream in Python is what `cgid monitor` tells, whatever the blocks."""

from __future__ import annotations

import asyncio
import json
import queue
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgid
from cgid._lib.validation import finite
from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.identification.prediction.monitor import News
from cgid.plant import PlantOutputs
from tests.streams_of_pulses import RATE, stream, window_model

SETTINGS: dict[str, Any] = {"share_time": 0.2, "blind_after": 0.5, "coal_until": 0.25, "cycle_pause": 0.2}
WORDS = ["--set", "window=0.2s", "--set", "blind_after=0.5s", "--coal-until", "0.25s", "--set", "cycle_pause=0.2s"]
N = 4


@pytest.fixture(scope="module")
def samples() -> np.ndarray:
    """Four channels of two cycles of rocks: one with a gap, one that dies, and all at other times."""
    pause, parts = np.random.default_rng(1).normal(0, 25, round(0.3 * RATE)), []
    for seed in range(N):
        cycle = stream(["coal"] * 14 + ["gangue"] * 8, 0.02, seed)
        parts.append(np.roll(np.concatenate([cycle, pause, cycle]), 1777 * seed))
    all_ = np.stack(parts, axis=1)
    middle = round(0.3 * RATE)
    all_[middle : middle + 4000, 0] = np.nan
    all_[-round(0.6 * RATE) :, 2] = 3.0
    return all_.astype("<f4")


@pytest.fixture(scope="module")
def printed(samples: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    raw = tmp_path_factory.mktemp("live") / "a.raw"
    raw.write_bytes(samples.tobytes())
    import contextlib
    import io

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        given = ["--rate", str(RATE), "--channels", f"{N}", "--sample-format", "f32le", "--unit", "N", "--json"]
        assert run(["monitor", str(raw), *given, *WORDS]) == 0
    return [json.loads(line) for line in out.getvalue().splitlines()]


def rounded(value: Any) -> Any:
    """Return floats to nine digits: sums over batches of another length differ in their last ones."""
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(rounded, value))
    if not isinstance(value, float):
        return value
    return float(f"{value:.9g}") if value == value else None


def told(news: list[News]) -> dict[str, list[Any]]:
    answers = [one for each in news for one in each.answers]
    reports = [one for each in news for one in each.reports]
    return rounded(
        {
            "answers": [(one.channel, one.time, one.label, dict(one.probabilities)) for one in answers],
            "reports": [(one.kind, one.state.time, finite(one.state.content())) for one in reports],
            "findings": [(one.kind, one.channels, one.begin, one.end) for each in news for one in each.findings],
        }
    )


def fed(watch: cgid.Monitor, samples: np.ndarray, length: int) -> list[News]:
    news = [watch.feed(samples[first : first + length]) for first in range(0, len(samples), length)]
    return [*news, watch.finish()]


class KeptOutputs(PlantOutputs):
    """Plant outputs, and the records that they got."""

    def __init__(self, page: Path) -> None:
        super().__init__(live=str(page))
        self.page, self.records = page, list[dict[str, Any]]()

    def __call__(self, record: dict[str, Any]) -> None:
        self.records.append(record)
        super().__call__(record)


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> KeptOutputs:
    return KeptOutputs(tmp_path_factory.mktemp("live") / "page.html")


@pytest.fixture(scope="module")
def whole(samples: np.ndarray, outputs: KeptOutputs) -> list[News]:
    with cgid.Monitor(RATE, N, "N", outputs=outputs, **SETTINGS) as watch:
        return fed(watch, samples, 10_000)


def test_outputs_get_what_the_command_gives_them(
    whole: list[News], printed: list[dict[str, Any]], outputs: KeptOutputs
) -> None:
    spoken = {"source", "wall_time", "help", "commands", "instead"}  # the names of settings, and of files

    def plain(records: list[dict[str, Any]]) -> list[str]:
        return [str(rounded({name: one for name, one in record.items() if name not in spoken})) for record in records]

    assert sorted(plain(outputs.records)) == sorted(plain(printed))
    for kind in ("impact", "share", "state"):  # that samples are missing is told when their block comes
        own, theirs = ([one for one in records if one["kind"] == kind] for records in (outputs.records, printed))
        assert plain(own) == plain(theirs) != []
    page = json.loads(outputs.page.read_text(encoding="utf-8").split("EMBEDDED = ")[1].split(";\n")[0])
    last = [one for one in printed if one["kind"] == "share" and one["channel"] == "1"][-1]
    assert page["ended"] and page["supports"][0]["shares"][-1][0] == pytest.approx(last["to_s"])
    assert not any(service._thread.is_alive() for service in outputs._services)


def test_what_is_told_is_what_the_command_prints(whole: list[News], printed: list[dict[str, Any]]) -> None:
    own = told(whole)
    rows = [one for one in printed if one["kind"] == "impact"]
    assert [(one["channel"], one["label"]) for one in rows] == [(one[0], one[2]) for one in own["answers"]]
    assert [one["time_s"] for one in rows] == pytest.approx([one[1] for one in own["answers"]])
    lines = [one for one in printed if one["kind"] in ("share", "state", "shut", "open")]
    assert [(one["kind"], one["channel"], rounded(one["time_s"])) for one in lines] == [
        (kind, content["channel"], time) for kind, time, content in own["reports"]
    ]
    for line, (_, _, content) in zip(lines, own["reports"], strict=True):
        assert rounded({name: line[name] for name in content}) == content
    found = [one for one in printed if one["kind"] == "finding"]
    assert {(one["finding"], tuple(one["channels"])) for one in found} == {one[:2] for one in own["findings"]}
    assert {"missing", "blind"} <= {one[0] for one in own["findings"]}
    assert len(rows) > 100 and len(lines) > 50


@pytest.mark.parametrize("length", [1, 77, 100_000])
def test_lengths_of_blocks_change_nothing(length: int, samples: np.ndarray, whole: list[News]) -> None:
    part = samples[: 60_000 if length == 1 else None]
    with cgid.Monitor(RATE, N, "N", **SETTINGS) as watch:
        own = told(fed(watch, part, length))
    expected = told(whole)
    if length == 1:
        with cgid.Monitor(RATE, N, "N", **SETTINGS) as watch:
            expected = told(fed(watch, part, 30_000))
    assert sorted(own["findings"], key=str) == sorted(expected["findings"], key=str)
    assert own["reports"] == expected["reports"]
    assert own["answers"] == expected["answers"]


def test_windows_are_told_as_they_complete(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    samples = 0.01 * np.concatenate([rng.normal(size=12_000), np.cumsum(rng.normal(size=12_000))])
    window_model().save(model := tmp_path / "w.npz")
    expected = cgid.predict(samples, 8000.0, "FS", model=model)
    found = []
    with cgid.Monitor(8000.0, 1, "FS", model=model) as watch:
        for block in np.array_split(samples, 50):
            news = watch.feed(block)
            assert all(one.time <= news.until for one in news.answers)
            found += news.answers
        assert len(found) >= len(expected) - 1
        found += watch.finish().answers
    assert [one.label for one in found] == expected["label"].tolist()


def test_names_integers_cycles_pauses_and_the_end() -> None:
    force = stream(["coal"] * 4, 0.02)
    with cgid.Monitor(RATE, ["left", "mid"], "N", full_scale="20 kN", coal_until=0.01) as watch:
        steps = np.round(force / 20e3 * 2**15).clip(-(2**15), 2**15 - 1).astype(np.int16)
        steps = np.stack([steps, np.roll(steps, 2_000)], axis=1)
        answers = [one for block in np.array_split(steps, 7) for one in watch.feed(block).answers]
        watch.begin_cycle()
        with pytest.raises(InvalidValue, match="support of a cycle"):
            watch.begin_cycle("right")
        for report in watch.stopped(7.0).reports:
            assert str(report.state.ground) == "stopped" and "7 s" in report.state.reason
        answers += watch.finish().answers
        assert sorted(one.channel for one in answers) == ["left"] * 4 + ["mid"] * 4
        assert watch.duration == pytest.approx(force.size / RATE)
        with pytest.raises(InvalidValue, match="ended"):
            watch.feed(steps)
        assert [one.share.channel for one in watch.states] == ["left", "mid"]


@pytest.mark.parametrize(
    ("given", "block", "error", "word"),
    [
        ({"channels": 1, "unit": "N"}, None, MissingOption, "sampling_rate"),
        ({"sampling_rate": RATE, "unit": "N"}, None, MissingOption, "channels"),
        ({"sampling_rate": RATE, "channels": 0, "unit": "N"}, None, InvalidValue, "channels"),
        ({"sampling_rate": -1.0, "channels": 1, "unit": "N"}, None, InvalidValue, "sampling_rate"),
        ({"sampling_rate": RATE, "channels": 1, "unit": "furlong"}, None, InvalidValue, "unit"),
        ({"sampling_rate": RATE, "channels": 1, "unit": "V"}, None, MissingOption, "sensitivity"),
        ({"sampling_rate": RATE, "channels": 1, "unit": "N", "colour": 3}, None, InvalidValue, "colour"),
        ({"sampling_rate": RATE, "channels": 2, "unit": "N"}, np.zeros(9), BadData, "shape"),
        ({"sampling_rate": RATE, "channels": 1, "unit": "N"}, np.zeros(9, np.int16), BadData, "full_scale"),
        ({"sampling_rate": RATE, "channels": 1, "unit": "N"}, "nothing", BadData, "block"),
    ],
)
def test_what_is_wrong_is_named(given: dict[str, Any], block: Any, error: type[Exception], word: str) -> None:
    def use() -> None:
        with cgid.Monitor(**given) as watch:
            watch.feed(block)

    with pytest.raises(error, match=word):
        use()


def test_a_callback_of_a_card_a_queue_and_asyncio(samples: np.ndarray, whole: list[News]) -> None:
    """As the guide shows: a callback only queues a copy; a thread, or a task, feeds."""
    waiting: queue.Queue[np.ndarray | None] = queue.Queue()
    buffer, news = np.empty((5_000, N), np.float32), list[News]()

    def callback(indata: np.ndarray) -> None:  # the card's own thread, which uses its buffer again
        waiting.put(indata.copy())

    def feeding() -> None:
        with cgid.Monitor(RATE, N, "N", **SETTINGS) as watch:
            while (block := waiting.get()) is not None:
                news.append(watch.feed(block))
            news.append(watch.finish())

    thread = threading.Thread(target=feeding)
    thread.start()
    for first in range(0, len(samples), len(buffer)):
        part = samples[first : first + len(buffer)]
        buffer[: len(part)] = part
        callback(buffer[: len(part)])
    waiting.put(None)
    thread.join()
    assert told(news) == told(whole)

    async def main() -> list[News]:
        with cgid.Monitor(RATE, N, "N", **SETTINGS) as watch:
            own = [await asyncio.to_thread(watch.feed, block) for block in np.array_split(samples, 9)]
            return [*own, await asyncio.to_thread(watch.finish)]

    assert told(asyncio.run(main()))["answers"] == told(whole)["answers"]


def test_an_error_in_a_stream_is_raised_where_it_was_fed(samples: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    watch = cgid.Monitor(RATE, N, "N")
    monkeypatch.setattr(watch._pipeline.watch, "feed", lambda *_: (_ for _ in ()).throw(BadData("broken")))
    with pytest.raises(BadData, match="broken"):
        watch.feed(samples[:60_000])
    watch.close()
