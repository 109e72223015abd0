"""The share of gangue as it goes on, and when to shut the window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cgid.plots.figure import COLOURS, plain, require_matplotlib
from cgid.plots.overview import MOST_CHANNELS, Clock

if TYPE_CHECKING:
    from cgid.identification.share import Share, Turn

#: Inches; the panels are as wide as those of the recording.
_WIDTH, _PANEL, _TITLE = 11.0, 1.9, 0.5
_LINE, _LIMIT = COLOURS[0], COLOURS[1]


def share_figure(
    shares: Sequence[Share], turns: Sequence[Turn], duration: float, *, threshold: float | None = None
) -> Any:
    """Return a figure of the share of gangue over time with its interval, a panel for each channel.

    Parameters
    ----------
    shares : sequence of Share
        At least one; of the first `MOST_CHANNELS` channels.
    turns : sequence of Turn
    duration : float
        Of the recording [s].
    threshold : float, optional
        The share above which going on costs more than it brings.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    names = list(dict.fromkeys(share.channel for share in shares))[:MOST_CHANNELS]
    figure = require_matplotlib()(figsize=(_WIDTH, _TITLE + _PANEL * len(names)), layout="constrained")
    clock = Clock(0.0, duration)
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        own = [share for share in shares if share.channel == name]
        _share(axes, own, clock)
        if threshold is not None:
            axes.axhline(
                threshold, color="0.4", ls="--", lw=1, label=f"above {threshold:.3g} going on costs more than it brings"
            )
        for turn in turns:
            if turn.share.channel == name:
                _turn(axes, turn, clock)
        if len(names) > 1:
            axes.set_title(f"channel {plain(name)}", loc="left", fontsize="medium", parse_math=False)
        axes.set(ylim=(0, 1), ylabel="share of gangue", xlim=clock.limits)
        axes.grid(alpha=0.3)
    panels[0].legend(loc="lower left", bbox_to_anchor=(0.15, 1.0), ncols=3, fontsize="small", frameon=False)
    panels[-1].set_xlabel(f"{clock.title}, ends of the windows")
    return figure


def _share(axes: Any, shares: Sequence[Share], clock: Clock) -> None:
    times = clock.of(np.array([share.time for share in shares]))
    low, mean, high = np.array([(share.low, share.share, share.high) for share in shares]).T
    axes.fill_between(times, low, high, color=_LINE, alpha=0.2, lw=0, label="95 % interval")
    axes.plot(times, mean, color=_LINE, marker="o", ms=3, lw=1.4, label="share of gangue")


def _turn(axes: Any, turn: Turn, clock: Clock) -> None:
    (place,) = clock.of(np.array([turn.time]))
    axes.axvline(place, color=_LIMIT, lw=1.8 if turn.shut else 1.0, ls="-" if turn.shut else ":")
    axes.annotate(
        "shut" if turn.shut else "open again",
        (place, 0.97),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="top",
        color=_LIMIT,
        fontsize="small",
        fontweight="bold" if turn.shut else "normal",
    )
