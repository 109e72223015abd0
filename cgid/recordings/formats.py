"""Which format a file is in, told by its first bytes; by its name only where these say nothing."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from cgid.errors import BadData, InvalidValue
from cgid.recordings.mat.elements import MAT_ORDERS
from cgid.recordings.recording import DATASET_CURE, Contents
from cgid.recordings.wav import WAV_MAGICS

#: So many bytes tell any format.
HEAD_SIZE = 1024

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
# The delimiter and the type of a data set, in columns: those of units, of coordinates and of functions come first.
_UFF = re.compile(rb"(?: {4}-1 *\r?\n)+(?: {3}(?:151|164)| {4}(?:15|18|55|58|82)| {2}(?:1858|24[0-9]{2}))[b \r\n]")
_HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf")


@dataclass(frozen=True)
class Format:
    """One format of files.

    Attributes
    ----------
    name : str
    matches : callable
        From the first `HEAD_SIZE` bytes and the suffix in small letters to whether a file is of this format.
    reader : str
        ``module:function`` in `cgid.recordings`; imported when such a file comes.
    takes_variable : bool
        Whether a file may hold several arrays, of which one can be asked for.
    """

    name: str
    matches: Callable[[bytes, str], bool]
    reader: str
    takes_variable: bool = False

    def read(self, path: Path, source: str, variable: str | None) -> Contents:
        """Return what a file of this format says; raises as `cgid.recordings.open_recording` does."""
        if variable is not None and not self.takes_variable:
            raise InvalidValue(
                f"{source}: a {self.name} file holds one recording, there is no variable {variable!r}; leave out "
                "--variable"
            )
        module, _, function = self.reader.partition(":")
        contents: Contents = getattr(import_module(f"cgid.recordings.{module}"), function)(path, source, variable)
        return contents


def _starts(*magics: bytes) -> Callable[[bytes, str], bool]:
    return lambda head, suffix: head.startswith(magics)


def is_hdf5(head: bytes, suffix: str) -> bool:
    """Return whether a file begins as HDF5 does, or as MATLAB's files in it."""
    # The superblock may stand behind a block of the user's, as MATLAB's header is.
    return any(head[place:].startswith(HDF5_MAGIC) for place in (0, 512))


#: The first that matches reads; text is what is left.
FORMATS: tuple[Format, ...] = (
    Format("NPY", _starts(b"\x93NUMPY"), "arrays:read_npy"),
    Format("WAV", _starts(*WAV_MAGICS), "wav:read_wav"),
    Format("NPZ", _starts(b"PK\3\4"), "arrays:read_npz", takes_variable=True),
    Format("HDF5", is_hdf5, "hdf5:read_hdf5", takes_variable=True),
    Format("MATLAB", lambda head, suffix: head[124:128] in MAT_ORDERS, "mat.reader:read_mat", takes_variable=True),
    Format("TDMS", _starts(b"TDSm"), "tdms:read_tdms", takes_variable=True),
    Format("UFF", lambda head, suffix: _UFF.match(head) is not None, "uff:read_uff", takes_variable=True),
    Format("Parquet", _starts(b"PAR1"), "parquet:read_parquet"),
    Format("FLAC or OGG", _starts(b"fLaC", b"OggS"), "audio:read_audio"),
    Format("LVM", lambda head, suffix: b"LabVIEW Measurement" in head[:32], "lvm:read_lvm", takes_variable=True),
    Format("text", lambda head, suffix: True, "text:read_text"),
)


def format_of(path: Path, source: str) -> Format:
    """Return the format of a regular file.

    Raises
    ------
    BadData
        The file is empty, or named like a dataset without being one.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_SIZE)
    if not head:
        raise BadData(f"{source}: a recording must hold numbers, the file is empty; record or export it again")
    suffix = Path(source).suffix.lower()
    found = next(one for one in FORMATS if one.matches(head, suffix))
    if found.name == "text" and suffix in _HDF5_SUFFIXES:
        raise BadData(
            f"{source}: named like a dataset, but its content is not HDF5; rename it if it is text, else {DATASET_CURE}"
        )
    return found
