"""Common parts of all outputs: a bounded queue, and their libraries."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from cgid.errors import optional
from cgid.pages.server import Service

#: Maximum number of messages that wait for an output: a quarter of an hour at ten a second.
MAX_WAITING = 10_000
#: Time between attempts to reach an output: the first, doubling up to the longest [s].
FIRST_PAUSE, MAX_PAUSE = 1, 30


class Output(Service):
    """A service with a queue of messages that drops the oldest; `up`: whether the receiver is there."""

    def __init__(self, name: str, warn: Callable[[str], None], max_waiting: int = MAX_WAITING) -> None:
        super().__init__(name, warn)
        self._waiting: deque[dict[str, Any]] = deque()
        self._most = max_waiting
        self.passed = self.dropped = 0
        self.up = False

    def put(self, record: dict[str, Any]) -> None:
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

    def _next(self, ready: Callable[[], bool] = lambda: True, timeout: float = 0.5) -> dict[str, Any] | None:
        """Return the next message once the output is ready; None after a while or at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or (self._waiting and ready()), timeout)
            return self._waiting.popleft() if self._waiting and ready() else None


def library(module: str, option: str, package: str) -> Any:
    """Return the module of an output; raises `MissingExtra` if it is not installed."""
    return optional(module, f"{option} needs", "plant", name=package)
