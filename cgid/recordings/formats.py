"""Open files and streams as recordings: the first bytes show the format, whose reader is imported on demand."""

from __future__ import annotations

import errno
import os
import re
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, Any

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid._lib.validation import require_rate
from cgid.errors import BadData, InvalidValue, NoInput, WriteFailed
from cgid.recordings.chain import Chain, Statement, units_of
from cgid.recordings.recording import Asked, Blocks, RecordingFile, clear_errors, dataset_hint, library_errors
from cgid.signals import Signal

if TYPE_CHECKING:
    from cgid.recordings.site import Site

#: First bytes of a file, enough to recognise any format.
HEAD_SIZE = 1024

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
#: First bytes of WAV files: little-endian, big-endian, and two with 64-bit sizes.
WAV_MAGICS = (b"RIFF", b"RIFX", b"RF64", b"BW64")
#: First bytes of the files of libsndfile.
AUDIO_MAGICS = {
    "FLAC": (b"fLaC",),
    "OGG": (b"OggS",),
    "W64": (b"riff\x2e\x91\xcf\x11",),
    "AIFF": (b"FORM",),
    "CAF": (b"caff",),
    "AU": (b".snd", b"dns."),
}
#: Version and byte order at the end of the header of MATLAB files. Version 7.3 has 2 and is HDF5.
_MAT_MAGICS = (b"\x00\x01IM", b"\x01\x00MI")
# Delimiter and type of a data set, in fixed columns. Data sets of units, coordinates or functions come first.
_UFF = re.compile(rb"(?: {4}-1 *\r?\n)+(?: {3}(?:151|164)| {4}(?:15|18|55|58|82)| {2}(?:1858|24[0-9]{2}))[b \r\n]")
_HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf")
_TEXT_SUFFIXES = ("", ".asc", ".csv", ".dat", ".log", ".prn", ".tsv", ".txt")

#: First bytes of archives; a file that is in each of Office; how a text in JSON begins.
_GZIP, _ZIP, _OFFICE = b"\x1f\x8b", b"PK\3\4", "[Content_Types].xml"
_JSON = re.compile(rb"(?:\xef\xbb\xbf)?\s*(?:\{\s*[\"}]|\[\s*(?:[\[{\"]|-?[\d.eE+-]+\s*,))")

#: Entry points of the readers of other packages.
READERS = "cgid.readers"

#: Largest stream on the standard input [bytes]; streams are saved to disk before they are read.
MAX_STREAM = 32 << 30
PIECE_LENGTH = 1 << 20
#: Time without data until a warning [s].
WAITING_TIME = 5.0


@dataclass(frozen=True, eq=False, repr=False)
class Format:
    """One file format: its usual endings, and with `takes_variable` several arrays to choose from in a file."""

    name: str
    is_format: Callable[[bytes], bool]
    reader: str
    endings: tuple[str, ...]
    takes_variable: bool = False

    def read(self, path: Path, source: str, asked: Asked) -> Blocks:
        """Return the blocks of a file of this format; raises as `cgid.recordings.open_recording`."""
        if asked.variable is not None and not self.takes_variable:
            raise InvalidValue(
                f"{source}: a {self.name} file holds one recording, there is no variable {asked.variable!r}; leave out "
                "variable"
            )
        module, _, function = self.reader.partition(":")
        blocks: Blocks = getattr(import_module(f"cgid.recordings.{module}"), function)(path, source, asked)
        return blocks


@dataclass(frozen=True, eq=False, repr=False)
class OutsideFormat:
    """A format of another package: `reader` has the functions ``is_format(head)`` and ``read(path, variable)``."""

    name: str
    reader: Any

    def is_format(self, head: bytes) -> bool:
        """Return whether a file has this format, from its first `HEAD_SIZE` bytes."""
        with self._reader_errors():
            return bool(self.reader.is_format(head))

    def read(self, path: Path, source: str, asked: Asked) -> Blocks:
        """Return the blocks of a file of this format; any error of the reader becomes a one-line `BadData`."""
        with self._reader_errors(source):
            blocks = self.reader.read(path, asked.variable)
            if not isinstance(blocks, Blocks):
                raise TypeError(f"its function read must return cgid.recordings.Blocks, got {type(blocks).__name__}")

        def read(length: int, channels: Sequence[int], *start: int) -> Iterator[Any]:
            with self._reader_errors(source):
                yield from blocks.read(length, channels, *start)

        return replace(blocks, read=read)

    @contextmanager
    def _reader_errors(self, source: str = "recording") -> Iterator[None]:
        with library_errors(source, f"the reader {self.name} failed", f"choose another by {spelled('format', 'NAME')}"):
            try:
                yield
            except SystemExit as error:
                raise RuntimeError(f"SystemExit: {error}") from None
            except BadData as error:  # the reader does not know the name that the user gave
                raise error if source in str(error) else BadData(f"{source}: {error}") from None


