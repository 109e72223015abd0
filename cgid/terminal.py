"""Texts of strangers, made fit for a terminal.

A name or a label out of a file may hold signs that a terminal obeys: escape sequences that overwrite what was said,
set the title or the clipboard, and signs that turn the direction of writing over, so that a line reads otherwise than
it is (Unicode Technical Report 36; CVE-2021-42574).
"""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return a text in which every sign that is not plainly shown stands as its escape.

    Those are what Unicode calls other or a separator (control, format, surrogate, private, unassigned); the space
    stays, and the tab, which separates columns.

    Examples
    --------
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
