"""Labels of stretches in tables: "10 to 40 s was coal" labels all that the table has in it, and what it has not.

A labelled row that contains others of its recording is a stretch. Rows in it without a label belong to it; rows with a
label of their own keep it, and the stretch is what remains around them.
"""

from __future__ import annotations

import math
import warnings
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from cgid._lib.terminal import counted

#: The place of a row in its file, and its cells.
Row = tuple[str, Mapping[str, Any]]
#: What a stretch takes from the rows in it where its own cell is empty.
_INHERITED = (
    *("group", "channel", "gain", "rate", "unit", "variable", "format", "sensitivity", "full_scale"),
    *("invert", "same_beam"),
)


def span_of(row: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return start and end of a row [s], None if they are no such times; the row is refused later.

    >>> span_of({"start": "10", "end": 40}), span_of({}), span_of({"start": "soon"})
    ((10.0, 40.0), (0.0, inf), None)
    """
    try:
        start, end = float(row.get("start") or 0.0), float(row.get("end") or math.inf)
    except (TypeError, ValueError):
        return None
    return (start, end) if 0 <= start < end else None


def resolved(source: str, rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """Return the labelled rows, none in another, and those without a label; a `UserWarning` names mixed stretches.

    What remains of a stretch around other rows has its whole span as "stretch".
    """
    spans = {number: span for number, (_, row) in enumerate(rows) if (span := span_of(row)) is not None}
    alike: dict[tuple[str, str], list[int]] = {}  # a stretch without a channel is of all channels of its recording
    for number in spans:
        row = rows[number][1]
        alike.setdefault((str(row.get("path")), str(row.get("channel") or "")), []).append(number)
    covered, pieces = set[int](), dict[int, list[Row]]()
    for (path, channel), numbers in alike.items():
        for_all = alike.get((path, ""), []) if channel else []
        inside = _inside(rows, spans, [*numbers, *(number for number in for_all if rows[number][1].get("label"))])
        for stretch, those in inside.items():
            if channel and stretch in for_all and not set(those) & set(numbers):
                continue
            covered |= {number for number in those if not rows[number][1].get("label")}
            pieces.setdefault(stretch, []).extend(_pieces(source, rows, spans, stretch, those))
    kept, without = list[Row](), list[Row]()
    for number, (where, row) in enumerate(rows):
        if number in pieces:
            kept += pieces[number]
        elif row.get("label"):
            kept.append((where, row))
        elif number not in covered:
            without.append((where, row))
    return kept, without


def _inside(
    rows: Sequence[Row], spans: Mapping[int, tuple[float, float]], numbers: Sequence[int]
) -> dict[int, list[int]]:
    """Return the rows of a recording that each labelled one contains; a row is in the shortest that does."""
    middles = sorted((sum(spans[number]) / 2, number) for number in numbers)
    places = [middle for middle, _ in middles]
    inside: dict[int, list[int]] = {}
    taken = set[int]()
    for number in sorted(numbers, key=lambda one: spans[one][1] - spans[one][0]):
        start, end = spans[number]
        if not rows[number][1].get("label"):
            continue
        for _, other in middles[bisect_left(places, start) : bisect_right(places, end)]:
            first, last = spans[other]
            # An impact at an edge of a stretch drawn by hand belongs to it.
            contained = (start <= first and last <= end) or last - first <= (end - start) / 2
            same = spans[other] == spans[number] and rows[other][1].get("label")
            if other != number and other not in taken and contained and not same:
                taken.add(other)
                inside.setdefault(number, []).append(other)
    return inside


def _pieces(
    source: str, rows: Sequence[Row], spans: Mapping[int, tuple[float, float]], stretch: int, those: Sequence[int]
) -> list[Row]:
    """Return what remains of a stretch around the labelled rows in it."""
    where, row = rows[stretch]
    inner = rows[those[0]][1]
    row = {**{name: inner[name] for name in _INHERITED if inner.get(name)}, **row}
    own = [number for number in those if rows[number][1].get("label")]
    others = Counter(label for number in own if (label := rows[number][1]["label"]) != row["label"])
    start, end = spans[stretch]
    if others:
        listed = ", ".join(f"{counted(n, 'row')} labelled {label}" for label, n in sorted(others.items()))
        until = "its end" if end == math.inf else f"{end:g} s"
        warnings.warn(
            f"{source}: {where}: the stretch {start:g} s to {until} is {row['label']} and holds {listed}; these keep "
            "their labels",
            stacklevel=4,
        )
    row["chosen"] = row.get("chosen") or "stretch"
    edges = [start, *(edge for number in own for edge in spans[number]), end]
    pieces = [(first, last) for first, last in zip(edges[::2], edges[1::2], strict=True) if first < last]
    return [(where, {**row, "start": first, "end": last, "stretch": (start, end)}) for first, last in pieces]
