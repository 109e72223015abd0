"""Pictures of recordings: what they say is what is in the file, and `cgid plot` makes them."""

from __future__ import annotations

import json
import re
import wave
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal as scipy_signal

from cgid.cli.main import run
from cgid.measure.overview import OverviewStream
from cgid.plots import picture, share_figure
from cgid.plots.answers import drawn_figure
from cgid.plots.figure import COLOURS, FORMATS, colours_of
from cgid.plots.recording import Mark, overview_figure
from cgid.recordings import Channel, open_recording
from cgid.scene import generate

MAGIC = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
RATE = 25600.0


def figure_of(samples: np.ndarray, *channels: Channel, rate: float = RATE, **more: Any) -> Any:
    stream = OverviewStream(rate, len(samples))
    stream.feed(samples)
    named = channels or tuple(Channel(name=str(k + 1), unit="m/s^2") for k in range(len(samples)))
    return overview_figure(stream.overview(), named, title="a title", **more)


def panel(figure: Any, ylabel: str) -> Any:
    return next(axes for axes in figure.axes if axes.get_ylabel().startswith(ylabel))


def bars(axes: Any) -> list[tuple[float, float, float]]:
    """Return begin, end and row of every bar."""
    boxes = [path.get_extents() for collection in axes.collections for path in collection.get_paths()]
    return sorted((box.x0, box.x1, (box.y0 + box.y1) / 2) for box in boxes)


@pytest.fixture
def samples() -> np.ndarray:
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(2, 30_000))
    samples[1] += 5 * np.sin(2 * np.pi * 2000 * np.arange(30_000) / RATE)
    samples[0, 12_345] = 40.0
    return samples


def test_the_panels_show_what_is_there(samples: np.ndarray) -> None:
    figure = figure_of(samples, Channel(name="near", unit="m/s^2"), Channel(name="far", unit="m/s^2"))
    waveform, spectrogram, spectrum = (panel(figure, name) for name in ("acceleration", "frequency", "power"))
    assert waveform.get_ylabel() == "acceleration [m/s²]" and waveform.get_title(loc="left") == "channel near"
    drawn = np.concatenate([path.vertices for path in waveform.collections[0].get_paths()])
    # The spike of a single sample is there, where it is and as high as it is.
    assert drawn[drawn[:, 1] == 40.0, 0] == pytest.approx(12_345 / RATE, abs=16 / RATE)
    assert drawn[:, 1].min() == samples[0].min() and waveform.get_ylim()[1] > 40
    assert waveform.get_xlim() == spectrogram.get_xlim() == (0, 30_000 / RATE)
    assert spectrogram.get_xlabel() == "time [s]" and spectrogram.get_ylabel() == "frequency [Hz]"
    assert spectrogram.get_ylim()[1] == RATE / 2
    mesh = spectrogram.collections[0]
    bottom, top = mesh.get_clim()
    assert 30 <= top - bottom <= 90 and top % 5 == bottom % 5 == 0
    assert [axes.get_ylabel() for axes in figure.axes].count("dB re 1 (m/s²)²/Hz") == 2
    frequency, density = scipy_signal.welch(samples, RATE, nperseg=256)
    for line, truth in zip(spectrum.lines, density, strict=True):
        np.testing.assert_allclose(line.get_xdata(), frequency[1:])
        np.testing.assert_allclose(line.get_ydata(), 10 * np.log10(truth[1:]), atol=1e-9)
    assert [text.get_text() for text in spectrum.get_legend().get_texts()] == ["near", "far"]
    low, high = spectrum.get_ylim()
    assert low <= np.quantile(10 * np.log10(density[:, 1:]), 0.01) and high >= 10 * np.log10(density.max())


def test_a_part_has_the_time_of_the_whole(samples: np.ndarray) -> None:
    figure = figure_of(samples[:1, :2560], begin=7.0, marks=[Mark(time=7.02, end=7.03, label="impact")])
    assert figure.axes[0].get_xlim() == (7.0, 7.1) and bars(figure.axes[0])[0][:2] == (7.02, 7.03)
    assert panel(figure, "frequency").collections[0].get_coordinates()[0, :, 0].min() > 7.0


