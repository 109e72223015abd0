"""What has come from a live stream and is still to be treated: nothing is dropped, and how much waits is known."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterable, Iterator
from threading import Condition, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: So much may wait [bytes],
MOST_WAITING = 128 << 20
#: and so much of it is taken at once: what is made of it takes many times more.
MOST_TAKEN = 8 << 20
#: Blocks are joined until they last so long [s]: short ones cost more than they hold.
LEAST_TIME = 0.05
#: But nobody waits longer than this for them [s].
_PATIENCE = 0.1


class UnbufferedInput:
    """A file descriptor as a binary file that returns what there is; a thread that waits in it can be left behind."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def read(self, size: int) -> bytes:
        """Return so many bytes, fewer only at the end."""
        parts, left = [], size
        while left and (part := os.read(self._descriptor, left)):
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def read1(self, size: int) -> bytes:
        """Return what has come, at most so many bytes; none at the end."""
        return os.read(self._descriptor, size)


class Inbox:
    """Reads blocks (n_channels, n_samples) in a thread of its own, so that the stream can go on meanwhile.

    Parameters
    ----------
    blocks : iterable of ndarray
        What it raises is raised again for who takes the blocks, after those before it.
    sampling_rate : float
        [Hz].
    most_waiting : int
        So much may wait [bytes]; then the stream is not read on until there is room, and its source has to wait.

    Attributes
    ----------
    n_taken : int
        Samples of each channel that were taken out.
    held_up : bool
        Whether the stream ever had to wait.
    """

    def __init__(self, blocks: Iterable[NDArray[Any]], sampling_rate: float, most_waiting: int = MOST_WAITING) -> None:
        self._blocks, self._rate, self._most = blocks, sampling_rate, most_waiting
        self._changed = Condition()
        self._waiting: deque[NDArray[Any]] = deque()
        self._n_waiting = self._size = 0
        self._ended = False
        self._fault: BaseException | None = None
        self._begun = time.monotonic()
        self.n_taken = 0
        self.held_up = False

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield all that has come, joined, as soon as there is some; may be asked for once."""
        Thread(target=self._read, daemon=True).start()
        while (block := self._next()) is not None:
            self.n_taken += block.shape[1]
            yield block
        if self._fault is not None:
            raise self._fault

    @property
    def behind(self) -> float:
        """How far the answers are behind the stream [s]: never more than what waits.

        Nor more than the clock is ahead of what was taken: a stream that comes faster than time is no live one.
        """
        return max(min(self._n_waiting / self._rate, self._clock - self.n_taken / self._rate), 0.0)

    @property
    def _clock(self) -> float:
        return time.monotonic() - self._begun

    def _read(self) -> None:
        try:
            for block in self._blocks:
                with self._changed:
                    self.held_up = self.held_up or self._size > self._most
                    self._changed.wait_for(lambda: self._size <= self._most)
                    self._waiting.append(block)
                    self._n_waiting += block.shape[1]
                    self._size += block.nbytes
                    self._changed.notify_all()
        except BaseException as error:  # whoever takes the blocks says it
            self._fault = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _next(self) -> NDArray[Any] | None:
        """Return the blocks that wait as one, None at the end."""
        with self._changed:
            # Waits end now and then, so that an interruption is heard.
            while not self._changed.wait_for(lambda: self._waiting or self._ended, 1.0):
                pass
            self._changed.wait_for(lambda: self._ended or self._n_waiting >= LEAST_TIME * self._rate, _PATIENCE)
            blocks, size = [], 0
            while self._waiting and size < MOST_TAKEN:
                blocks.append(self._waiting.popleft())
                size += blocks[-1].nbytes
            self._n_waiting -= sum(block.shape[1] for block in blocks)
            self._size -= size
            self._changed.notify_all()
        if not blocks:
            return None
        return blocks[0] if len(blocks) == 1 else np.concatenate(blocks, axis=1)
