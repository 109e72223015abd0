"""Tables and names of a model card, as Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from cgid.terminal import printable

#: Signs that Markdown, or the HTML in it, makes something of within a line; an underscore only beside a word.
_MARKS = re.compile(r"[\\`*\[\]<>&|~]|\b_|_\b|(?<=_)_|_(?=_)")


def plain(name: object) -> str:
    r"""Return a name out of a file as Markdown that shows it as it is.

    Examples
    --------
    >>> print(plain("<b>a|b"), plain("_coal_wet_"))
    \<b\>a\|b \_coal_wet\_
    """
    return _MARKS.sub(r"\\\g<0>", printable(str(name)))


def table(titles: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [
        f"| {' | '.join(titles)} |" if any(titles) else "|" + " |" * len(titles),
        "|" + "---|" * len(titles),
        *(f"| {' | '.join(map(str, row))} |" for row in rows),
    ]