@pytest.mark.long
@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_takes_text_of_anybody(suffix: str) -> None:
    evil = "$\\frac{ <b>&amp; 煤矿 \x00\n\ud800 ^_" + "x" * 300
    samples = np.random.default_rng(1).normal(size=(2, 700)) * [[1e-30], [1e30]]
    marks = [Mark(time=0.01, end=0.02, label=evil, channel=evil)]
    channels = Channel(name=evil, unit=None), Channel(name="$", unit="µm/m")
    content = picture(figure_of(samples, *channels, marks=marks, facts=evil), suffix, dpi=40)
    assert content.startswith(MAGIC[suffix])
    if suffix == ".svg":
        root = ElementTree.fromstring(content)
        links = [value for node in root.iter() for name, value in node.attrib.items() if name.endswith("href")]
        assert all(link.startswith(("#", "data:image/png")) for link in links)


def test_the_picture_of_shares_shows_interval_threshold_and_turn() -> None:
    from cgid.identification.prediction.fraction import ShareWindow, ShutDecision

    window, rule = ShareWindow(20.0), ShutDecision(3.0)
    shares, turns = [], []
    for time in range(1, 60):
        window.add(time, 0.02 if time < 30 else 0.98)
        shares.append(window.at(time))
        turns += [turn for turn in [rule.watch(shares[-1])] if turn is not None]
    figure = share_figure(shares, turns, 60.0, threshold=rule.threshold)
    (axes,) = figure.axes
    share, threshold, turn = axes.lines
    np.testing.assert_array_equal(share.get_ydata(), [one.share for one in shares])
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == min(one.low for one in shares) and band[:, 1].max() == max(one.high for one in shares)
    assert set(threshold.get_ydata()) == {0.25} and set(turn.get_xdata()) == {turns[0].time}
    assert axes.get_ylabel() == "gangue fraction" and axes.texts[0].get_text() == "shut"


def test_the_curve_of_the_operators_is_that_of_a_slow_count() -> None:
    """One share that rises in steps, and two channels, of which the second never shuts."""
    from cgid.identification.prediction.fraction import Share, Switch

    def share(time: float, mean: float, channel: str) -> Share:
        own = {"start": time - 10.0, "share": mean, "low": 0.0, "high": 1.0, "n_impacts": 20, "mean": mean}
        return Share(time=time, channel=channel, **own)

    rises = [share(10.0 * k, level, "1") for k, level in enumerate((0.1, 0.1, 0.5, 0.9, 0.9), start=1)]
    turn = Switch(time=31.0, shut=True, cost=0.1, evidence=0.96, share=rises[2])
    times = {"1": np.arange(0.25, 50, 0.5), "2": np.arange(0.5, 50, 1.0)}
    figure = drawn_figure(times, [*rises, *(replace(one, channel="2", mean=0.2) for one in rises)], [turn])
    (axes,) = figure.axes
    coal = gangue = 0.0
    found = []
    for time in times["1"]:
        # Windows are those of their middles, 5 to 45 s, and the share is straight between them.
        chance = float(np.interp(time, [5, 15, 25, 35, 45], [0.1, 0.1, 0.5, 0.9, 0.9]))
        coal, gangue = coal + 1 - chance, gangue + chance
        found.append((coal, gangue / (coal + gangue)))
    recovered, dilution = np.array(found).T * [[100 / coal], [100]]
    curves = {line.get_label(): line for line in axes.lines}
    np.testing.assert_allclose(curves["channel 1"].get_xdata(), recovered[20:])
    np.testing.assert_allclose(curves["channel 1"].get_ydata(), dilution[20:])
    np.testing.assert_allclose(curves["channel 2"].get_ydata(), 20.0)
    (shut,) = (line for line in axes.lines if line.get_marker() == "s")
    after = np.flatnonzero(times["1"] >= 31)[0]
    assert (shut.get_xdata()[0], shut.get_ydata()[0]) == pytest.approx((recovered[after], dilution[after]))
    (told,) = (text.get_text() for text in axes.texts if "SHUT" in text.get_text())
    assert told.startswith("SHUT at 31 s")


