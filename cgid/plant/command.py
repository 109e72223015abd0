"""A command that runs when a window should be shut or may open again."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from cgid.errors import InvalidValue
from cgid.plant.output import Output

#: Time limit of a command [s]; maximum number of switches that wait for it.
MAX_RUN_TIME, MAX_PENDING = 30.0, 100
#: Descriptors needed to start a command, with a margin.
N_RESERVED = 10


class Command(Output):
    """Run one command at a time, without a shell; it gets the switch as JSON on stdin and in its environment."""

    # Descriptors are reserved between the runs, so that it can start even if none are left.

    def __init__(self, option: str, command: str, kind: str, warn: Callable[[str], None]) -> None:
        super().__init__(option, warn, MAX_PENDING)
        try:
            self._words = shlex.split(command, posix=os.name != "nt")
        except ValueError as error:
            raise InvalidValue(f"{option} must be a command, got {command!r} ({error}); check its quotes") from None
        if not self._words or shutil.which(self._words[0]) is None:
            word = self._words[0] if self._words else command
            raise InvalidValue(
                f"{option} must begin with a program that can be run, got {word!r}; give its full path (a line for a "
                "shell: sh -c 'LINE')"
            )
        self._kind, self._longest = kind, MAX_RUN_TIME
        self.up = True
        self.reserved: list[int] = []

    def put(self, record: dict[str, Any]) -> None:
        """Queue a switch."""
        if record["kind"] == self._kind:
            super().put(record)

    def _reserve(self) -> None:
        with suppress(OSError):
            while len(self.reserved) < N_RESERVED:
                self.reserved.append(os.open(os.devnull, os.O_RDONLY))

    def _release(self) -> None:
        while self.reserved:
            os.close(self.reserved.pop())

    def run(self) -> None:
        """Run the command for each switch, including those pending at the end."""
        self._reserve()
        while True:
            record = self._next()
            if record is not None:
                self._release()
                self._run(record)
                self._reserve()
            elif self._ending:
                return self._release()

    def _run(self, record: dict[str, Any]) -> None:
        more = {
            "CGID_TURN": record["kind"],
            "CGID_CHANNEL": record["channel"],
            "CGID_TIME": f"{record['time_s']:.6f}",
            "CGID_SHARE": f"{record['gangue_share']:.4f}",
        }
        text = json.dumps(record).encode()
        try:
            # Its output must not mix with the table on stdout.
            done = subprocess.run(
                self._words,
                input=text,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | more,
                timeout=self._longest,
            )
        except subprocess.TimeoutExpired:
            fault = f"took longer than {self._longest:g} s and was ended"
        except (OSError, ValueError) as error:
            fault = f"cannot be run ({getattr(error, 'strerror', None) or error})"
        else:
            fault = f"failed with exit code {done.returncode}" if done.returncode else ""
        self.up, self.passed = not fault, self.passed + (not fault)
        if fault:
            self._last_message = ""  # each missed switch is reported
            self.report(f"the command {fault} (channel {record['channel']}, {record['time_s']:.6g} s)")
