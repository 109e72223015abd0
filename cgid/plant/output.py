"""Common parts of all outputs: a bounded queue, and their libraries; stdout as one of them."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from cgid.errors import optional
from cgid.pages.server import Service, since

#: Maximum number of messages that wait for an output: a quarter of an hour at ten a second.
MAX_WAITING = 10_000
#: Time between attempts to reach an output: the first, doubling up to the longest [s].
FIRST_PAUSE, MAX_PAUSE = 1, 30
#: After this time [s] without a byte read, stdout has no reader; how often that is looked at [s].
UNREAD, _LOOK = 5.0, 0.1


class Output(Service):
    """A service with a queue of messages that drops the oldest; `up`: whether the receiver is there."""

    def __init__(self, name: str, warn: Callable[[str], None], max_waiting: int = MAX_WAITING) -> None:
        super().__init__(name, warn)
        self._waiting: deque[Any] = deque()
        self._most = max_waiting
        self.passed = self.dropped = 0
        self.up = False

    def put(self, record: Any) -> None:
        """Queue a message; never blocks."""
        with self._changed:
            if len(self._waiting) >= self._most:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(record)
            self._changed.notify_all()

    def statuses(self) -> list[dict[str, Any]]:
        """Return the name, whether it is up, and the counts of each receiver."""
        counts = {"passed": self.passed, "dropped": self.dropped, "waiting": len(self._waiting)}
        return [{"name": self.name, "up": self.up, **counts}]

    def _next(self, ready: Callable[[], bool] = lambda: True, timeout: float = 0.5) -> Any:
        """Return the next message once the output is ready; None after a while or at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or (self._waiting and ready()), timeout)
            self._changed.notify_all()
            return self._waiting.popleft() if self._waiting and ready() else None


class Stdout(Output):
    """Lines for the descriptor of stdout beside other outputs, which a reader who is away does not hold up."""

    # As long as somebody reads, a full queue waits: a file is faster than its reader. What cannot be written is tried
    # again, as a disk may have room again and a named pipe another reader.

    def __init__(self, descriptor: int, warn: Callable[[str], None], max_waiting: int = MAX_WAITING) -> None:
        super().__init__("stdout", warn, max_waiting)
        self._descriptor, self.up = descriptor, True
        self._begun: float | None = None  # when a part of the line that is being written was taken last

    def put(self, record: Any) -> None:
        """Queue a line."""
        with self._changed:
            while self.up and self._is_read and len(self._waiting) >= self._most:
                self._changed.wait(_LOOK)
        if self.up and not self._is_read:
            self._lose(f"nobody has read it for {UNREAD:g} s")
        super().put(record)

    @property
    def _is_read(self) -> bool:
        return self._begun is None or since(self._begun) < UNREAD

    def run(self) -> None:
        """Write lines until the end."""
        while self._waiting or not self._ending:
            if (line := self._next()) is not None:
                self._write(f"{line}\n".encode(errors="backslashreplace"))
                self._begun = None

    def wait(self, grace: float) -> None:
        """Wait for the end as long as somebody reads, and tell how many lines are lost."""
        passed, at = self.passed, time.monotonic()
        while self._thread.is_alive() and since(at) < UNREAD:
            self._thread.join(_LOOK)
            if self.passed > passed:
                passed, at = self.passed, time.monotonic()
        if lost := self.dropped + len(self._waiting) + self._thread.is_alive():
            self.report(f"{lost} of its lines are lost")

    def _write(self, line: bytes) -> None:
        pause = FIRST_PAUSE
        while line:
            self._begun = time.monotonic()
            try:
                line = line[os.write(self._descriptor, line) :]
            except OSError as error:
                self._lose(error.strerror or str(error))
                if self._ending:
                    self.dropped += 1
                    return
                with self._changed:
                    self._changed.wait_for(lambda: self._ending, pause)
                pause = min(2 * pause, MAX_PAUSE)
        self.passed += 1
        if not self.up:
            self.up = True
            self.report(f"its lines are written again; {self.dropped} are lost")

    def _lose(self, reason: str) -> None:
        self.up = False
        self.report(f"{reason}; {self._most} lines wait at most, all other outputs go on")


def library(module: str, option: str, package: str) -> Any:
    """Return the module of an output; raises `MissingExtra` if it is not installed."""
    return optional(module, f"{option} needs", "plant", name=package)