@pytest.fixture
def wav(tmp_path: Path) -> Path:
    """Two channels of noise with four blows, 16 bit."""
    rng = np.random.default_rng(3)
    samples = rng.normal(0, 30, (2, 40_000))
    ringing = 12_000 * np.exp(-np.arange(3000) / 300) * np.sin(2 * np.pi * 3000 * np.arange(3000) / RATE)
    for row, start in ((0, 9000), (0, 20_000), (0, 31_000), (1, 20_000)):
        samples[row, start : start + 3000] += ringing
    path = tmp_path / "blows.wav"
    with wave.open(str(path), "wb") as file:
        file.setparams((2, 2, int(RATE), 0, "NONE", ""))
        file.writeframes(samples.T.astype("<i2").tobytes())
    return path


def test_plot_finds_the_impacts(wav: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plot", str(wav), "-o", str(tmp_path / "a.png"), "--json"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert told["impacts"] == 4 and told["channels"] == ["1", "2"] and told["duration_s"] == 40_000 / RATE
    assert err == f"wrote {tmp_path / 'a.png'}\n" and (tmp_path / "a.png").read_bytes().startswith(MAGIC[".png"])
    part = ["plot", str(wav), "-o", str(tmp_path / "b.SVG"), "--json", "--channel", "1", "--from", "0.6", "--to", "1"]
    assert run(part) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["impacts"], told["from_s"], told["channels"]) == (1, 0.6, ["1"])
    assert told["duration_s"] == pytest.approx(0.4)
    assert (tmp_path / "b.SVG").read_bytes().startswith(MAGIC[".svg"])


def test_plot_draws_what_gaps_leave(wav: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    samples = open_recording(wav, full_scale="1 g").signals()[0].samples.copy()
    samples[25_000:27_000] = np.nan
    np.save(tmp_path / "gap.npy", samples)
    told = ["plot", str(tmp_path / "gap.npy"), "--rate", str(RATE), "--unit", "g", "-o", str(tmp_path / "a.png")]
    assert run([*told, "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["impacts"] == 3 and "2000 samples" in err


def test_plot_draws_one_signal_of_a_dataset(tmp_path: Path, reference_scene: Any, capsys: Any) -> None:
    generate(reference_scene, tmp_path / "data.h5", 5, seed=1)
    picked = ["plot", str(tmp_path / "data.h5"), "-o", str(tmp_path / "a.pdf"), "--set", "index=3", "--json"]
    assert run(picked) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["impacts"] == 1 and told["source"].endswith("data.h5 index 3")
    assert run(["plot", str(tmp_path / "data.h5"), "-o", str(tmp_path / "b.pdf")]) == 65
    assert "index=0" in capsys.readouterr().err


def test_coal_and_gangue_have_one_colour_everywhere() -> None:
    """In pictures, with whatever other labels, on the live page, the page of labels and in the documentation."""
    coal, gangue = COLOURS[:2]
    for labels in (["coal"], ["gangue"], ["gangue", "unknown"], ["brass", "coal", "gangue", "steel"]):
        drawn = colours_of(labels)
        assert [drawn.get("coal", coal), drawn.get("gangue", gangue)] == [coal, gangue]
        assert len(set(drawn.values())) == len(labels)
    root = Path(__file__).parents[1]
    sheets = {
        name: (root / name).read_text(encoding="utf-8") for name in ("cgid/pages/common.css", "docs/_static/cgid.css")
    }
    sheets |= {path.name: path.read_text(encoding="utf-8") for path in root.glob("cgid/*/*.css")}
    stated = [found for text in sheets.values() for found in re.findall(r"--(?:color-)?(coal|gangue): (#\w+)", text)]
    assert set(stated) == {("coal", coal), ("gangue", gangue)}
    assert len(stated) >= 4
