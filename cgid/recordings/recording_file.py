"""A recording on disk, ready to be read by blocks: the file has spoken, and so have the options."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CgidError, NoInput
from cgid.recordings.contents import Contents
from cgid.recordings.sound.pcm import MOST_NUMBERS
from cgid.signals import Signal, quantity_of
from cgid.validation import require_rate

#: Samples of a channel that are read at once if nobody says otherwise.
BLOCK_LENGTH = 1 << 16


@dataclass(frozen=True, kw_only=True)
class Channel:
    """One channel of a recording.

    Attributes
    ----------
    name : str
        As the file says, else its number from 1.
    unit : str or None
        None where nobody said.
    """

    name: str
    unit: str | None = None

    @property
    def quantity(self) -> str | None:
        """The physical quantity of the unit; None when the unit is unknown."""
        return None if self.unit is None else quantity_of(self.unit)


class RecordingFile:
    """A recording that is read by blocks, so that it may be longer than memory; made by `open_recording`.

    Attributes
    ----------
    source : str
        The file's name.
    format : str
        Such as "WAV".
    sampling_rate : float
        [Hz].
    channels : tuple of Channel
        Those asked for.
    n_samples : int or None
        Of each channel, as the file says; None where only reading tells.
    start_time : datetime or None
        When the first sample was taken, where the file says it.
    """

    def __init__(
        self,
        contents: Contents,
        *,
        source: str,
        format: str,
        sampling_rate: float | None,
        unit: str | None,
        channel: int | str | Sequence[int | str] | None,
    ) -> None:
        contents.require_channels(source)
        self._contents = contents
        self._selected = _selected(contents, channel, source)
        self.source, self.format = source, format
        self.sampling_rate = require_rate(contents.rate(sampling_rate, source))
        self.channels = tuple(
            Channel(name=contents.label(index), unit=contents.unit(index, unit, source)) for index in self._selected
        )
        self.n_samples, self.start_time = contents.n_samples, contents.start_time

    @property
    def duration(self) -> float | None:
        """Length of the recording [s]; None where only reading tells."""
        return None if self.n_samples is None else self.n_samples / self.sampling_rate

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is damaged and was left out, one line each; complete once all blocks have been read."""
        return tuple(f"{self.source}: {warning}" for warning in dict.fromkeys(self._contents.warnings))

    def blocks(self, length: int = BLOCK_LENGTH) -> Iterator[NDArray[Any]]:
        """Yield the samples in order, (n_channels, at most `length`), float32 or float64.

        Raises
        ------
        BadData
            A number is not finite (channel and sample are named), or the file is damaged where nothing can be left
            out.
        NoInput
            The file is gone or its rights have changed.
        """
        first = 0
        for block in self._blocks(length):
            finite = np.isfinite(block)
            if not finite.all():
                row, column = np.argwhere(~finite)[0]
                raise BadData(
                    f"{self._name(row)}: samples must be finite, sample {first + column} is {block[row, column]}; "
                    "cut or repair the recording there"
                )
            first += block.shape[1]
            yield block

    def signals(self) -> list[Signal]:
        """Return one `Signal` a channel, all of it in memory.

        Raises
        ------
        BadData
            As `blocks`, or the recording does not fit in memory.
        """
        try:
            samples = self._whole()
        except MemoryError:
            raise BadData(f"{self.source}: the recording must fit in memory and does not; cut it into parts") from None
        return [
            Signal(
                samples=row,
                sampling_rate=self.sampling_rate,
                unit=channel.unit,
                source=self.source,
                channel=channel.name,
                start_time=self.start_time,
                warnings=self.warnings,
            )
            for row, channel in zip(samples, self.channels, strict=True)
        ]

    def _blocks(self, length: int) -> Iterator[NDArray[Any]]:
        count = 0
        # Memory does not grow with the number of channels either.
        length = min(length, max(MOST_NUMBERS // self._contents.n_channels, 1))
        with told(self.source):
            for block in self._contents.blocks(length, self._selected):
                count += block.shape[1]
                yield block
        if not count:
            raise BadData(f"{self.source}: a recording must hold at least one sample, there is none; record it again")

    def _whole(self) -> NDArray[Any]:
        if self.n_samples is None:
            return np.concatenate(list(self._blocks(BLOCK_LENGTH)), axis=1)
        out, filled = np.empty((len(self._selected), 0)), 0
        for block in self._blocks(BLOCK_LENGTH):
            if not filled:
                out = np.empty((len(block), self.n_samples), block.dtype)
            out[:, filled : filled + block.shape[1]] = block
            filled += block.shape[1]
        return out[:, :filled]

    def _name(self, row: int) -> str:
        channel = self.channels[row].name
        return self.source if channel == "1" else f"{self.source} channel {channel}"


def _selected(contents: Contents, channel: int | str | Sequence[int | str] | None, source: str) -> tuple[int, ...]:
    if channel is None:
        return tuple(range(contents.n_channels))
    asked = [channel] if isinstance(channel, int | str) else list(channel)
    return tuple(dict.fromkeys(index for one in asked for index in contents.selected(one, source)))


@contextmanager
def told(source: str) -> Iterator[None]:
    """Say why a file cannot be opened or read, in one line."""
    try:
        yield
    except CgidError:
        raise
    except FileNotFoundError:
        raise NoInput(f"{source}: the file must exist and does not; check the name") from None
    except PermissionError:
        raise NoInput(f"{source}: the file must be readable, permission is denied; check its rights") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise NoInput(f"{source!r}: the file cannot be opened ({reason}); check the name") from None
