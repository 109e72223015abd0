"""What a notebook shows of an object: a small table."""

from __future__ import annotations

from collections.abc import Mapping


def facts_table(title: str, facts: Mapping[str, object]) -> str:
    """Return a table of facts as HTML; all text is escaped.

    >>> facts_table("Signal", {"unit": "N"})
    '<table><caption>Signal</caption><tr><th scope="row">unit</th><td>N</td></tr></table>'
    """
    from html import escape

    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(str(value))}</td></tr>' for name, value in facts.items()
    )
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"


def counts_text(counts: Mapping[str, int]) -> str:
    """Return how many there are of each label, as in "coal 3, gangue 5".

    >>> counts_text({"coal": 3, "gangue": 5})
    'coal 3, gangue 5'
    """
    return ", ".join(f"{label} {count}" for label, count in counts.items())
