"""Label tracks of Audacity: begin, end [s] and text in a line, divided by tabs."""

from __future__ import annotations

import math
import warnings
from bisect import bisect_left
from collections.abc import Iterable, MutableMapping, Sequence
from pathlib import Path

from cgid._lib.files import read_regular
from cgid._lib.validation import shown
from cgid.errors import BadData

#: Text of an impact without a label, and largest size of a track [bytes].
UNLABELLED, _MAX_SIZE = "?", 16 << 20
#: A mark at an instant is of the impact within this time [s].
_NEAR = 0.05


def track_text(rows: Iterable[MutableMapping[str, str]]) -> str:
    r"""Return a label track with a mark for each row of a table of impacts.

    >>> track_text([{"time_s": "0.5", "end": "0.52", "label": "coal"}, {"time_s": "2", "end": "2.1", "label": ""}])
    '0.500000\t0.520000\tcoal\n2.000000\t2.100000\t?\n'
    """
    return "".join(
        f"{float(row['time_s']):.6f}\t{float(row['end']):.6f}\t{row['label'] or UNLABELLED}\n" for row in rows
    )


def read_track(path: Path) -> list[tuple[float, float, str]]:
    """Return begin, end [s] and text of the marks with a label; `BadData` names the first line that is none."""
    found = []
    lines = read_regular(path, "a label track", _MAX_SIZE).decode("utf-8-sig", "replace").splitlines()
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("\\"):  # the frequencies of a spectral selection
            continue
        begin, end, text = (*line.split("\t", 2), "", "")[:3]
        try:
            span = float(begin.replace(",", ".")), float(end.replace(",", "."))
        except ValueError:
            span = math.nan, math.nan
        if span[0] <= span[1] < 0:
            warnings.warn(f"{path}: line {number}: the mark is before the recording and is left out", stacklevel=2)
            continue
        if not -math.inf < span[0] <= span[1] < math.inf:
            raise BadData(
                f"{path}: line {number}: a label track must have begin and end in s and a text, divided by tabs, got "
                f"{shown(line)}; export it by File, Export Labels"
            )
        if text.strip() not in ("", UNLABELLED):
            found.append((*span, text.strip()))
    return found


def fill_in(
    rows: Sequence[MutableMapping[str, str]], marks: Iterable[tuple[float, float, str]], by: str = "audacity"
) -> tuple[int, int]:
    """Give the labels of marks to rows, in order of time, and return how many rows have one, and marks without a row.

    A longer mark is given first, so that shorter ones in it prevail.
    """
    times, lost = [float(row["time_s"]) for row in rows], 0
    for begin, end, text in sorted(marks, key=lambda mark: mark[0] - mark[1]):
        margin = _NEAR if begin == end else 1e-3
        inside = range(bisect_left(times, begin - margin), bisect_left(times, end + margin))
        if begin == end and inside:
            inside = range(*(min((abs(times[k] - begin), k) for k in inside)[1] + step for step in (0, 1)))
        for k in inside:
            rows[k]["label"], rows[k]["by"] = text, by
        lost += not inside
    return sum(bool(row["label"]) for row in rows), lost
