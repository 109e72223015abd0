"""Recordings from files into signals, whole or by blocks."""

from __future__ import annotations

import errno
import sys
import tempfile
import warnings
import weakref
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from functools import partial
from pathlib import Path
from threading import Timer
from typing import IO, Any

from cgid.errors import BadData, NoInput, WriteFailed
from cgid.recordings.formats import HDF5_MAGIC, HEAD_SIZE, format_of, is_hdf5
from cgid.recordings.recording import BLOCK_LENGTH, DATASET_CURE, Channel, RecordingFile, told
from cgid.signals import Signal
from cgid.units import quantity_of
from cgid.validation import require_rate

__all__ = ["BLOCK_LENGTH", "Channel", "RecordingFile", "is_dataset", "open_recording", "read_recording"]


#: A longer stream on the standard input is refused: it is put on the disk before it is read.
LARGEST_STREAM = 32 << 30
_PIECE = 1 << 20
#: Who waits for longer says so [s].
_PATIENCE = 5.0


def is_dataset(path: str | Path) -> bool:
    """Return whether `path` is a directory, or an HDF5 file of cgid's that is no recording.

    An HDF5 file that is too damaged to say whose it is counts as one. Such an input belongs to `cgid.store`. What does
    not exist or cannot be opened is no dataset, and neither is "-", the standard input.

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
        # Opening a pipe would swallow its first bytes, so only regular files are looked into.
        if not Path(path).is_file():
            return False
        with Path(path).open("rb") as file:
            if file.read(len(HDF5_MAGIC)) != HDF5_MAGIC:
                return False
    except (OSError, ValueError):
        return False
    from cgid.store.description import RECORDING_FORMAT
    from cgid.store.sandbox import format_said

    said = format_said(Path(path))
    return said is None or (said.startswith("cgid") and said != RECORDING_FORMAT)


def open_recording(
    path: str | Path,
    *,
    sampling_rate: float | None = None,
    unit: str | None = None,
    channel: int | str | Sequence[int | str] | None = None,
    variable: str | None = None,
) -> RecordingFile:
    r"""Open a recording; the format is told by the content, not by the file's name.

    Text (CSV, TXT, ...) may use any of comma, semicolon, tab, bar and blanks between its columns, a decimal comma
    unless the comma separates columns, comments above and below the numbers, header lines, UTF-8, UTF-16, GB 18030 or
    Latin-1. A
    header such as ``time (ms), force [kN]`` gives names and units, ``# sampling_rate: 200 kHz`` and ``# unit: N`` say
    the rest. A time column is in seconds unless its header says ms or us, or holds times of day.

    LabVIEW measurement files (LVM): the channels of all segments that follow each other without a gap; `variable` is
    the number of one segment, or the channel whose length and rate the others must have.

    WAV (RIFF, RIFX, RF64) holds any number of channels; integers are scaled to a full scale of 1.0 and, like floats,
    are in "FS" unless `unit` is given, which then is taken as the unit of the numbers between -1 and 1. FLAC and OGG
    likewise (library soundfile).

    NPY holds one channel, (n_samples,), or several: (n_channels, n_samples), unless the second axis is the
    shorter one, which is then read as (n_samples, n_channels).

    NPZ, HDF5 and MATLAB files (version 5 and up) hold arrays by name; where there are several beside times, `variable`
    says which is meant: an array, a group or struct of arrays of one length, or a pattern such as ``ch*``. Rate, unit,
    start and channel names are taken from attributes and single values (``fs``, ``dt``, ``unit``, ...), the nearest
    first, the rate else from an array of times. A recording made by `cgid generate` holds one channel, and says its
    rate and unit.

    TDMS (library nptdms): the channels of one group with their waveform properties; `variable` is a group or
    ``group/channel``. Universal files (UFF, UNV): the data sets 58 over time; `variable` is the number or the name of
    one. Parquet (library pyarrow): columns, as of a text file.

    Of a WAV, FLAC, OGG, LVM or TDMS file that is cut off what is whole is read, and `RecordingFile.warnings` say so.

    Parameters
    ----------
    path : str or Path
        The file; "-" is the standard input.
    sampling_rate : float, optional
        [Hz], above 0; needed where the file does not say it. Where both speak they must agree to 0.1 %, and
        this number, which has not been rounded, is used.
    unit : str, optional
        What the numbers are in, where the file does not say it; nothing is converted.
    channel : int, str or sequence of these, optional
        Read only these channels: number from 1 (the time column does not count) or name in the header; "1+2" is both.
    variable : str, optional
        Which of the arrays, tables or groups of the file is meant.

    Returns
    -------
    RecordingFile

    Raises
    ------
    NoInput
        The file does not exist or cannot be opened.
    BadData
        The file is empty, damaged, a dataset or no recording; it contradicts itself or `unit`.
    MissingOption
        Neither the file nor `sampling_rate` gives the sampling rate.
    MissingExtra
        The format needs a library that is not installed.
    InvalidValue
        `sampling_rate`, `unit`, `channel` or `variable` breaks its rule, or `sampling_rate` contradicts the file.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "hit.csv"
    ...     _ = file.write_text("time (ms),force (kN)\n0.00,0.0\n0.01,1.5\n0.02,0.5\n")
    ...     recording = open_recording(file)
    ...     blocks = [block.tolist() for block in recording.blocks(2)]
    >>> recording.channels, blocks
    ((Channel(name='1', unit='kN'),), [[[0.0, 1.5]], [[0.5]]])
    """
    if sampling_rate is not None:
        sampling_rate = require_rate(sampling_rate)
    if unit is not None:
        quantity_of(unit)
    source = "stdin" if str(path) == "-" else str(path)
    regular, spool = _regular(path, source)
    try:
        with told(source):
            found = format_of(regular, source)
            recording = RecordingFile(
                found.read(regular, source, variable),
                source=source,
                format=found.name,
                sampling_rate=sampling_rate,
                unit=unit,
                channel=channel,
            )
    except BaseException:
        spool.close()
        raise
    weakref.finalize(recording, spool.close)
    return recording


def read_recording(
    path: str | Path,
    *,
    sampling_rate: float | None = None,
    unit: str | None = None,
    channel: int | str | Sequence[int | str] | None = None,
    variable: str | None = None,
) -> list[Signal]:
    r"""Read a whole recording into memory: one `Signal` a channel, (n_samples,) each.

    Parameters and errors are those of `open_recording`; besides, `BadData` is raised where a number is missing or not
    finite, or the recording does not fit in memory.

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
    return open_recording(path, sampling_rate=sampling_rate, unit=unit, channel=channel, variable=variable).signals()


