"""How samples are written as bytes: integers and floats of WAV files and of raw streams."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cgid.errors import InvalidValue

#: Numbers that are read at once at most, however many channels there are.
MOST_NUMBERS = 1 << 22

_FLOAT_WIDTHS = (4, 8)
_INTEGER_WIDTHS = (1, 2, 3, 4, 8)


@dataclass(frozen=True, kw_only=True)
class Coding:
    """One number as bytes.

    Parameters
    ----------
    kind : str
        "u": unsigned integers around the middle of their range; "i": signed integers; "f": floats.
    width : int
        Bytes of a number: 1, 2, 3, 4 or 8; 4 or 8 of a float.
    big_endian : bool
    """

    kind: Literal["u", "i", "f"]
    width: int
    big_endian: bool = False

    @classmethod
    def of_name(cls, name: str) -> Coding:
        """Return the coding of a name such as "u8", "s16le", "s24be", "f32le"; the order is little unless said.

        Raises
        ------
        InvalidValue
            It is none of the known names; the message lists them.

        Examples
        --------
        >>> Coding.of_name("s24le")
        Coding(kind='i', width=3, big_endian=False)
        """
        found = _NAMED.get(str(name).lower())
        if found is None:
            listed = ", ".join(known for known in _NAMED if known == "u8" or known.endswith("e"))
            raise InvalidValue(f"sample_format must be one of {listed}, got {name!r}")
        return found

    @property
    def is_known(self) -> bool:
        """Whether there are numbers of this width."""
        return self.width in (_FLOAT_WIDTHS if self.kind == "f" else _INTEGER_WIDTHS)

    def decoded(self, raw: bytes) -> NDArray[Any]:
        """Return the numbers of whole samples, (len(raw) // width,).

        Integers come as float64 with a full scale of 1.0, floats as they are.

        Examples
        --------
        >>> Coding(kind="i", width=2).decoded(bytes([0, 128, 0, 64])).tolist()
        [-1.0, 0.5]
        """
        order = ">" if self.big_endian else "<"
        if self.kind == "f":
            numbers = np.frombuffer(raw, f"{order}f{self.width}")
            return numbers.astype(numbers.dtype.newbyteorder("="))
        if self.width == 3:
            return _of_three_bytes(raw, self.big_endian).astype(np.float64) / 2.0**31
        half = 2.0 ** (8 * self.width - 1)
        scaled = np.frombuffer(raw, f"{order}{self.kind}{self.width}").astype(np.float64)
        if self.kind == "u":
            scaled -= half
        scaled /= half
        return scaled


def _named(kind: Literal["i", "f"], letter: str, widths: tuple[int, ...]) -> dict[str, Coding]:
    return {
        f"{letter}{8 * width}{ending}": Coding(kind=kind, width=width, big_endian=ending == "be")
        for width in widths
        for ending in ("le", "be", "")
    }


_NAMED = {"u8": Coding(kind="u", width=1), **_named("i", "s", (2, 3, 4)), **_named("f", "f", _FLOAT_WIDTHS)}


def _of_three_bytes(raw: bytes, big_endian: bool) -> NDArray[np.int32]:
    """Return numbers of 24 bits at the top of 32, so that they keep their sign."""
    three = np.frombuffer(raw, np.uint8).reshape(-1, 3)
    four = np.zeros((len(three), 4), np.uint8)
    little = sys.byteorder == "little"
    four[:, slice(1, 4) if little else slice(0, 3)] = three[:, ::-1] if big_endian == little else three
    return four.view(np.int32)[:, 0]