def _starts(*magics: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magics)


def is_hdf5(head: bytes) -> bool:
    """Return whether a file begins as HDF5, in MATLAB files after a header of 512 bytes."""
    return any(head[offset:].startswith(HDF5_MAGIC) for offset in (0, 512))


#: The first match is used; text matches everything.
FORMATS: tuple[Format, ...] = (
    Format("NPY", _starts(b"\x93NUMPY"), "arrays:read_npy", (".npy",)),
    Format("WAV", _starts(*WAV_MAGICS), "sound:read_wav", (".wav",)),
    Format("NPZ", _starts(b"PK\3\4"), "arrays:read_npz", (".npz",), takes_variable=True),
    Format("HDF5", is_hdf5, "arrays:read_hdf5", _HDF5_SUFFIXES, takes_variable=True),
    Format("MATLAB", lambda head: head[124:128] in _MAT_MAGICS, "mat:read_mat", (".mat",), takes_variable=True),
    Format("TDMS", _starts(b"TDSm"), "tdms:read_tdms", (".tdms",), takes_variable=True),
    Format("UFF", lambda head: _UFF.match(head) is not None, "uff:read_uff", (".uff", ".unv"), takes_variable=True),
    Format("Parquet", _starts(b"PAR1"), "parquet:read_parquet", (".parquet",)),
    *(
        Format(name, _starts(*magics), "sound:read_audio", (f".{name.lower()}", *[".aif"] * (name == "AIFF")))
        for name, magics in AUDIO_MAGICS.items()
    ),
    Format("LVM", lambda head: b"LabVIEW Measurement" in head[:32], "lvm:read_lvm", (".lvm",), takes_variable=True),
    Format("text", lambda head: True, "text:read_text", (".csv", ".txt", ".tsv", ".asc", ".dat")),
)
#: The usual endings of recordings, for folders.
ENDINGS = tuple(ending for one in reversed(FORMATS) for ending in one.endings)


def outside_formats() -> list[OutsideFormat]:
    """Return the formats of other packages, sorted by name; skip readers that cannot be loaded."""
    from importlib.metadata import entry_points

    formats = []
    for entry in sorted(entry_points(group=READERS), key=lambda one: one.name):
        try:
            formats.append(OutsideFormat(entry.name, entry.load()))
        except KeyboardInterrupt:
            raise
        # Another package may fail in any way, and may end the process.
        except BaseException as error:
            said = f"{type(error).__name__}: {error}"
            warnings.warn(f"the reader {entry.name} ({entry.value}) cannot be loaded: {said}", stacklevel=2)
    return formats


def format_named(name: str) -> Format | OutsideFormat:
    """Return the format of a name in upper or lower case; raise `InvalidValue` with the known ones."""
    formats: list[Format | OutsideFormat] = [*FORMATS, *outside_formats()]
    format_ = next((one for one in formats if one.name.lower() == name.lower()), None)
    if format_ is None:
        raise InvalidValue(f"format must be one of {', '.join(one.name for one in formats)}, got {name!r}")
    return format_


