"""Figures: matplotlib without a screen, colours that everybody can tell apart, text of strangers, bytes of a file."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable
from typing import Any

from cgid.errors import MissingExtra

#: Blue, vermilion, green, purple, sky, orange of Okabe and Ito (jfly.uni-koeln.de/color, 2008): told apart by people of
#: every colour vision.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
#: What is no label of a model.
NEUTRAL = "#555555"
#: Kinds of pictures by the ending of a file's name, and what is left out so that equal figures give equal bytes.
FORMATS: dict[str, dict[str, None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
#: Families that also write Chinese, which matplotlib's own does not; the first that is installed helps out.
_CHINESE = ("Noto Sans CJK SC", "Source Han Sans SC", "WenQuanYi Zen Hei", "WenQuanYi Micro Hei", "Microsoft YaHei")
_CHINESE_TOO = ("SimHei", "PingFang SC", "Heiti SC", "Arial Unicode MS", "Droid Sans Fallback")


def require_matplotlib() -> Any:
    """Return matplotlib's Figure class, drawing without a screen.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("pictures need matplotlib, which is not installed: pip install 'cgid[plot]'") from None
    return Figure


def picture(figure: Any, suffix: str, dpi: float = 120) -> bytes:
    """Return a matplotlib figure as a file; the same figure gives the same bytes.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    suffix : str
        One of `FORMATS`.
    dpi : float
        Dots an inch, of a PNG picture and of what is dots in the others.
    """
    from matplotlib import rc_context

    stream = io.BytesIO()
    with rc_context({"svg.hashsalt": "cgid", "font.family": _families()}), warnings.catch_warnings():
        # A sign that no font has is drawn as a box, which says enough.
        warnings.filterwarnings("ignore", message=r"Glyph \d+")
        figure.savefig(stream, format=suffix[1:], dpi=dpi, metadata=FORMATS[suffix])
    return stream.getvalue()


def png(figure: Any) -> bytes:
    """Return a matplotlib figure as a PNG picture; the same figure gives the same bytes."""
    return picture(figure, ".png")


def colours_of(labels: Iterable[str]) -> dict[str, str]:
    """Return a colour for each label, in the order of the alphabet; "unknown" is grey.

    Examples
    --------
    >>> colours_of(["gangue", "unknown", "coal"])
    {'coal': '#0072b2', 'gangue': '#d55e00', 'unknown': '#555555'}
    """
    labels = set(labels)
    names = sorted(labels - {"unknown"})
    colours = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(names)}
    return colours | ({"unknown": NEUTRAL} if "unknown" in labels else {})


def plain(text: str, longest: int = 80) -> str:
    r"""Return text of a stranger as one line of at most so many signs.

    Examples
    --------
    >>> plain("a\x00 file\n"), plain("a rather long name.wav", 11)
    ('a file', 'a rat….wav')
    """
    line = " ".join("".join(sign if sign.isprintable() else " " for sign in text).split())
    half = longest // 2
    return line if len(line) <= longest else f"{line[:half]}…{line[1 - half :]}"


def _families() -> list[str]:
    from matplotlib import font_manager, rcParams

    installed = {font.name for font in font_manager.fontManager.ttflist}
    return [*rcParams["font.family"], *(name for name in (*_CHINESE, *_CHINESE_TOO) if name in installed)][:2]
