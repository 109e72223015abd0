"""Matplotlib without a screen, colours and file formats; pictures of models."""

from __future__ import annotations

import io
import warnings
from collections.abc import Collection, Iterable
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.files import check_new
from cgid._lib.validation import Floats
from cgid.errors import optional

#: Blue, vermilion, green, purple, sky, orange of Okabe and Ito (jfly.uni-koeln.de/color, 2008); distinct for every
#: kind of colour vision.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
#: Coal and gangue have one colour each in all pictures and pages (`cgid/pages/common.css`).
_FIXED = {"coal": COLOURS[0], "gangue": COLOURS[1]}
#: Colour of everything other than the labels of a model.
NEUTRAL = "#555555"
#: Formats by file name ending, with the metadata to omit so that equal figures give equal bytes.
FORMATS: dict[str, dict[str, None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
#: Fonts with Chinese characters, which matplotlib's own font lacks; the first installed one is the fallback.
_CHINESE = ("Noto Sans CJK SC", "Source Han Sans SC", "WenQuanYi Zen Hei", "WenQuanYi Micro Hei", "Microsoft YaHei",
            "SimHei", "PingFang SC", "Heiti SC", "Arial Unicode MS", "Droid Sans Fallback")  # fmt: skip


def require_matplotlib() -> Any:
    """Return matplotlib's Figure class, which draws without a screen; raises `MissingExtra` without matplotlib."""
    return optional("matplotlib.figure", "pictures need", "plot", name="matplotlib").Figure


def new_picture(
    path: str | Path, what: str = "a picture", endings: Collection[str] = (".png",), *, overwrite: bool
) -> Path:
    """Return the path of a picture that may be created; raises as `check_new`, `MissingExtra` without matplotlib."""
    checked = check_new(Path(path), what, endings, overwrite=overwrite)
    require_matplotlib()
    return checked


def picture(figure: Any, suffix: str, dpi: float = 120) -> bytes:
    """Return a matplotlib figure as the content of a file; equal figures give equal bytes.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    suffix : str
        One of `FORMATS`.
    dpi : float
        Resolution of a PNG picture, and of rasterized parts in other formats [dots/inch].

    Returns
    -------
    bytes
    """
    from matplotlib import rc_context

    stream = io.BytesIO()
    with rc_context({"svg.hashsalt": "cgid", "font.family": _families()}), warnings.catch_warnings():
        # matplotlib draws a box for a character that no font has.
        warnings.filterwarnings("ignore", message=r"Glyph \d+")
        figure.savefig(stream, format=suffix[1:], dpi=dpi, metadata=FORMATS[suffix])
    return stream.getvalue()


def png(figure: Any) -> bytes:
    """Return a matplotlib figure as PNG; equal figures give equal bytes."""
    return picture(figure, ".png")


def colours_of(labels: Iterable[str]) -> dict[str, str]:
    """Return a colour for each label, in alphabetical order; "unknown" is grey.

    >>> colours_of(["gangue", "unknown", "coal"])
    {'coal': '#0072b2', 'gangue': '#d55e00', 'unknown': '#555555'}
    >>> colours_of(["gangue", "brass"])
    {'brass': '#009e73', 'gangue': '#d55e00'}
    """
    labels = set(labels)
    fixed = len(_FIXED)  # their colours come last where neither is drawn
    free = cycle(COLOURS[fixed:] if labels & set(_FIXED) else (*COLOURS[fixed:], *COLOURS[:fixed]))
    colours = {name: _FIXED.get(name) or next(free) for name in sorted(labels - {"unknown"})}
    return colours | ({"unknown": NEUTRAL} if "unknown" in labels else {})


def plain(text: str, longest: int = 80) -> str:
    r"""Return untrusted text as one printable line of at most `longest` characters.

    >>> plain("a\x00 file\n"), plain("a rather long name.wav", 11)
    ('a file', 'a rat….wav')
    """
    line = " ".join("".join(character if character.isprintable() else " " for character in text).split())
    half = longest // 2
    return line if len(line) <= longest else f"{line[:half]}…{line[1 - half :]}"


def written(unit: str | None) -> str:
    """Return a unit with the usual symbols."""
    if unit is None:
        return "unit unknown"
    return unit.replace("s**2", "s²").replace("s^2", "s²").replace("s2", "s²").replace("um", "µm").replace("uV", "µV")


def _families() -> list[str]:
    from matplotlib import font_manager, rcParams

    installed = {font.name for font in font_manager.fontManager.ttflist}
    return [*rcParams["font.family"], *(name for name in _CHINESE if name in installed)][:2]


def judgement_pictures(
    labels: NDArray[np.str_], probabilities: Floats, classes: tuple[str, ...], metrics: dict[str, Any]
) -> dict[str, bytes]:
    """Return PNG pictures of a model's test: "confusion", "reliability" and "roc"."""
    return {
        "confusion": _confusion(np.array(metrics["confusion"]), classes),
        "reliability": _reliability(metrics["reliability"]),
        "roc": _roc(labels, probabilities, classes),
    }


def _confusion(counts: NDArray[np.int_], classes: tuple[str, ...]) -> bytes:
    figure = require_matplotlib()(figsize=(4.2, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.imshow(counts / counts.sum(axis=1, keepdims=True), cmap="Greys", vmin=0, vmax=1)
    for (row, column), count in np.ndenumerate(counts):
        share = count / counts[row].sum()
        axes.text(column, row, f"{count}\n{share:.1%}", ha="center", va="center", color="w" if share > 0.5 else "k")
    axes.set(xticks=range(len(classes)), xticklabels=classes, xlabel="answer")
    axes.set(yticks=range(len(classes)), yticklabels=classes, ylabel="truth")
    return png(figure)


def _reliability(bins: list[list[float]]) -> bytes:
    """Draw the accuracy over the predicted probability, above the number of predictions in each bin."""
    figure = require_matplotlib()(figsize=(4.2, 4.8), layout="constrained")
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    confidence, accuracy, counts = zip(*bins, strict=True)
    axes.plot([0, 1], [0, 1], color="0.7", label="calibrated")
    axes.plot(confidence, accuracy, "o-", color=NEUTRAL, label="model")
    lowest = min(0.5, *confidence, *accuracy)
    axes.set(ylabel="fraction of correct predictions", xlim=(lowest, 1), ylim=(lowest, 1))
    axes.legend()
    gaps = [later - earlier for earlier, later in pairwise(confidence)]
    below.bar(confidence, counts, width=0.5 * min(gaps, default=0.1), color=NEUTRAL, alpha=0.6)
    for x, count in zip(confidence, counts, strict=True):
        below.annotate(f"{count:.0f}", (x, count), (0, 2), textcoords="offset points", ha="center", fontsize=6)
    below.margins(y=0.25)
    below.set(xlabel="predicted probability", ylabel="answers", xlim=(lowest, 1))
    return png(figure)


def _roc(labels: NDArray[np.str_], probabilities: Floats, classes: tuple[str, ...]) -> bytes:
    from sklearn.metrics import roc_curve

    figure = require_matplotlib()(figsize=(4.2, 3.8), layout="constrained")
    axes = figure.subplots()
    for column, label in enumerate(classes):
        wrong, right, _ = roc_curve(labels == label, probabilities[:, column])
        axes.plot(wrong, right, color=colours_of(classes)[label], label=label)
    axes.plot([0, 1], [0, 1], color="0.7")
    axes.set(xlabel="false positive rate", ylabel="true positive rate")
    axes.legend()
    return png(figure)


def modes_picture(before: Any, after: Any) -> bytes:
    """Return learned modes against the initial ones as PNG, with two standard deviations as bars or as a band."""
    figure = require_matplotlib()(figsize=(9, 6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    x = before.frequency / 1e3
    change = 100 * (after.frequency / before.frequency - 1)
    upper.fill_between(x, -200 * before.deviation[0], 200 * before.deviation[0], color="0.9", label="before")
    upper.axhline(0.0, color="0.6", lw=0.8)
    upper.errorbar(x, change, 200 * after.deviation[0], fmt=".", color=NEUTRAL, capsize=2, label="after")
    upper.set(ylabel="change of frequency [%]\n(2 std. deviations)")
    damping = 100 * before.damping_ratio
    spread = np.exp(2 * before.deviation[1])
    lower.fill_between(x, damping / spread, damping * spread, color="0.9")
    lower.plot(x, damping, color="0.6", lw=0.8)
    ratio = 100 * after.damping_ratio
    bars = (
        ratio - ratio * np.exp(-2 * after.deviation[1]),
        ratio * np.expm1(2 * after.deviation[1]),
    )
    lower.errorbar(x, ratio, bars, fmt=".", color=NEUTRAL, capsize=2)
    lower.set(xlabel="natural frequency before [kHz]", ylabel="damping ratio [%]", yscale="log")
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    upper.legend(fontsize="small")
    return png(figure)


def stabilisation_picture(test: Any) -> bytes:
    """Return the poles of all orders of a tap test as PNG, and the modes' damping with two standard deviations.

    With a hammer channel the frequency response is in front of the poles, and its coherence in between.
    """
    figure = require_matplotlib()(figsize=(10, 8), layout="constrained")
    from matplotlib.ticker import LogLocator

    found = test.frequency_response
    ratios = (3, 2) if found is None else (4, 1, 2)
    upper, *middle, lower = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios)
    if found is not None:
        front, kilohertz = upper.twinx(), found.frequency / 1e3
        for name, colour in (("measured", "0.3"), ("modelled", COLOURS[1])):
            front.semilogy(kilohertz, np.abs(getattr(found, name)), color=colour, lw=1, label=name)
        front.set(ylabel=f"{found.quantity} over force [SI]")
        middle[0].plot(kilohertz, found.coherence, color="0.3", lw=0.8)
        middle[0].set(ylabel="coherence", ylim=(0, 1.05))
        middle[0].grid(alpha=0.3)
    order, frequency, _, stable = test.poles.chart.T
    for value, colour, label in ((0, "0.8", "unstable"), (1, NEUTRAL, "stable")):
        rows = stable == value
        upper.plot(frequency[rows] / 1e3, order[rows], ".", color=colour, ms=4, label=label)
    modes = test.modes
    for mode in modes.frequency / 1e3:
        upper.axvline(mode, color=COLOURS[0], lw=0.6, zorder=0)
    upper.set(ylabel="order of the model in its band")
    figure.legend(fontsize="small", loc="outside upper right", ncols=4)
    ratio = 100 * modes.damping_ratio
    spread = np.exp(2 * modes.deviation[1])
    lower.errorbar(
        modes.frequency / 1e3,
        ratio,
        (ratio - ratio / spread, ratio * spread - ratio),
        fmt=".",
        color=COLOURS[0],
        capsize=2,
    )
    lower.set(xlabel="frequency [kHz]", ylabel="damping ratio [%]\n(2 std. deviations)", yscale="log")
    lower.yaxis.set_major_locator(LogLocator(subs=(1, 1.2, 1.5, 2, 3, 5, 7)))
    lower.yaxis.set_major_formatter("{x:.2g}")
    lower.yaxis.set_minor_formatter("")
    lower.grid(alpha=0.3)
    return png(figure)
