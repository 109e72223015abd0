"""Make datasets/caving.png: the recording of caving.toml with seed 0, its spectrogram and the shares of its labels.

python datasets/draw_caving.py [RECORDING.h5] [PICTURE.png]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.measure.overview import OverviewStream
from cgid.plots.figure import colours_of, png, require_matplotlib
from cgid.plots.recording import Clock, Mark, draw_marks, draw_spectrogram, draw_waveform
from cgid.recordings import Channel
from cgid.scene import generate_recordings, load_scene
from cgid.signals import Signal
from cgid.store.reading import Recording

FOLDER = Path(__file__).parent


def main(recording: str | None = None, picture: str = str(FOLDER / "caving.png")) -> None:
    """Draw a recording; without one make that of the scene first."""
    with tempfile.TemporaryDirectory() as folder:
        made = recording or generate_recordings(load_scene(FOLDER / "caving.toml"), Path(folder) / "caving.h5")
        opened = Recording(made)
        Path(picture).write_bytes(recording_picture(opened.signal(), opened.impacts()))


def recording_picture(recording: Signal, truth: Mapping[str, NDArray[Any]]) -> bytes:
    """Draw a generated recording as PNG: impacts, waveform, spectrogram and shares of the labels."""
    stream = OverviewStream(recording.sampling_rate)
    stream.feed(recording.samples[np.newaxis])
    overview, channel = stream.overview(), Channel(name=recording.channel, unit=recording.unit)
    clock, colours = Clock(0.0, recording.duration), colours_of(truth["label"].tolist())
    marks = [
        Mark(time=time, end=time, label=f"{label}, bounces" if bounce else label)
        for time, bounce, label in zip(*(truth[name].tolist() for name in ("time", "bounce", "label")), strict=True)
    ]
    rows = {name: colour for label, colour in colours.items() for name in (label, f"{label}, bounces")}
    figure = require_matplotlib()(figsize=(11, 8), layout="constrained")
    grid = figure.add_gridspec(4, 2, height_ratios=(0.22 * len(rows), 2, 2, 2), width_ratios=(1, 0.016), wspace=0.01)
    first = figure.add_subplot(grid[0, 0])
    waveform, spectrogram, shares = (figure.add_subplot(grid[row, 0], sharex=first) for row in (1, 2, 3))
    draw_marks(first, marks, rows, clock)
    draw_waveform(waveform, overview, 0, channel, clock)
    draw_spectrogram(spectrogram, figure.add_subplot(grid[2, 1]), overview, 0, channel, clock)
    _shares(shares, clock, recording.duration, truth, colours)
    for axes in (first, waveform, spectrogram):
        axes.tick_params(labelbottom=False)
    return png(figure)


def _shares(
    axes: Any,
    clock: Clock,
    duration: float,
    truth: Mapping[str, NDArray[Any]],
    colours: Mapping[str, str],
    width: float = 0.05,
) -> None:
    """Draw the fraction of each label among the rocks arriving near a time, in a Gaussian window."""
    first = truth["bounce"] == 0
    arrivals, labels = truth["time"][first], truth["label"][first]
    times = np.linspace(0, duration, 400)
    weights = np.exp(-0.5 * ((times[:, None] - arrivals) / (width * duration)) ** 2)
    total = np.maximum(weights.sum(axis=1), np.finfo(np.float64).tiny)
    for label, colour in colours.items():
        axes.plot(clock.of(times), weights[:, labels == label].sum(axis=1) / total, color=colour, label=label)
    axes.set(ylim=(0, 1), ylabel=f"share of the arriving rocks\n(within {width * duration:g} s)", xlabel=clock.title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="center left")


if __name__ == "__main__":
    main(*sys.argv[1:])
