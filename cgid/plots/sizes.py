"""The picture of a distribution of sizes."""

from __future__ import annotations

from typing import Any

import numpy as np

from cgid.plots.figure import COLOURS, picture, plain, require_matplotlib


def sizes_picture(distribution: Any, source: str, suffix: str = ".png", truth: Any = None) -> bytes:
    """Return how many impacts were of each class of size, found and corrected, as the content of a file.

    Parameters
    ----------
    distribution : SizeDistribution
    source : str
        What was recorded.
    suffix : str
        One of `cgid.plots.FORMATS`.
    truth : ndarray, (n_classes,), optional
        The true number of impacts of each class.

    Returns
    -------
    bytes
    """
    figure = require_matplotlib()(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    draw_sizes(axes, distribution, truth)
    axes.set(title=plain(source))
    return picture(figure, suffix)


def draw_sizes(axes: Any, distribution: Any, truth: Any = None) -> None:
    """Draw a distribution of sizes, with the true numbers if known, (n_classes,)."""
    units = {"mass": "mass [kg]", "radius": "radius [m]", "speed": "speed [m/s]"}
    edges = distribution.edges
    middle = np.sqrt(edges[1:] * edges[:-1])
    axes.stairs(distribution.found, edges, color="0.6", fill=True, alpha=0.5, label="found")
    known = np.isfinite(distribution.total)
    below = (distribution.total - distribution.low_total)[known].clip(0)
    above = (distribution.high_total - distribution.total)[known].clip(0)
    axes.errorbar(
        middle[known], distribution.total[known], (below, above), fmt="o", ms=4, capsize=2, color=COLOURS[0],
        label="corrected for what is not found (90 %)",
    )  # fmt: skip
    if truth is not None:
        axes.stairs(truth, edges, color=COLOURS[1], lw=1.5, label="truth")
    lacking = np.flatnonzero(~known)
    if lacking.size and lacking[0] == 0:
        last = int(np.argmax(known)) if known.any() else known.size
        axes.axvspan(edges[0], edges[last], color="0.92", zorder=0, label="too small to be found")
    axes.set(xscale="log", xlabel=units[distribution.quantity], ylabel="impacts")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)
