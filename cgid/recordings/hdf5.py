"""HDF5 that others wrote, MATLAB's v7.3 among it; `cgid.store` reads it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.recordings.contents import Contents
from cgid.recordings.own import DATASET_CURE, read_own
from cgid.recordings.statements import is_telling
from cgid.recordings.variables import Variable, contents_of, orientation

if TYPE_CHECKING:
    from cgid.store.foreign import ForeignArray


def read_hdf5(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of one array of an HDF5 file, or of several arrays of one length.

    Parameters
    ----------
    path : Path
        The file.
    source : str
        Its name in messages.
    variable : str or None
        Path of an array, of a group, or a pattern; None if there is one array only beside times.

    Returns
    -------
    Contents
        Two axes are channels and samples, the longer one that of the samples. The rate is what attributes or single
        values such as ``sampling_rate``, ``fs`` or ``dt`` of the array, its groups or the root say, the nearest
        first; else what an array of times beside it says. ``unit``, ``start_time`` and ``channel_names`` likewise.

    Raises
    ------
    BadData
        The file is damaged, a dataset of cgid, holds no array of numbers or several, or the array lies elsewhere,
        declares more than is stored, or is packed in a way that HDF5 does not know here.
    """
    from cgid.store.foreign import array_blocks, is_foreign, survey
    from cgid.store.recording import is_recording

    if is_recording(path):
        if variable not in (None, "samples"):
            raise InvalidValue(f"{source}: the variable of a recording of cgid is 'samples', got {variable!r}")
        return read_own(path, source, variable)
    found = survey(path, source, is_telling)
    if not is_foreign(path):
        raise BadData(f"{source}: an HDF5 file is a dataset, not one recording; {DATASET_CURE}")

    def variable_of(array: ForeignArray, axes: tuple[int | None, int]) -> Variable:
        def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
            return array_blocks(path, source, array, axes, length, channels)

        across, along = axes
        return Variable(
            name=array.name.rpartition("/")[2],
            group=array.name.rpartition("/")[0],
            n_channels=1 if across is None else array.shape[across],
            n_samples=array.shape[along],
            blocks=blocks,
            about=array.attributes,
            fault=array.fault,
            warning=array.warning,
        )

    variables = [variable_of(array, axes) for array in found.arrays if (axes := orientation(array.shape)) is not None]
    return contents_of(variables, found.said, source, variable, found.warnings)
