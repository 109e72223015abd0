"""How the rows of a text file are divided into numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

#: What the parsers of C and of Python both take for a number; no underscores, no other scripts' digits.
NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.ASCII | re.IGNORECASE)

#: The delimiter of columns that are divided by commas here and by blanks there.
MIXED = ", "

_COMMENT = ("#", "%", "//")
_QUOTES = str.maketrans("\"'", "  ")


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The division of a row.

    Parameters
    ----------
    delimiter : str or None
        One character, `MIXED`, or None for any run of blanks.
    n_columns : int
        Without the empty one behind a trailing delimiter.
    decimal_comma : bool
        The decimal mark is a comma.
    trailing : bool
        Each row ends in a delimiter.
    stamp : int or None
        The column that holds times of day, which are turned into seconds before a row is divided.
    """

    delimiter: str | None
    n_columns: int
    decimal_comma: bool = False
    trailing: bool = False
    stamp: int | None = None

    def fields(self, line: str) -> list[str]:
        """Return the fields of a row, without quotes and blanks around them.

        Examples
        --------
        >>> Layout(delimiter=";", n_columns=2).fields(' "1,5"; 2 ')
        ['1,5', '2']
        """
        line = line.translate(_QUOTES)
        if self.delimiter is None:
            return line.split()
        if self.delimiter == MIXED:
            return re.split(r"[,\s]+", line.strip(" \t\r\n,"))
        fields = [field.strip() for field in line.split(self.delimiter)]
        return fields[:-1] if self.trailing and not fields[-1] else fields

    def number(self, field: str) -> str | None:
        """Return a field in the notation of Python, None if it is no number.

        Examples
        --------
        >>> Layout(delimiter=";", n_columns=2, decimal_comma=True).number("1,5")
        '1.5'
        """
        if self.decimal_comma:
            # A point beside a decimal comma would divide thousands, or the comma does.
            field = "" if "." in field else field.replace(",", ".")
        return field if NUMBER.fullmatch(field) else None

    def parser(self) -> tuple[str | None, dict[str, str]]:
        """Return the delimiter for `numpy.loadtxt` and the characters to be exchanged before it."""
        exchange = {'"': " ", "'": " "}
        if self.decimal_comma:
            exchange[","] = "."
        if self.delimiter == MIXED or (self.trailing and self.delimiter is not None):
            exchange[self.delimiter[0]] = " "
            return None, exchange
        return self.delimiter, exchange


def is_comment(line: str) -> bool:
    """Return whether a line is blank or a comment: #, %, //, or ; without any number behind it.

    Examples
    --------
    >>> is_comment("; measured by hand"), is_comment(";1.5")
    (True, False)
    """
    line = line.strip()
    if line.startswith(";"):
        return not any(character.isdigit() for character in line)
    return not line or line.startswith(_COMMENT)


def layout_of(line: str) -> Layout | None:
    """Return how `line` is divided if it is a row of numbers, else None.

    A field may be empty as long as one is a number: such a row is a damaged one, not a header.

    Examples
    --------
    >>> layout_of("0,001;3,5")
    Layout(delimiter=';', n_columns=2, decimal_comma=True, trailing=False, stamp=None)
    >>> layout_of("time;force") is None
    True
    """
    for layout in _candidates(line.translate(_QUOTES)):
        fields = layout.fields(line)
        if any(fields) and all(layout.number(field) for field in fields if field):
            trailing = len(fields) > 1 and not fields[-1]
            return replace(layout, n_columns=len(fields) - trailing, trailing=trailing)
    return None


def _candidates(line: str) -> Iterator[Layout]:
    for mark in ";|":
        if mark in line:
            yield Layout(delimiter=mark, n_columns=0, decimal_comma="," in line and "." not in line)
            return
    if "," not in line:
        tabbed = line.rstrip(" \r\n").split("\t")
        # Blanks used beside tabs, or several tabs in a row, align columns; they do not divide them.
        by_tab = len(tabbed) > 1 and all(len(field.split()) == 1 for field in tabbed)
        yield Layout(delimiter="\t" if by_tab else None, n_columns=0)
        return
    # A comma that touches a blank ends a field; one between two digits of a line with blanks is a decimal comma.
    if len(line.split()) > 1 and not re.search(r",\s|\s,", line.strip()):
        yield Layout(delimiter=None, n_columns=0, decimal_comma=True)
    yield Layout(delimiter=",", n_columns=0)
    yield Layout(delimiter=MIXED, n_columns=0)
