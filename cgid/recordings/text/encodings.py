"""In which characters a text file is written; none says so but by its bytes."""

from __future__ import annotations

import codecs
import re

from cgid.errors import BadData

#: Bytes that are looked at: all of the header.
SNIFFED = 1 << 18

# Characters that no text holds: all controls but tab, line and page breaks, and the end mark of DOS.
_CONTROL = re.compile("[\0-\x08\x0e-\x19\x1b-\x1f\x7f]")

_HIGH = re.compile(rb"[\x80-\xff]")

#: Chinese characters in everyday use and full-width marks: GB 2312 rows 1 to 9 and its first level, rows 16 to 55.
_COMMON_CHINESE = re.compile(rb"[\xa1-\xa9\xb0-\xd7][\xa1-\xfe]")


def encoding_of(start: bytes, source: str) -> str:
    r"""Return the encoding of a text that begins with these bytes.

    Parameters
    ----------
    start : bytes
        The first `SNIFFED`; the last character may be incomplete.
    source : str
        Name of the file in messages.

    Returns
    -------
    str
        "utf-8-sig" and "utf-16" by their marks, "utf-8" where the bytes are such, "gb18030" where most of what is
        not ASCII are common Chinese characters (LabVIEW writes in the code page of the system), else "latin-1".

    Raises
    ------
    BadData
        The bytes are no text.

    Examples
    --------
    >>> [encoding_of("t (s);a (m/s²), µ".encode(name), "") for name in ("utf-8", "utf-16", "latin-1")]
    ['utf-8', 'utf-16', 'latin-1']
    >>> encoding_of("时间(s),加速度(g)".encode("gbk"), ""), encoding_of("Größe (°C)".encode("latin-1"), "")
    ('gb18030', 'latin-1')
    """
    encoding = _marked(start) or _guessed(start)
    text = start.decode(encoding, "replace")
    # What is left undecoded of UTF-16 holds zeros.
    if _CONTROL.search(text):
        raise BadData(
            f"{source}: the file is neither text nor of another format that is known; export it as text, WAV or HDF5"
        )
    return encoding


def _marked(start: bytes) -> str | None:
    if start.startswith(codecs.BOM_UTF8):
        return "utf-8-sig"
    return "utf-16" if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else None


def _guessed(start: bytes) -> str:
    if start.isascii() or _decodes(start, "utf-8"):
        return "utf-8"
    # In western texts nearly every character beyond ASCII stands beside letters of ASCII; two in a row that happen to
    # be a common Chinese character are rare. Chinese texts hardly hold anything else.
    common = sum(map(len, _COMMON_CHINESE.findall(start)))
    chinese = common > 0.7 * len(_HIGH.findall(start)) and _decodes(start, "gb18030")
    return "gb18030" if chinese else "latin-1"


def _decodes(start: bytes, encoding: str) -> bool:
    try:
        # The last character may be incomplete, as the bytes are only the first ones.
        codecs.getincrementaldecoder(encoding)().decode(start)
    except UnicodeDecodeError:
        return False
    return True
