"""Texts for people: untrusted ones made safe for the terminal and for spreadsheets, and counts.

A name from a file may contain escape sequences that overwrite earlier output, or bidirectional controls that change how
a line reads (Unicode Technical Report 36; CVE-2021-42574).
"""

from __future__ import annotations

import re

#: Beginning of a cell that a spreadsheet runs as a formula, after any apostrophes that already make it a text.
_FORMULA = re.compile(r"'*[=+\-@\t\r\n]")


def printable(text: str) -> str:
    r"""Return the text with every unprintable character escaped, except the space and the tab.

    >>> print(printable("coal\x1b[2Jgangue\u202e"))
    coal\x1b[2Jgangue\u202e
    >>> printable("Kohle, уголь, 煤 °C")
    'Kohle, уголь, 煤 °C'
    """
    if text.replace("\t", "").isprintable():
        return text
    return "".join(
        sign if sign.isprintable() or sign == "\t" else sign.encode("unicode_escape").decode() for sign in text
    )


def spreadsheet_cell(text: str) -> str:
    """Return a text for CSV with an apostrophe before what a spreadsheet would run as a formula; a number has none.

    >>> spreadsheet_cell("=cmd|calc!A0"), spreadsheet_cell("+x"), spreadsheet_cell("-3.5"), spreadsheet_cell("a=b")
    ("'=cmd|calc!A0", "'+x", '-3.5', 'a=b')
    """
    if not _FORMULA.match(text):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def text_of_cell(cell: str) -> str:
    """Return the text of which `spreadsheet_cell` made a cell.

    >>> [text_of_cell(spreadsheet_cell(text)) for text in ("=a", "'=a", "'a", "a")]
    ['=a', "'=a", "'a", 'a']
    """
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def counted(number: int, noun: str) -> str:
    """Return a count with its noun.

    >>> counted(1, "impact"), counted(0, "answer"), counted(2, "window")
    ('1 impact', '0 answers', '2 windows')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
