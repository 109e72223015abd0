"""HDF5 files of other programs, such as MATLAB v7.3: their arrays and the attached values.

Only the reading process opens them (`_foreign`). One flipped bit in a value of variable length can make HDF5 loop for
ever. Such values are read last and separately, so that their loss does not affect the samples.
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
    """A numeric array of at least two values.

    name : its path, separated by slashes
    attributes : numbers, texts, and lists of texts
    fault : why the samples cannot be read, "" if they can
    warning : the missing parts, "" if there are none
    """

    name: str
    shape: tuple[int, ...]
    attributes: dict[str, Any]
    fault: str = ""
    warning: str = ""


@dataclass(frozen=True, kw_only=True)
class ForeignFile:
    """The content of a foreign file.

    said : path of a group ("" for the root) -> its attributes and the single values in it
    """

    arrays: list[ForeignArray] = field(default_factory=list)
    said: dict[str, dict[str, Any]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def survey(path: Path, source: str, wanted: Callable[[str], bool]) -> ForeignFile:
    """Return the content of a foreign HDF5 file; only values whose names satisfy `wanted` are read.

    `source` is the file's name in messages. Raises `BadData` if the file is not HDF5, truncated, damaged, or has more
    objects than a recording.
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

    `axes` are the axis of the channels, None if there is only one channel, and the axis of the samples. `source` is the
    file's name in messages. Raises `BadData` if a checksum or a compressed chunk is wrong.
    """
    # The declared size was checked against the stored bytes; a sample takes at most eight bytes.
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
        # Without an attribute name it is a value in a group.
        group, _, name = place.rpartition("/") if not attribute else (place, "", attribute)
        owner = arrays.get(group)
        if owner is None:
            owner = found.said.setdefault(group, {})
        owner[name] = value
