"""Pictures of recordings: waveform, spectrogram and spectrum with marked impacts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgid._lib.validation import Floats
from cgid.measure.overview import Overview
from cgid.plots.figure import COLOURS, colours_of, plain, require_matplotlib, written
from cgid.recordings import Channel

#: A picture with more channels is illegible.
MAX_CHANNELS = 8
#: Longest name of a channel in a legend [characters].
MAX_LABEL_LENGTH = 32
#: Longest and shortest range of a level scale [dB].
_DEEPEST, _SHALLOWEST = 90.0, 30.0
#: Largest number of marks that are also drawn through the waveform of a channel, if there is space.
_FEW_MARKS = 150
#: Smallest width of a mark relative to the time axis: with few marks, and with many.
_NARROWEST_MARK = (3e-3, 1.2e-3)
#: Shorter recordings [s] have a time axis in milliseconds.
_MILLISECONDS_BELOW = 0.5
#: Sizes [inches].
WIDTH, _TITLE, _STRIP_ROW, _WAVEFORM, _SPECTROGRAM, _SPECTRUM = 11.0, 0.6, 0.19, 1.5, 1.9, 2.7
#: Largest number of channels with rows of full size, and the factor that reduces the rows of more.
_FULL_SIZE, _SHRUNK = 3, 0.65
#: Space for text between two rows [inches].
_MARGIN = 0.35
_WAVEFORM_COLOUR = "#303030"


@dataclass(frozen=True, kw_only=True)
class Mark:
    """A labelled interval [s] of a recording, such as an impact; of all channels if none is named."""

    time: float
    end: float
    label: str
    channel: str | None = None


def overview_figure(
    overview: Overview,
    channels: Sequence[Channel],
    *,
    title: str,
    facts: str = "",
    marks: Sequence[Mark] = (),
    begin: float = 0.0,
) -> Any:
    """Return a figure of waveform and spectrogram of each channel and the spectra of all, with marks by label."""
    colours = colours_of(mark.label for mark in marks)
    by_channel = [[mark for mark in marks if mark.channel in (None, channel.name)] for channel in channels]
    told = [{(mark.time, mark.label) for mark in of_channel} for of_channel in by_channel]
    # Channels of one beam share their impacts, so the first of them has the rows of labels.
    has_strip = [bool(colours) and (k == 0 or told[k] != told[k - 1]) for k in range(len(channels))]
    shrunk = 1.0 if len(channels) <= _FULL_SIZE else _SHRUNK
    heights = []
    for has in has_strip:
        heights += [*[_STRIP_ROW * len(colours)] * has, _WAVEFORM * shrunk, _SPECTROGRAM * shrunk]
    heights.append(_SPECTRUM)
    figure = require_matplotlib()(figsize=(WIDTH, sum(heights) + _MARGIN * len(heights) + _TITLE), layout="constrained")
    figure.suptitle("\n".join(plain(line) for line in (title, facts) if line), parse_math=False, fontsize="medium")
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights, width_ratios=(1, 0.016), wspace=0.01)
    rows, clock, shared = iter(range(len(heights))), Clock(begin, begin + overview.duration), None
    for k, (channel, of_channel) in enumerate(zip(channels, by_channel, strict=True)):
        shared = top = waveform = figure.add_subplot(grid[next(rows), 0], sharex=shared)
        if has_strip[k]:
            draw_marks(top, of_channel, colours, clock)
            waveform = figure.add_subplot(grid[next(rows), 0], sharex=shared)
        top.set_title(_name(channel, len(channels)), loc="left", fontsize="medium", parse_math=False)
        draw_waveform(waveform, overview, k, channel, clock)
        if len(of_channel) <= _FEW_MARKS and sum(mark.end - mark.time for mark in of_channel) <= overview.duration:
            _shade(waveform, of_channel, colours, clock)
        row = next(rows)
        spectrogram, scale = (figure.add_subplot(grid[row, column], sharex=(shared, None)[column]) for column in (0, 1))
        draw_spectrogram(spectrogram, scale, overview, k, channel, clock)
        spectrogram.set_xlabel(clock.title)
        for axes in (top, waveform):
            axes.tick_params(labelbottom=False)
    _spectrum(figure.add_subplot(grid[next(rows), 0]), overview, channels)
    return figure


class Clock:
    """The time axis from `begin` to `end` [s], in seconds or milliseconds."""

    def __init__(self, begin: float, end: float) -> None:
        self.begin = begin
        self.factor, self.title = (1e3, "time [ms]") if end < _MILLISECONDS_BELOW else (1.0, "time [s]")
        self.limits = (begin * self.factor, end * self.factor)

    def of(self, times: Floats) -> Floats:
        """Convert times since the first sample of the overview [s] to the unit of the axis."""
        return np.asarray((times + self.begin) * self.factor)


def draw_waveform(axes: Any, overview: Overview, k: int, channel: Channel, clock: Clock) -> None:
    """Draw the range of samples in each column of channel `k`, or single samples if they fit."""
    edges = clock.of(overview.waveform_edges)
    lowest, highest = overview.lowest[k], overview.highest[k]
    if overview.waveform_step == 1:
        axes.plot(edges[:-1], lowest, color=_WAVEFORM_COLOUR, lw=0.8, marker="." if lowest.size < 3 else None)
    else:
        # Neighbouring columns must overlap; otherwise a steep waveform has gaps.
        low, high = lowest.copy(), highest.copy()
        low[1:] = np.minimum(low[1:], highest[:-1])
        high[1:] = np.maximum(high[1:], lowest[:-1])
        outline = (np.repeat(each, 2) for each in (low, high))
        axes.fill_between(np.repeat(edges, 2)[1:-1], *outline, fc=_WAVEFORM_COLOUR, ec=_WAVEFORM_COLOUR, lw=0.6)
    bottom, top = float(lowest.min()), float(highest.max())
    margin = 0.06 * (top - bottom) or 0.1 * abs(top) or 1.0
    axes.set(ylabel=_quantity(channel), xlim=clock.limits, ylim=(bottom - margin, top + margin))
    axes.grid(alpha=0.25)


def draw_spectrogram(axes: Any, scale: Any, overview: Overview, k: int, channel: Channel, clock: Clock) -> None:
    """Draw the spectrogram of channel `k` on `axes` and its colour scale on `scale`."""
    density = overview.spectrogram[k]
    if not density.size or not density.max() > 0:
        _nothing(axes, overview, "spectrogram")
        axes.set_xlim(clock.limits)
        scale.axis("off")
        return
    level = _decibels(density, density.max())
    bottom, top = _limits(np.quantile(level, [0.05, 0.9995]))
    edges = clock.of(overview.time_edges)
    mesh = axes.pcolormesh(
        edges, overview.band_edges, level, vmin=bottom, vmax=top, cmap="magma", rasterized=True, shading="flat"
    )
    axes.set(yscale="log", ylabel="frequency [Hz]", xlim=clock.limits, ylim=overview.band_edges[[0, -1]])
    axes.set_facecolor("0.85")
    _write_frequencies(axes.yaxis)
    axes.figure.colorbar(mesh, cax=scale, extend="both", label=f"dB re 1 {_density(channel.unit)}")


def draw_marks(axes: Any, marks: Sequence[Mark], colours: Mapping[str, str], clock: Clock) -> None:
    """Draw marks, with one row and a count for each label."""
    narrowest = _NARROWEST_MARK[len(marks) > _FEW_MARKS] * (clock.limits[1] - clock.limits[0])
    names = []
    for row, (label, colour) in enumerate(colours.items()):
        of_label = [mark for mark in marks if mark.label == label]
        spans = [(start, max(width, narrowest)) for start, width in _spans(of_label, clock)]
        axes.broken_barh(spans, (row - 0.4, 0.8), facecolors=colour, lw=0)
        axes.axhline(row + 0.5, color="0.85", lw=0.5)
        names.append(f"{plain(label, MAX_LABEL_LENGTH)} ({len(of_label)})")
    axes.set_yticks(range(len(names)), names, parse_math=False, fontsize="small")
    axes.set(xlim=clock.limits, ylim=(len(names) - 0.5, -0.5))
    axes.tick_params(length=0, axis="y")


def _spans(marks: Sequence[Mark], clock: Clock) -> list[tuple[float, float]]:
    """Return start and length of marks on the time axis."""
    return [(mark.time * clock.factor, (mark.end - mark.time) * clock.factor) for mark in marks]


def _shade(axes: Any, marks: Sequence[Mark], colours: Mapping[str, str], clock: Clock) -> None:
    """Shade the interval of each mark behind the waveform, and draw a line at its start."""
    for label, colour in colours.items():
        spans = _spans([mark for mark in marks if mark.label == label], clock)
        across = axes.get_xaxis_transform()
        axes.broken_barh(spans, (0, 1), transform=across, facecolors=colour, alpha=0.18, lw=0, zorder=0)
        begins = [start for start, _ in spans]
        axes.vlines(begins, 0, 1, transform=across, colors=colour, lw=0.8, alpha=0.6, zorder=0.5)


def _spectrum(axes: Any, overview: Overview, channels: Sequence[Channel]) -> None:
    """Draw the spectra of all channels in one plot."""
    highest = float(overview.spectrum[:, 1:].max(initial=0.0))
    if not highest > 0:
        _nothing(axes, overview, "spectrum")
        axes.set(xticks=[])
        return
    level = _decibels(overview.spectrum[:, 1:], highest)
    palette = list(colours_of(map(str, range(len(channels)))).values())
    for k, channel in enumerate(channels):
        style = "-" if k < len(COLOURS) else "--"
        axes.plot(
            overview.frequency[1:],
            level[k],
            style,
            color=palette[k],
            lw=1.1,
            label=plain(channel.name, MAX_LABEL_LENGTH),
        )
    units = {channel.unit for channel in channels}
    unit = _density(units.pop()) if len(units) == 1 else "unit²/Hz of each channel"
    limits = _limits(np.quantile(level, [0.002, 1]))
    axes.set(xscale="log", xlim=overview.frequency[[1, -1]], ylim=limits)
    axes.set(xlabel="frequency [Hz]", ylabel=f"power density\n[dB re 1 {unit}]")
    axes.set_title(f"mean spectrum (resolution {hertz(overview.frequency[1], 3)})", loc="left", fontsize="medium")
    axes.grid(alpha=0.3, which="both")
    _write_frequencies(axes.xaxis)
    if len(channels) > 1:
        legend = axes.legend(title="channel", fontsize="small", ncols=2 if len(channels) > 4 else 1)
        for text in legend.get_texts():
            text.set_parse_math(False)


def _decibels(density: Floats, highest: float) -> Floats:
    """Return levels [dB]; a density of 0 gets a finite level."""
    return 10 * np.log10(np.maximum(density, highest * 10 ** (-_DEEPEST / 10 - 3)))


def _limits(extremes: Floats) -> tuple[float, float]:
    """Return the limits of a level scale: multiples of 5 dB, between the shortest and the longest range."""
    top = 5.0 * float(np.ceil(extremes[1] / 5))
    bottom = 5.0 * float(np.floor(extremes[0] / 5))
    return min(max(bottom, top - _DEEPEST), top - _SHALLOWEST), top


def _write_frequencies(axis: Any) -> None:
    """Label an axis with 200 and 2k instead of powers of ten."""
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 5e3 * low else (1.0,), numticks=20))
    axis.set_major_formatter(EngFormatter(sep=""))
    axis.set_minor_formatter(NullFormatter())


def _nothing(axes: Any, overview: Overview, what: str) -> None:
    """Write the reason why there is no spectrum."""
    why = "all samples are equal" if overview.frequency.size else f"{overview.n_samples} samples are too few"
    axes.text(0.5, 0.5, f"no {what}: {why}", transform=axes.transAxes, ha="center", va="center", color="0.4")
    axes.set(yticks=[], ylabel=what)


def _name(channel: Channel, n_channels: int) -> str:
    return f"channel {plain(channel.name)}" if n_channels > 1 or channel.name != "1" else ""


def _quantity(channel: Channel) -> str:
    return f"{channel.quantity or 'signal'} [{written(channel.unit)}]"


def hertz(frequency: float, digits: int = 6) -> str:
    """Format a frequency [Hz] in Hz or kHz.

    >>> hertz(43.06640625, 3), hertz(44100.0)
    ('43.1 Hz', '44.1 kHz')
    """
    return f"{frequency:.{digits}g} Hz" if frequency < 1000 else f"{frequency / 1e3:.{digits}g} kHz"


def _density(unit: str | None) -> str:
    one = "unit" if unit is None else written(unit)
    return f"({one})²/Hz" if "/" in one else f"{one}²/Hz"
