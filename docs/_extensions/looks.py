"""How pictures of the gallery look: the colours of the package, lines that a thumbnail shows."""

from __future__ import annotations

from typing import Any

from matplotlib import cycler, pyplot

from cgid.plots.figure import COLOURS


def package(gallery_conf: dict[str, Any], name: str) -> None:
    """Set the defaults of matplotlib before each example."""
    pyplot.rcdefaults()
    pyplot.rcParams |= {
        "axes.prop_cycle": cycler(color=COLOURS),
        "axes.spines.right": False,
        "axes.spines.top": False,
        "font.size": 13.0,
        "legend.frameon": False,
        "lines.linewidth": 2.5,
    }