def format_of(path: Path, source: str) -> Format | OutsideFormat:
    """Return the format of a regular file: that of its first bytes, else one of other packages, else text."""
    with path.open("rb") as file:
        head = file.read(HEAD_SIZE)
    if not head:
        raise BadData(f"{source}: a recording must contain numbers, the file is empty; record or export it again")
    format_ = next(one for one in FORMATS if one.is_format(head))
    suffix = Path(source).suffix.lower()
    # Looking for other packages takes some 20 ms.
    if format_.name == "text" and suffix not in _TEXT_SUFFIXES:
        outside = next((one for one in outside_formats() if one.is_format(head)), None)
        if outside is not None:
            return outside
    if format_.name == "text" and _JSON.match(head):
        raise BadData(f"{source}: a recording must be of a known format, this is JSON; export it as CSV or WAV")
    if format_.name == "text" and suffix in _HDF5_SUFFIXES:
        raise BadData(
            f"{source}: named like a dataset, but its content is not HDF5; rename it if it is text, else "
            f"{dataset_hint()}"
        )
    return format_


def is_dataset(path: str | Path) -> bool:
    """Return whether `path` is a directory, or an HDF5 file of cgid that is not a recording.

    `cgid.store` reads such inputs. An HDF5 file too damaged to identify counts as a dataset. A path that does not exist
    or cannot be opened does not, nor does "-", the standard input.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    bool

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
        # Open only regular files: reading from a pipe would consume its first bytes.
        if not Path(path).is_file():
            return False
        with Path(path).open("rb") as file:
            if file.read(len(HDF5_MAGIC)) != HDF5_MAGIC:
                return False
    except (OSError, ValueError):
        return False
    from cgid.store.description import RECORDING_FORMAT, hdf5_format

    stated_format = hdf5_format(Path(path))
    return stated_format is None or (stated_format.startswith("cgid") and stated_format != RECORDING_FORMAT)


def open_recording(  # noqa: PLR0913 - one argument a statement about a file
    path: str | Path,
    *,
    sampling_rate: float | None = None,
    unit: str | None = None,
    channel: int | str | Sequence[int | str] | None = None,
    variable: str | None = None,
    sensitivity: Statement | None = None,
    gain: Statement | None = None,
    full_scale: Statement | None = None,
    format: str | None = None,
    skip_broken: bool = False,
    site: Site | str | Path | None = None,
) -> RecordingFile:
    r"""Open a recording; its content determines the format, not its name, unless `format` does.

    The page "Formats of recordings" of the reference lists what is read of each format and of damaged files.

    Volts and coulombs become N or m/s^2 if `sensitivity` or the file states the sensitivity of the sensor: a line ``#
    sensitivity: 10.2 mV/g`` above a text or in the header of a UFF, an attribute, property or value of such a name.
    Otherwise they are unchanged. Each of `sensitivity`, `gain` and `full_scale` may be one value for all channels,
    a mapping of channel names or numbers to values, or a list of values, each with or without ``NAME=`` before it; the
    value of a channel takes precedence over that for all.

    Parameters
    ----------
    path : str or Path
        The file; "-" is the standard input.
    sampling_rate : float, optional
        [Hz]; required if the file does not state it. If both do, this one is used, with a warning if they differ
        by more than 0.01 %.
    unit : str, optional
        Unit of the numbers if the file does not state it; nothing is converted. "1=N, beam=m/s^2" gives those of single
        channels, by number or name.
    channel : int, str or sequence of these, optional
        Channels to read: number from 1 (the time column does not count) or name in the header; "1+2" is both.
    variable : str, optional
        Array, table or group of the file to read.
    sensitivity : str, mapping or list, optional
        Of the sensor, such as "10.2 mV/g", "2.3 mV/N", "100 mV/(m/s^2)" or "3.1 pC/g", for samples in volts or
        coulombs. A charge sensor with samples in volts needs the gain of its amplifier, such as "1 mV/pC".
    gain : float, str, mapping or list, optional
        Amplification before the recorder, which is divided out: 10, "x10", "20 dB", or "1 mV/pC" of a charge amplifier.
    full_scale : str, float, mapping or list, optional
        Value of full scale in a sound file or in signed integers of 16 bit, such as "10 V" or "50 g"; a plain
        number is in `unit`. "10 V at 24 bit" is for integers whose type does not show the resolution of the converter,
        as in a text file.
    format : str, optional
        Name of the format, such as "WAV" or that of another package's reader; by default detected from the content.
    skip_broken : bool
        Whether lines of a text that are no rows are missing samples; their times stay, and a warning counts them.
    site : Site, str or Path, optional
        A site, or its file, which states what the other arguments do not, and the names of channels.

    Returns
    -------
    RecordingFile

    Raises
    ------
    NoInput
        The file does not exist or cannot be opened.
    BadData
        The file is empty, damaged, a dataset or not a recording; it contradicts itself or `unit`.
    MissingOption
        Neither the file nor `sampling_rate` gives the sampling rate; or a charge sensor lacks its gain.
    MissingExtra
        The format needs a library that is not installed.
    InvalidValue
        An argument is invalid, does not fit the samples, or contradicts the file.

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

    An accelerometer of 100 mV/g, whose samples are in volts:

    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "hit.csv"
    ...     _ = file.write_text("time (s),beam (V)\n0.0,0.0\n0.1,0.2\n")
    ...     recording = open_recording(file, sensitivity="100 mV/g")
    ...     blocks = [block.tolist() for block in recording.blocks()]
    >>> recording.channels[0].unit, recording.channels[0].origin, blocks
    ('m/s^2', 'from V, sensitivity 100 mV/g', [[[0.0, 19.6133]]])
    """
    validation.instance("path", path, str, os.PathLike)
    chain = Chain.of(sensitivity, gain, full_scale)
    if sampling_rate is not None:
        sampling_rate = require_rate(sampling_rate)
    if unit is not None:
        units_of(unit)
    if site is not None:
        from cgid.recordings import site as sites

        site = sites.Site.of(site)
        variable, format = variable or site.get("variable"), format or site.get("format")
        skip_broken = skip_broken or bool(site.get("skip_broken"))
        site = None if site is sites.NOWHERE else site
    source = "stdin" if str(path) == "-" else str(path)
    regular, spool = _unpacked(*_regular(path, source), source)
    try:
        with clear_errors(source):
            file_format = format_of(regular, source) if format is None else format_named(format)
            recording = RecordingFile(
                file_format.read(
                    regular, source, Asked(variable=variable, sampling_rate=sampling_rate, skip_broken=skip_broken)
                ),
                source=source,
                format=file_format.name,
                sampling_rate=sampling_rate,
                unit=unit,
                channel=channel,
                chain=chain,
                site=site,
            )
    except BaseException:
        spool.close()
        raise
    weakref.finalize(recording, spool.close)
    return recording


def read_recording(  # noqa: PLR0913 - as open_recording
    path: str | Path,
    *,
    sampling_rate: float | None = None,
    unit: str | None = None,
    channel: int | str | Sequence[int | str] | None = None,
    variable: str | None = None,
    sensitivity: Statement | None = None,
    gain: Statement | None = None,
    full_scale: Statement | None = None,
    format: str | None = None,
    skip_broken: bool = False,
    site: Site | str | Path | None = None,
) -> list[Signal]:
    r"""Read a complete recording into memory.

    Parameters
    ----------
    path, sampling_rate, unit, channel, variable, sensitivity, gain, full_scale, format, skip_broken, site
        As in `open_recording`.

    Returns
    -------
    list of Signal
        One for each channel.

    Raises
    ------
    NoInput, BadData, MissingOption, MissingExtra, InvalidValue
        As in `open_recording`; `BadData` also if a number is missing or not finite, or if the recording does not fit in
        memory.

    Examples
    --------
    Integers of a recorder with a range of 10 V, and a hammer of 2 mV/N:

    >>> import tempfile
    >>> import numpy as np
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "hit.npy"
    ...     np.save(file, np.array([0, 16384, 0], np.int16))
    ...     (signal,) = read_recording(file, sampling_rate=51200, full_scale="10 V", sensitivity="2 mV/N")
    >>> signal.samples.tolist(), signal.unit
    ([0.0, 2500.0, 0.0], 'N')
    """
    return open_recording(**locals()).signals()  # the arguments are the same


# ---- streams: saved to a temporary file, since some formats have their index at the end ------------------------------


def _regular(path: str | Path, source: str) -> tuple[Path, ExitStack]:
    """Return a regular file with the content, and a stack that removes it if it is a temporary copy."""
    if not str(path):
        raise NoInput("the name of the recording must not be empty; give a file, or - for the standard input")
    try:
        with clear_errors(source):
            if str(path) == "-":
                if sys.stdin is None:
                    raise NoInput("stdin: the standard input must be open, it is closed; give a file, or pipe one in")
                if sys.stdin.buffer.isatty():
                    raise NoInput("stdin: a recording must be a file or a pipe, this is a terminal; pipe one in")
                return _saved(sys.stdin.buffer, source)
            path = Path(path)
            if path.is_dir():
                raise BadData(f"{source}: a directory is a dataset, not one recording; {dataset_hint()}")
            if path.is_char_device() or path.is_block_device():
                raise NoInput(
                    f"{source}: a recording must be a file or a pipe, this is a device; record it to a file, or follow "
                    "it by cgid monitor"
                )
            if path.exists() and not path.is_file():
                return _saved(path, source)
            # Open it once, so that its errors come first.
            path.open("rb").close()
            return path, ExitStack()
    except (BadData, NoInput):
        raise
    # ValueError: closed standard input, or a NUL byte in the name. AttributeError: standard input without a buffer.
    except (ValueError, AttributeError) as error:
        raise NoInput(f"{source!r}: the file cannot be opened ({error}); check the name") from None


def _unpacked(path: Path, spool: ExitStack, source: str) -> tuple[Path, ExitStack]:
    """Return the only file in an archive, saved, and the stack that removes it; any other file as it is."""
    with clear_errors(source), path.open("rb") as file:
        head = file.read(len(_ZIP))
    damage = library_errors(source, "the archive is damaged, cut off or encrypted", "unpack it")
    if head.startswith(_GZIP):
        import gzip

        with spool, damage, gzip.open(path) as content:
            return _saved(content, source)
    if head != _ZIP:
        return path, spool
    import zipfile

    with damage, zipfile.ZipFile(path) as archive:
        names = [one.filename for one in archive.infolist() if not one.is_dir()]
        if any(name.endswith(".npy") for name in names) or not names:
            return path, spool
        if len(names) > 1:
            what = "an Office file, save its sheet as CSV" if _OFFICE in names else "unpack it"
            raise BadData(
                f"{source}: an archive must contain one recording, it has {len(names)} files ({names[0]}, ...); {what}"
            )
        with spool, archive.open(names[0]) as content:
            return _saved(content, source)


def _saved(given: Any, source: str) -> tuple[Path, ExitStack]:
    """Save a stream to a temporary file; return its path and the stack that removes it."""
    import tempfile

    waiting = Timer(WAITING_TIME, warn_of_waiting, [source])
    waiting.daemon = True
    waiting.start()
    spool = ExitStack()
    try:
        # A pipe opens once a process writes into it.
        with given.open("rb") if isinstance(given, Path) else nullcontext(given) as stream:
            piece = stream.read(PIECE_LENGTH)
            waiting.cancel()
            if Path("/proc/self/fd").is_dir() and not is_hdf5(piece[:HEAD_SIZE]):
                # An unnamed file vanishes, however this process ends.
                file: Any = spool.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
                path = Path(f"/proc/self/fd/{file.fileno()}")
            else:
                file = tempfile.NamedTemporaryFile(prefix="cgid-", suffix=".recording", delete=False)  # noqa: SIM115
                path = Path(file.name)
                spool.callback(path.unlink, missing_ok=True)
                spool.enter_context(file)
            while piece:
                if file.tell() > MAX_STREAM:
                    raise BadData(
                        f"stream: a recording on the standard input must be at most {MAX_STREAM >> 30} GiB, this is "
                        "longer; save it as a file, or follow it by cgid monitor"
                    )
                file.write(piece)
                piece = stream.read(PIECE_LENGTH)
            file.flush()
    except BaseException as error:
        with suppress(OSError):
            spool.close()
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            folder = tempfile.gettempdir()
            raise WriteFailed(f"{folder}: the disk must have space for the stream, it is full; set TMPDIR") from None
        raise
    finally:
        waiting.cancel()
    return path, spool


def warn_of_waiting(source: str) -> None:
    """Warn that a pipe has sent nothing yet."""
    warnings.warn(
        f"{source}: no data for {WAITING_TIME:g} s, and a recording is read when its stream has ended; write into "
        "it, or follow a live one by cgid monitor",
        stacklevel=1,
    )
