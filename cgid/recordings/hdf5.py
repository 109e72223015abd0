"""Read HDF5 files of cgid and of others, including MATLAB v7.3; `cgid.store` reads them in a separate process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.recordings.recording import DATASET_CURE, Contents
from cgid.recordings.statements import is_statement
from cgid.recordings.variables import Variable, contents_of, orientation

if TYPE_CHECKING:
    from cgid.store.reading import ForeignArray


def read_own(path: Path) -> Contents:
    """Return the single channel of a recording made by `cgid generate`."""
    from cgid.store.reading import Recording

    recording = Recording(path)

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        with closing(recording.blocks(length)) as rows:
            for row in rows:
                yield row[None][list(channels)]

    return Contents(
        n_channels=1,
        blocks=blocks,
        n_samples=recording.n_samples,
        units=[recording.unit],
        sampling_rate=recording.sampling_rate,
    )


#: Attributes of packed numbers and their defaults: CF conventions 1.11, section 8.1.
_PACKING = {"scale_factor": 1.0, "add_offset": 0.0}


def read_hdf5(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of one array of an HDF5 file, or of several arrays of one length.

    Rate, unit, start and channel names come from attributes and single values of the array, its groups and the root,
    the nearest first; the rate else from an array of times next to it. Packed numbers are unpacked by ``scale_factor``
    and ``add_offset`` (CF conventions). Raises `BadData` if the file is damaged, is a dataset of cgid, or holds no
    array or several; or if the array is in another file, declares more than is stored, or needs an unavailable filter.
    """
    from cgid.store.description import RECORDING_FORMAT
    from cgid.store.reading import array_blocks, survey
    from cgid.store.sandbox import format_said

    said = format_said(path)
    if said == RECORDING_FORMAT:
        if variable not in (None, "samples"):
            raise InvalidValue(f"{source}: the variable of a recording of cgid is 'samples', got {variable!r}")
        return read_own(path)
    arrays, values, warnings = survey(path, source, lambda name: name in _PACKING or is_statement(name))
    if said is None or said.startswith("cgid"):
        raise BadData(f"{source}: an HDF5 file is a dataset, not one recording; {DATASET_CURE}")

    def variable_of(array: ForeignArray, axes: tuple[int | None, int]) -> Variable:
        about = dict(array.attributes)
        factor, offset = (_number(about.pop(name, default)) for name, default in _PACKING.items())

        def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
            stored = array_blocks(path, source, array, axes, length, channels)
            return stored if (factor, offset) == (1.0, 0.0) else (offset + factor * block for block in stored)

        across, along = axes
        return Variable(
            name=array.name.rpartition("/")[2],
            group=array.name.rpartition("/")[0],
            n_channels=1 if across is None else array.shape[across],
            n_samples=array.shape[along],
            blocks=blocks,
            about=about,
            fault=array.fault,
            warning=array.warning,
        )

    variables = [variable_of(array, axes) for array in arrays if (axes := orientation(array.shape)) is not None]
    return contents_of(variables, values, source, variable, warnings)


def _number(value: Any) -> float:
    """Return a number unchanged, nan for anything else, so that the samples are rejected."""
    return float(value) if isinstance(value, int | float) else float("nan")
