"""Which format a file is in, told by its first bytes; by its name only where these say nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from cgid.errors import BadData, InvalidValue
from cgid.recordings.contents import Contents
from cgid.recordings.own import DATASET_CURE

#: So many bytes tell any format.
HEAD_SIZE = 1024

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
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


#: The first that matches reads; text is what is left.
FORMATS: tuple[Format, ...] = (
    Format("NPY", _starts(b"\x93NUMPY"), "arrays:read_npy"),
    Format("WAV", _starts(b"RIFF", b"RIFX", b"RF64"), "wav:read_wav"),
    Format("HDF5", _starts(HDF5_MAGIC), "own:read_own"),
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
