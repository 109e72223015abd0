"""Pictures of a recording's predictions: gangue fractions, the operators' curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cgid._lib.validation import Floats
from cgid.plots.figure import COLOURS, colours_of, plain, require_matplotlib
from cgid.plots.recording import MAX_CHANNELS, MAX_LABEL_LENGTH, WIDTH, Clock

if TYPE_CHECKING:
    from cgid.identification.prediction.fraction import Share, Switch

#: Height of a panel of gangue fractions and of the title [inches].
_SHARE_PANEL, _SHARE_TITLE = 1.9, 0.5
#: Colour of the gangue fraction, and of decisions.
_LINE, _LIMIT = COLOURS[1], "0.1"
#: Height of the operators' curve [inches], rocks before its first point, and times between its marks [s].
_DRAWN_HEIGHT, _FIRST_ROCKS, _STEPS = 4.2, 20, (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0, 600.0, 3600.0)


def share_figure(
    shares: Sequence[Share], turns: Sequence[Switch], duration: float, *, threshold: float | None = None
) -> Any:
    """Draw the gangue fraction over time with its interval, in one panel per channel.

    Parameters
    ----------
    shares : sequence of Share
        At least one; only the first `MAX_CHANNELS` channels are plotted.
    turns : sequence of Switch
    duration : float
        Duration of the recording [s].
    threshold : float, optional
        Gangue fraction above which further caving costs more than it brings.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    names = list(dict.fromkeys(share.channel for share in shares))[:MAX_CHANNELS]
    figure = require_matplotlib()(figsize=(WIDTH, _SHARE_TITLE + _SHARE_PANEL * len(names)), layout="constrained")
    clock = Clock(0.0, duration)
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        of_channel = [share for share in shares if share.channel == name]
        _share(axes, of_channel, clock)
        if threshold is not None:
            axes.axhline(
                threshold, color="0.4", ls="--", lw=1, label=f"above {threshold:.3g} going on costs more than it brings"
            )
        for switch in turns:
            if switch.share.channel == name:
                _draw_switch(axes, switch, clock)
        if len(names) > 1:
            axes.set_title(f"channel {plain(name)}", loc="left", fontsize="medium", parse_math=False)
        axes.set(ylim=(0, 1), ylabel="gangue fraction", xlim=clock.limits)
        axes.grid(alpha=0.3)
    panels[0].legend(loc="lower left", bbox_to_anchor=(0.15, 1.0), ncols=3, fontsize="small", frameon=False)
    panels[-1].set_xlabel(f"{clock.title}, ends of the windows")
    return figure


def _share(axes: Any, shares: Sequence[Share], clock: Clock) -> None:
    times = clock.of(np.array([share.time for share in shares]))
    low, mean, high = np.array([(share.low, share.share, share.high) for share in shares]).T
    axes.fill_between(times, low, high, color=_LINE, alpha=0.2, lw=0, label="95 % interval")
    axes.plot(times, mean, color=_LINE, marker="o", ms=3, lw=1.4, label="gangue fraction")


def _draw_switch(axes: Any, switch: Switch, clock: Clock) -> None:
    (x,) = clock.of(np.array([switch.time]))
    axes.axvline(x, color=_LIMIT, lw=1.8 if switch.shut else 1.0, ls="-" if switch.shut else ":")
    axes.annotate(
        "shut" if switch.shut else "open again",
        (x, 0.97),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="top",
        color=_LIMIT,
        fontsize="small",
        fontweight="bold" if switch.shut else "normal",
    )


def drawn_figure(times: Mapping[str, Floats], shares: Sequence[Share], turns: Sequence[Switch]) -> Any:
    """Return a figure of the cumulative gangue fraction against the recovered coal, one curve per channel."""
    names = list(times)[:MAX_CHANNELS]
    figure = require_matplotlib()(figsize=(WIDTH, _DRAWN_HEIGHT), layout="constrained")
    axes = figure.subplots()
    for name, colour in zip(names, colours_of(names).values(), strict=True):
        of_channel = [share for share in shares if share.channel == name]
        title = f"channel {plain(name, MAX_LABEL_LENGTH)}" if len(names) > 1 else "predicted"
        shut = [switch.time for switch in turns if switch.shut and switch.share.channel == name]
        draw_drawn(axes, times[name], gangue_at(times[name], of_channel), shut, colour=colour, title=title)
    finish_drawn(axes)
    return figure


def gangue_at(times: Floats, shares: Sequence[Share]) -> Floats:
    """Return the expected gangue fraction at some times [s], between the middles of windows of one channel."""
    points = [((share.start + share.time) / 2, share.mean) for share in shares if share.is_known]
    return np.asarray(np.interp(times, *np.array(points).T))


def draw_drawn(
    axes: Any,
    times: Floats,
    gangue: Floats,
    shut: Sequence[float] = (),
    *,
    colour: str,
    title: str,
    width: float = 2.2,
    says_times: bool = True,
) -> None:
    """Draw the operators' curve of one support: gangue fraction against time [s], and SHUT."""
    from matplotlib.patheffects import withStroke

    # The fraction of the first rocks is random.
    recovered, share = np.cumsum(1 - gangue) / np.sum(1 - gangue), np.cumsum(gangue) / np.arange(1, len(gangue) + 1)
    shown = np.arange(len(gangue)) >= min(_FIRST_ROCKS, len(gangue) // 2)
    axes.plot(100 * recovered[shown], 100 * share[shown], color=colour, lw=width, label=title)
    settings: dict[str, Any] = {"textcoords": "offset points", "color": colour, "fontsize": "small", "zorder": 5}
    settings["path_effects"] = [withStroke(linewidth=3, foreground="w")]
    step = next(step for step in _STEPS if times[-1] <= 8 * step or step == _STEPS[-1])
    for mark in np.arange(step, times[-1], step):
        row = np.searchsorted(times, mark)
        if shown[row]:
            point = 100 * recovered[row], 100 * share[row]
            axes.plot(*point, "o", color=colour, ms=2.2 * width)
            axes.annotate(f"{mark:g} s" if says_times else "", point, (5, -5), va="top", **settings)
    for time in shut:
        row = min(int(np.searchsorted(times, time)), len(times) - 1)
        point = 100 * recovered[row], 100 * share[row]
        axes.plot(*point, "s", color=colour, ms=9, mec="k", mew=1, zorder=4)
        axes.annotate(
            f"SHUT at {time:.0f} s:\n{point[0]:.0f} % of the coal,\n{point[1]:.0f} % gangue in all",
            point,
            (-45, 16),
            ha="right",
            fontweight="bold",
            arrowprops={"arrowstyle": "-", "color": colour},
            **settings,
        )


def finish_drawn(axes: Any) -> None:
    """Name the axes of the operators' curve."""
    axes.set(xlim=(0, 100), xlabel="recovered coal [% of the recording]", ylabel="cumulative gangue fraction [%]")
    axes.set_ylim(0, 100)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    if len(axes.get_legend_handles_labels()[1]) > 1:
        for text in axes.legend(fontsize="small", loc="upper left").get_texts():
            text.set_parse_math(False)
