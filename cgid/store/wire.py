"""What goes between a process and the one that reads for it: a line of JSON, and behind it the bytes of arrays.

Nothing in it can make the receiver run anything, as pickle could, and its sizes are looked at before room is made.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

#: Bytes of a line; a header or a survey takes a small part of it.
LONGEST_LINE = 16 << 20
#: Plain numbers and texts of fixed length; `dtype.str` says them so.
_PLAIN = re.compile(r"[<>|][biufc][0-9]{1,2}|\|S[1-9][0-9]{0,8}")
_MOST_ARRAYS, _MOST_AXES = 100_000, 32


class BrokenWire(Exception):
    """What came is no message, or none came."""


def send(stream: IO[bytes], message: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> None:
    """Write a message and its arrays.

    Raises
    ------
    BrokenWire
        It is longer than a message may be, or JSON cannot hold it.
    """
    parts = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    said = [[name, part.dtype.str, list(part.shape)] for name, part in parts.items()]
    try:
        line = json.dumps({**message, "arrays": said}, separators=(",", ":")).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise BrokenWire(f"what JSON cannot hold: {error}") from None
    if len(line) >= LONGEST_LINE:
        raise BrokenWire(f"a message of {len(line)} bytes")
    stream.write(line + b"\n")
    for part in parts.values():
        if part.size:
            stream.write(part.reshape(-1).view(np.uint8).data)
    stream.flush()


def receive(stream: IO[bytes], largest: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return a message and its arrays.

    Parameters
    ----------
    stream : file
    largest : int
        Bytes that the arrays may take together.

    Raises
    ------
    BrokenWire
        The other end is gone, or says what it must not.
    """
    line = stream.readline(LONGEST_LINE + 1)
    if not line.endswith(b"\n"):
        raise BrokenWire("no line")
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        raise BrokenWire("no JSON") from None
    if not isinstance(message, dict):
        raise BrokenWire("no message")
    said = message.pop("arrays", None)
    if not isinstance(said, list) or len(said) > _MOST_ARRAYS or not all(map(_is_plain, said)):
        raise BrokenWire("no plain arrays")
    try:
        kinds = {name: (np.dtype(kind), tuple(shape)) for name, kind, shape in said}
    except TypeError:
        raise BrokenWire("no types of numbers") from None
    if sum(dtype.itemsize * math.prod(shape) for dtype, shape in kinds.values()) > largest:
        raise BrokenWire("more than was asked for")
    return message, {name: _filled(stream, dtype, shape) for name, (dtype, shape) in kinds.items()}


def _is_plain(said: Any) -> bool:
    if not isinstance(said, list) or len(said) != 3:
        return False
    name, kind, shape = said
    return (
        isinstance(name, str)
        and isinstance(kind, str)
        and _PLAIN.fullmatch(kind) is not None
        and isinstance(shape, list)
        and len(shape) <= _MOST_AXES
        and all(type(length) is int and length >= 0 for length in shape)
    )


def _filled(stream: IO[bytes], dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    array = np.empty(shape, dtype)
    if array.size:
        rest = array.reshape(-1).view(np.uint8).data
        while len(rest):
            count = stream.readinto(rest)  # type: ignore[attr-defined]
            if not count:
                raise BrokenWire("cut off")
            rest = rest[count:]
    return array
