"""Read samples as they arrive: raw numbers or a WAV of unknown length on the standard input."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Condition, Thread
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid._lib.validation import require_rate
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.recordings.chain import Chain, scaled, units_of
from cgid.recordings.formats import AUDIO_MAGICS, FORMATS, WAV_MAGICS
from cgid.recordings.recording import MAX_CHANNELS, Blocks, Channel
from cgid.recordings.sound import ENDLESS, Coding, read_wave_head

if TYPE_CHECKING:
    from cgid.recordings.site import Site

#: Blocks are joined up to this duration [s], because short ones are inefficient.
SHORTEST = 0.05
#: Short blocks of a stream that pauses wait for at most this time [s].
_PATIENCE = 0.1
#: Maximum amount of data that waits, and that is taken at once [bytes]: processing takes many times more memory.
MAX_WAITING, MAX_READ = 128 << 20, 8 << 20
#: Most numbers to read from the stream at once.
_MAX_NUMBERS = 1 << 16
#: Number of bytes that tell a text from numbers of more than one byte each.
_TELLING = 32
_NOT_RAW = "{}: a stream must be raw numbers or WAV, this is {}; give it to cgid predict"
#: First bytes of formats that can only be read as complete files.
_FILES = {
    b"\x93NUM": "an NPY file",
    b"PK\3\4": "an archive",
    b"\x89HDF": "an HDF5 file",
    b"TDSm": "a TDMS file",
    b"PAR1": "a Parquet file",
    **{magic[:4]: f"{name} sound" for name, magics in AUDIO_MAGICS.items() for magic in magics},
}


@dataclass(kw_only=True)
class LiveStream:
    """Samples that arrive while they are recorded; made by `live_stream`, iterated over once."""

    # factors : of each channel, from numbers to its unit; warnings : complete when the stream has ended size : bytes of
    # sound; None if unknown until the stream ends

    file: BinaryIO
    coding: Coding
    sampling_rate: float
    channels: Sequence[Channel]
    factors: Sequence[float] = ()
    source: str = "stdin"
    n_samples: int = 0
    warnings: list[str] = field(default_factory=list)
    head: bytes = b""
    size: int | None = None
    is_wav: bool = False
    beams: tuple[tuple[str, ...], ...] = ()  # channels of each beam with several

    @property
    def n_channels(self) -> int:
        """Number of channels."""
        return len(self.channels)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield samples as they arrive, (n_channels, n); never wait for a full block."""
        frame_size = self.n_channels * self.coding.width
        pending, left = self.head, self.size
        may_be_text = self.coding.width > 1 and _is_text(self.head)  # a number of one byte may be a letter
        while True:
            if may_be_text and len(pending) >= _TELLING:
                if _is_text(pending[:_TELLING]):
                    raise BadData(_NOT_RAW.format(self.source, "text"))
                may_be_text = False
            n_complete = 0 if may_be_text else len(pending) - len(pending) % frame_size
            if n_complete:
                samples = self.coding.decoded(pending[:n_complete]).reshape(-1, self.n_channels)
                self.n_samples += len(samples)
                yield from scaled([np.ascontiguousarray(samples.T)], self.factors)
                pending = pending[n_complete:]
            max_bytes = max(1, _MAX_NUMBERS // self.n_channels) * frame_size
            raw = _available(self.file, max_bytes if left is None else min(max_bytes, left))
            if left is not None:
                left -= len(raw)
            if not raw and not may_be_text:
                break
            may_be_text = may_be_text and bool(raw)
            pending += raw
        if left:
            self.warnings.append(f"the header declares {left} more bytes of sound than arrived; the stream was cut off")
        if pending:
            self.warnings.append(
                f"the stream ended within a sample of {frame_size} bytes; the last {len(pending)} were left out"
            )
        if not self.n_samples:
            raise BadData(f"{self.source}: a stream must contain samples, it ended before the first; check its source")


def live_stream(
    file: BinaryIO,
    *,
    sampling_rate: float | None = None,
    n_channels: int | None = None,
    sample_format: str | None = None,
    unit: str | None = None,
    source: str = "stdin",
    chain: Chain | None = None,
    site: Site | None = None,
) -> LiveStream:
    """Return a stream of samples: a WAV by its header, anything else as raw numbers with interleaved channels."""
    units_of(unit)
    if site is not None:
        sampling_rate = site.get("rate") if sampling_rate is None else sampling_rate
        n_channels = site.get("channels") if n_channels is None else n_channels
        sample_format = site.get("sample_format") if sample_format is None else sample_format
    given = None if sampling_rate is None else require_rate(sampling_rate)
    if n_channels is not None and validation.count("n_channels", n_channels) > MAX_CHANNELS:
        raise InvalidValue(f"n_channels must be at most {MAX_CHANNELS}, got {n_channels}")
    coding = None if sample_format is None else Coding.of_name(sample_format)
    start = file.read(4)
    if not start:
        raise BadData(f"{source}: a stream must contain samples, it is empty; check its source")
    if start.startswith(WAV_MAGICS):
        head = read_wave_head(file, partial(_skip, file), source, start)
        if not 0 < head.n_channels <= MAX_CHANNELS:
            raise BadData(f"{source}: a stream must be of 1 to {MAX_CHANNELS} channels, got {head.n_channels}")
        for name, stated, actual in (("channels", n_channels, head.n_channels), ("sample_format", coding, head.coding)):
            if stated not in (None, actual):
                says = (
                    f"got {stated} where the WAV header states {actual}"
                    if name == "channels"
                    else "the WAV header states another"
                )
                raise InvalidValue(f"{source}: {name} must agree with the stream, {says}; leave out {spelled(name)}")
        is_integer = head.coding.kind != "f"
        contents = contents_of(head.n_channels, "FS", is_integer=is_integer, rate=head.sampling_rate)
        size = head.data_size if 0 < head.data_size < ENDLESS else None
        contents.warnings.extend(head.warnings)
        about: dict[str, Any] = {"coding": head.coding, "size": size, "is_wav": True}
    else:
        whole = _FILES.get(start) or _named_format(source) or ("text" if coding is None and _is_text(start) else None)
        if whole is not None:
            raise BadData(_NOT_RAW.format(source, whole))
        wanted = {
            "sample_format": ("s16le", coding),
            "sampling_rate": ("HZ", given),
            "channels": ("NUMBER", n_channels),
        }
        if missing := [spelled(name, like) for name, (like, known) in wanted.items() if known is None]:
            raise MissingOption(
                f"{source}: a raw stream does not state how numbers are written, its rate and channels; give "
                f"{' '.join(missing)}"
            )
        assert coding is not None and n_channels is not None
        is_integer = coding.kind != "f"
        contents = contents_of(n_channels, "FS" if is_integer else None, is_integer=is_integer)
        about = {"coding": coding, "head": start}
    channels, factors, beams = described(contents, unit, chain or Chain(), site, source)
    return LiveStream(
        file=file,
        sampling_rate=require_rate(contents.rate(given, source)),
        channels=channels,
        beams=beams,
        factors=factors,
        source=source,
        warnings=contents.warnings,
        **about,
    )


class Inbox:
    """Blocks (n_channels, n_samples) of a live stream that wait until they are taken, by one thread, joined."""

    # If more than `max_waiting` bytes wait, the source has to wait, too. Fewer samples than `SHORTEST`
    # are taken after `patience` [s], if any, or at the end.

    def __init__(
        self, sampling_rate: float, *, max_waiting: int = MAX_WAITING, patience: float | None = _PATIENCE
    ) -> None:
        self._rate, self._most, self._patience = sampling_rate, max_waiting, patience
        self._changed = Condition()
        self._waiting: deque[NDArray[Any]] = deque()
        self._n_waiting = self._size = 0
        self._ended = self._is_asked = self._is_closed = False
        self._fault: BaseException | None = None
        self._begun = time.monotonic()
        self.n_given = self.n_taken = 0
        self._waiting_since: float | None = None
        #: A time [s], and a function that is called once with the time without samples when they pause for so long.
        self.on_pause: tuple[float, Callable[[float], object]] | None = None

    def read(self, blocks: Iterable[NDArray[Any]]) -> None:
        """Take all blocks, in a thread of its own; an exception of theirs is raised where they are taken."""
        Thread(target=self._read, args=(blocks,), daemon=True).start()

    def put(self, block: NDArray[Any]) -> None:
        """Add the next block; wait while memory is full."""
        with self._changed:
            self._changed.wait_for(lambda: self._size <= self._most or self._is_closed)
            self._waiting.append(block)
            self._n_waiting += block.shape[1]
            self.n_given += block.shape[1]
            self._size += block.nbytes
            self._changed.notify_all()

    def end(self) -> None:
        """State that no block follows."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def close(self) -> None:
        """State that no block is taken any more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def wait_until_idle(self) -> None:
        """Wait until who takes them asks for more than there is, or takes none any more."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_closed or (self._is_asked and not self._is_enough()))

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield all waiting blocks, joined, as soon as there are enough; may be called once."""
        while (block := self._next()) is not None:
            self.n_taken += block.shape[1]
            yield block
        if self._fault is not None:
            raise self._fault

    @property
    def behind(self) -> float:
        """Delay of the answers relative to the stream [s], at most the duration of the waiting samples."""
        # A stream faster than real time is not live, so it is also at most the lead of the clock over the samples
        # taken.
        return max(min(self._n_waiting / self._rate, self._clock - self.n_taken / self._rate), 0.0)

    @property
    def waited(self) -> float:
        """Time for which samples have been waited for [s]; 0 while there are some."""
        since = self._waiting_since
        return 0.0 if since is None else time.monotonic() - since

    @property
    def _clock(self) -> float:
        return time.monotonic() - self._begun

    def _is_enough(self) -> bool:
        return self._ended or self._n_waiting >= SHORTEST * self._rate

    def _read(self, blocks: Iterable[NDArray[Any]]) -> None:
        try:
            for block in blocks:
                self.put(block)
        except BaseException as error:  # raised again for the consumer
            self._fault = error
        finally:
            self.end()

    def _next(self) -> NDArray[Any] | None:
        """Return the waiting blocks as one, None at the end."""
        self._wait()
        with self._changed:
            self._changed.wait_for(self._is_enough, self._patience)
            self._is_asked = False
            blocks, size = [], 0
            while self._waiting and size < MAX_READ:
                blocks.append(self._waiting.popleft())
                size += blocks[-1].nbytes
            self._n_waiting -= sum(block.shape[1] for block in blocks)
            self._size -= size
            self._changed.notify_all()
        if not blocks:
            return None
        return blocks[0] if len(blocks) == 1 else np.concatenate(blocks, axis=1)

    def _wait(self) -> None:
        """Wait for the next block or the end."""
        is_told, self._waiting_since = self.on_pause is None, time.monotonic()
        while True:
            with self._changed:  # with a timeout, so that an interruption is noticed
                self._is_asked = True
                self._changed.notify_all()
                if self._changed.wait_for(lambda: self._waiting or self._ended, 0.5):
                    self._waiting_since = None
                    return
            if self.on_pause is not None and not is_told and self.waited >= self.on_pause[0]:
                is_told = True
                self.on_pause[1](self.waited)


class Described(NamedTuple):
    """The channels of a stream, the factor of each from numbers to its unit, and those of each beam with several."""

    channels: list[Channel]
    factors: list[float]
    beams: tuple[tuple[str, ...], ...]


def described(contents: Blocks, unit: str | None, chain: Chain, site: Site | None, source: str) -> Described:
    """Return the channels of a stream by what it, its user and a site state."""
    beams: tuple[tuple[str, ...], ...] = ()
    if site is not None:
        contents, chain = site.applied(contents, chain, source)
        beams = site.beams(contents, source)
    links = chain.links(contents, range(contents.n_channels), unit, source)
    names = [contents.label(k) for k in range(len(links))]
    channels = [Channel(name=name, unit=one.unit, origin=one.origin) for name, one in zip(names, links, strict=True)]
    return Described(channels, [link.factor for link in links], beams)


def contents_of(
    n_channels: int,
    fallback_unit: str | None,
    *,
    is_integer: bool = False,
    rate: float | None = None,
    names: list[str] | None = None,
) -> Blocks:
    """Return what a stream states of its channels."""
    return Blocks(
        n_channels=n_channels,
        read=lambda length, channels: iter(()),
        sampling_rate=rate,
        rate_from="WAV header",
        names=names or (),
        fallback_unit=fallback_unit,
        full_scales=[1.0] * n_channels,
        integers=[is_integer] * n_channels,
    )


def _named_format(source: str) -> str | None:
    """Return what the name of a file says that it is, if that must be read whole."""
    ending = Path(source).suffix.lower()
    # Raw numbers are often called .dat, and a WAV is known by its head.
    known = (one.name for one in FORMATS if ending in one.endings and ending not in (".dat", ".wav"))
    return next((f"named as {name}" for name in known), None)


def _is_text(start: bytes) -> bool:
    """Return whether the first bytes are those of a text, as far as so few tell."""
    is_plain = len(start) >= 4 and all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in start)
    return (is_plain and (len(start) == 4 or len(set(start)) > 4)) or start.startswith(b"\xef\xbb\xbf")


def _skip(file: BinaryIO, size: int) -> None:
    while size > 0 and (passed := len(file.read(min(size, 1 << 16)))):
        size -= passed


def _available(file: BinaryIO, max_bytes: int) -> bytes:
    """Return the bytes that have arrived, at least one unless the stream has ended."""
    if not max_bytes:
        return b""
    # `read` of a buffered file waits for all bytes; its `read1`, and `read` of a raw file, do not.
    read = getattr(file, "read1", file.read)
    return read(max_bytes) or b""