def _regular(path: str | Path, source: str) -> tuple[Path, ExitStack]:
    """Return a regular file with the content, and what holds it where it is a copy: that is gone when this closes."""
    if not str(path):
        raise NoInput("the name of the recording must not be empty; give a file, or - for the standard input")
    try:
        with told(source):
            if str(path) == "-":
                if sys.stdin is None:
                    raise NoInput("stdin: the standard input must be open, it is closed; give a file, or pipe one in")
                if sys.stdin.buffer.isatty():
                    raise NoInput("stdin: a recording must be a file or a pipe, this is a terminal; pipe one in")
                return _spooled(lambda: nullcontext(sys.stdin.buffer), source)
            path = Path(path)
            if path.is_dir():
                raise BadData(f"{source}: a directory is a dataset, not one recording; {DATASET_CURE}")
            if path.is_char_device() or path.is_block_device():
                raise NoInput(
                    f"{source}: a recording must be a file or a pipe, this is a device; record it to a file, or follow "
                    "it by cgid monitor"
                )
            if path.exists() and not path.is_file():
                return _spooled(partial(path.open, "rb"), source)
            # Opened once, so that what is wrong with it is said before anything else.
            path.open("rb").close()
            return path, ExitStack()
    except (BadData, NoInput):
        raise
    # A closed standard input and a NUL byte in the name are ValueErrors, a missing standard input has no buffer.
    except (ValueError, AttributeError) as error:
        raise NoInput(f"{source!r}: the file cannot be opened ({error}); check the name") from None


def _spooled(opened: Callable[[], AbstractContextManager[Any]], source: str) -> tuple[Path, ExitStack]:
    """Return a file with all that comes from a stream: some formats have their index at the end.

    Nothing of it outlives this process, however that ends: the file has no name, or somebody who removes it.
    """
    waiting = Timer(_PATIENCE, _say_waiting, [source])
    waiting.daemon = True
    waiting.start()
    spool = ExitStack()
    try:
        with opened() as stream:
            piece = stream.read(_PIECE)
            waiting.cancel()
            path, file = _temporary(spool, is_hdf5(piece[:HEAD_SIZE], ""))
            while piece:
                if file.tell() > LARGEST_STREAM:
                    raise BadData(
                        f"stream: it must end within {LARGEST_STREAM >> 30} GiB to be read as a recording, it goes on; "
                        "save it as a file, or follow it by cgid monitor"
                    )
                file.write(piece)
                piece = stream.read(_PIECE)
        file.flush()
    except BaseException as error:
        with suppress(OSError):
            spool.close()
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            folder = tempfile.gettempdir()
            raise WriteFailed(f"{folder}: the disk must have room for the stream, it is full; set TMPDIR") from None
        raise
    finally:
        waiting.cancel()
    return path, spool


def _temporary(spool: ExitStack, named: bool) -> tuple[Path, IO[bytes]]:
    """Return the path of a temporary file, and the file, which goes when the spool closes or this process ends."""
    if not named and Path("/proc/self/fd").is_dir():
        file = spool.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        return Path(f"/proc/self/fd/{file.fileno()}"), file
    # HDF5 opens nothing without a name, and other systems than Linux let nobody open it twice.
    import subprocess

    kept = tempfile.NamedTemporaryFile(prefix="cgid-", suffix=".recording", delete=False)  # noqa: SIM115
    spool.callback(Path(kept.name).unlink, missing_ok=True)
    spool.enter_context(kept)
    with suppress(FileNotFoundError):  # where there is no shell, the name stays if the process is killed
        remover = subprocess.Popen(
            ["/bin/sh", "-c", 'cat; rm -f -- "$1"', "sh", kept.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        spool.enter_context(remover)
    return Path(kept.name), kept.file


def _say_waiting(source: str) -> None:
    warnings.warn(
        f"{source}: nothing has come for {_PATIENCE:g} s, a recording is read when its stream has ended; write into "
        "it, or follow a live one by cgid monitor",
        stacklevel=1,
    )
