"""The ceiling of a scene against what could be improved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cgid.plots.figure import png, require_matplotlib


def survey_picture(points: Mapping[str, Sequence[Any]], present: Mapping[str, float], here: Any) -> bytes:
    """Return a PNG picture of the ceiling against noise, sampling rate and spread of sizes.

    Parameters
    ----------
    points : dict
        Of the axes "snr", "sampling_rate", "size_spread" the points (`cgid.ceiling.survey.Point`).
    present : dict of float
        Where the scene stands on each axis.
    here : Point
        The scene as it is.
    """
    titles = {
        "snr": "peak over noise [dB]",
        "sampling_rate": "sampling rate [Hz]",
        "size_spread": "largest over smallest rock",
    }
    figure = require_matplotlib()(figsize=(10, 3.6), layout="constrained")
    for axes, (axis, title) in zip(figure.subplots(1, 3, sharey=True), titles.items(), strict=True):
        held = sorted((p for p in points[axis] if np.isfinite(p.accuracy)), key=lambda p: p.value)
        for suffix, colour, name in (("", "C0", "drop height not known"), ("_known", "C1", "drop height known")):
            heights = [getattr(p, f"accuracy{suffix}") for p in held]
            errors = [2 * getattr(p, f"accuracy{suffix}_error") for p in held]
            axes.errorbar([p.value for p in held], heights, errors, fmt="o-", color=colour, capsize=2, label=name)
            if np.isfinite(present[axis]):
                axes.plot(present[axis], getattr(here, f"accuracy{suffix}"), "D", color=colour, mec="k", ms=8, zorder=3)
        if np.isfinite(present[axis]):
            axes.axvline(present[axis], color="0.7", zorder=0, label="now")
        if axis != "snr":
            axes.set_xscale("log")
        axes.set(xlabel=title)
        axes.grid(alpha=0.3)
    figure.axes[0].set(ylabel="highest accuracy possible (2 std. errors)")
    figure.axes[0].legend(fontsize="small")
    return png(figure)
