"""HDF5 files of other programs, such as MATLAB v7.3: their arrays, and what is attached to these.

Only the reading process opens them (`_foreign`). Values of variable length, which one flipped bit can make HDF5 search
for ever, are asked for last and separately: if they are lost, the samples are not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.store import sandbox


@dataclass(frozen=True, kw_only=True)
class ForeignArray:
    """A numeric array of two values or more.

    Attributes
    ----------
    name : str
        Its path, parts divided by slashes.
    shape : tuple of int
    attributes : dict
        Numbers, texts, and lists of texts.
    fault : str
        Why its samples cannot be read, "" if they can.
    warning : str
        What of it is missing, "" if nothing is.
    """

    name: str
    shape: tuple[int, ...]
    attributes: dict[str, Any]
    fault: str = ""
    warning: str = ""


@dataclass(frozen=True, kw_only=True)
class ForeignFile:
    """What a foreign file holds.

    Attributes
    ----------
    arrays : list of ForeignArray
    said : dict
        Path of a group, "" for the root -> its attributes and the single values that lie in it.
    warnings : list of str
    """

    arrays: list[ForeignArray] = field(default_factory=list)
    said: dict[str, dict[str, Any]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def survey(path: Path, source: str, wanted: Callable[[str], bool]) -> ForeignFile:
    """Return what a foreign HDF5 file holds.

    Parameters
    ----------
    path : Path
    source : str
        Its name in messages.
    wanted : callable
        From the name of a value to whether it is of interest; others are not read.

    Raises
    ------
    BadData
        The file is no HDF5, cut off, damaged, or of more parts than a recording has.
    """
    names = [name for name in sandbox.call("foreign_names", path, source=source) if wanted(name)]
    about = sandbox.call("foreign_survey", path, names, source=source)
    arrays = [ForeignArray(**{**one, "shape": tuple(one["shape"])}) for one in about["arrays"]]
    found = ForeignFile(arrays=arrays, said=about["said"])
    if about["texts"]:
        _add_texts(found, path, source, about["texts"])
    return found


def array_blocks(
    path: Path, source: str, array: ForeignArray, axes: tuple[int | None, int], length: int, channels: Sequence[int]
) -> Iterator[NDArray[Any]]:
    """Yield the samples of these channels in order, (len(channels), at most length), float32 or float64.

    Parameters
    ----------
    path : Path
    source : str
        Its name in messages.
    array : ForeignArray
    axes : tuple of int
        The axis of the channels, None if there is only one, and that of the samples.
    length : int
    channels : sequence of int

    Raises
    ------
    BadData
        A checksum or a packed chunk does not fit: the file is damaged.
    """
    # What it declares was held against what is stored; a block has at most eight bytes a sample.
    largest = max(sandbox.LARGEST_ANSWER, 8 * length * len(channels))
    arguments = (array.name, array.shape, axes, length, list(channels))
    with closing(sandbox.stream("foreign_blocks", path, *arguments, source=source, largest=largest)) as blocks:
        for block in blocks:
            yield block[""]


def _add_texts(found: ForeignFile, path: Path, source: str, asked: Sequence[tuple[str, str]]) -> None:
    try:
        texts = sandbox.call("foreign_texts", path, asked, source=source)
    except BadData:
        names = ", ".join(sorted({name or place for place, name in asked})[:5])
        found.warnings.append(f"texts of variable length ({names}) could not be read; the file may be damaged")
        return
    arrays = {array.name: array.attributes for array in found.arrays}
    for (place, attribute), value in zip(asked, texts, strict=True):
        if value is None:
            continue
        # Without the name of an attribute it is a value that lies in a group.
        group, _, name = place.rpartition("/") if not attribute else (place, "", attribute)
        owner = arrays.get(group)
        if owner is None:
            owner = found.said.setdefault(group, {})
        owner[name] = value
