"""Texts for people: untrusted ones made safe for the terminal, and counts.

A name from a file may contain escape sequences that overwrite earlier output, or bidirectional controls that change how
a line reads (Unicode Technical Report 36; CVE-2021-42574).
"""

from __future__ import annotations


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


def counted(number: int, noun: str) -> str:
    """Return a count with its noun.

    >>> counted(1, "impact"), counted(0, "answer"), counted(2, "window")
    ('1 impact', '0 answers', '2 windows')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
