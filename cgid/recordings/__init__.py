"""Recordings from files: text, NPY, WAV and our own HDF5 into signals."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from cgid import validation
from cgid.errors import BadData, InvalidValue, NoInput
from cgid.recordings.arrays import read_npy
from cgid.recordings.contents import Contents
from cgid.recordings.text import read_text
from cgid.recordings.wav import read_wav
from cgid.signals import Signal, quantity_of

__all__ = ["is_dataset", "read_recording"]

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf")
_NPY_MAGIC = b"\x93NUMPY"
_WAV_MAGIC = (b"RIFF", b"RIFX", b"RF64")
_DATASET_CURE = "read it with cgid.store, or pick one of its signals with --index"


def is_dataset(path: str | Path) -> bool:
    """Return whether `path` is a directory, or an HDF5 file that does not say that it is a recording.

    Such an input belongs to `cgid.store`. What does not exist or cannot be opened is no dataset, and neither
    is "-", the standard input.

    Examples
    --------
    >>> is_dataset("-"), is_dataset(".")
    (False, True)
    """
    if str(path) in ("", "-"):
        return False
    try:
        if Path(path).is_dir():
            return True
    except (OSError, ValueError):
        return False
    return _is_hdf5(path) and not _is_ours(path)


def _is_hdf5(path: str | Path) -> bool:
    try:
        # Opening a pipe would swallow its first bytes, so only regular files are looked into.
        if str(path) in ("", "-") or not Path(path).is_file():
            return False
        with Path(path).open("rb") as file:
            return file.read(len(_HDF5_MAGIC)) == _HDF5_MAGIC
    except (OSError, ValueError):
        return False


def _is_ours(path: str | Path) -> bool:
    """Return whether an HDF5 file is a recording that cgid made."""
    from cgid.store.recording import is_recording

    return is_recording(path)


def read_recording(
    path: str | Path,
    *,
    sampling_rate: float | None = None,
    unit: str | None = None,
    channel: int | str | None = None,
) -> list[Signal]:
    r"""Read a recording; the format is told by the content, not by the file's name.

    Text may use any of comma, semicolon, tab, bar and blanks between its columns, a decimal comma unless the
    comma separates columns, comments, any number of header lines, UTF-8, UTF-16 or Latin-1. A header such as
    ``time (ms), force [kN]`` gives names and units, ``# sampling_rate: 200 kHz`` and ``# unit: N`` say the rest.
    A time column is in seconds unless its header says ms or us.

    NPY holds one channel, (n_samples,), or several: (n_channels, n_samples), unless the second axis is the
    shorter one, which is then read as (n_samples, n_channels).

    WAV holds any number of channels; integers are scaled to a full scale of 1.0 and, like floats, are in
    "FS" unless `unit` is given, which then is taken as the unit of the numbers between -1 and 1.

    A recording made by `cgid generate` holds one channel, and says its rate and unit.

    Parameters
    ----------
    path : str or Path
        The file; "-" is the standard input.
    sampling_rate : float, optional
        [Hz], above 0; needed where the file does not say it. Where both speak they must agree to 0.1 %, and
        this number, which has not been rounded, is used.
    unit : str, optional
        What the numbers are in, where the file does not say it; nothing is converted.
    channel : int or str, optional
        Read only this channel: its number from 1 (the time column does not count) or its name in the header.

    Returns
    -------
    list of Signal
        One a channel, (n_samples,) each.

    Raises
    ------
    NoInput
        The file does not exist or cannot be opened.
    BadData
        The file is empty, cut off, a dataset or no recording; a number is missing or not finite; the time
        column is not even; the file contradicts itself or `unit`.
    MissingOption
        Neither the file nor `sampling_rate` gives the sampling rate.
    InvalidValue
        `sampling_rate`, `unit` or `channel` breaks its rule, or `sampling_rate` contradicts the file.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "hit.csv"
    ...     _ = file.write_text("time (ms),force (kN)\n0.00,0.0\n0.01,1.5\n0.02,0.5\n")
    ...     (signal,) = read_recording(file)
    >>> signal.samples.tolist(), signal.unit, round(signal.sampling_rate, 6)
    ([0.0, 1.5, 0.5], 'kN', 100000.0)
    """
    if sampling_rate is not None:
        if np.ndim(sampling_rate):
            raise InvalidValue(f"sampling_rate must be one number in Hz, got {sampling_rate!r}")
        sampling_rate = float(validation.positive("sampling_rate", sampling_rate, "Hz"))
    if unit is not None:
        quantity_of(unit)
    source = "stdin" if str(path) == "-" else str(path)
    try:
        if _is_hdf5(path) and _is_ours(path):
            return _own(path).signals(source, sampling_rate=sampling_rate, unit=unit, channel=channel)
        contents = _contents(_read_bytes(path, source), source)
        return contents.signals(source, sampling_rate=sampling_rate, unit=unit, channel=channel)
    except MemoryError:
        raise BadData(f"{source}: the recording must fit in memory and does not; cut it into parts") from None


def _own(path: str | Path) -> Contents:
    from cgid.store.recording import Recording

    recording = Recording(path)
    return Contents(
        samples=recording.samples()[np.newaxis], units=[recording.unit], sampling_rate=recording.sampling_rate
    )


def _read_bytes(path: str | Path, source: str) -> bytes:
    if not str(path):
        raise NoInput("the name of the recording must not be empty; give a file, or - for the standard input")
    try:
        if source == "stdin" and str(path) == "-":
            return sys.stdin.buffer.read()
        if Path(path).is_dir():
            raise BadData(f"{source}: a directory is a dataset, not one recording; {_DATASET_CURE}")
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise NoInput(f"{source}: the file must exist and does not; check the name") from None
    except PermissionError:
        raise NoInput(f"{source}: the file must be readable, permission is denied; check its rights") from None
    except BadData:
        raise
    # A closed standard input and a NUL byte in the name are ValueErrors, a missing standard input has no buffer.
    except (OSError, ValueError, AttributeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise NoInput(f"{source!r}: the file cannot be opened ({reason}); check the name") from None


def _contents(raw: bytes, source: str) -> Contents:
    if raw.startswith(_HDF5_MAGIC):
        raise BadData(f"{source}: an HDF5 file is a dataset, not one recording; {_DATASET_CURE}")
    if not raw:
        raise BadData(f"{source}: a recording must hold numbers, the file is empty; record or export it again")
    if raw.startswith(_NPY_MAGIC):
        return read_npy(raw, source)
    if raw.startswith(_WAV_MAGIC):
        return read_wav(raw, source)
    if source.lower().endswith(_HDF5_SUFFIXES):
        raise BadData(
            f"{source}: named like a dataset, but its content is not HDF5; rename it if it is text, "
            f"else {_DATASET_CURE}"
        )
    return read_text(raw, source)
