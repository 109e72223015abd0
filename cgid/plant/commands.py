"""Commands that run when a window should be shut, when it may open again, and when its support is no longer seen."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock, Thread
from typing import Any

from cgid._lib.spelling import spelled
from cgid.errors import InvalidValue
from cgid.identification.prediction.support import Ground
from cgid.pages.server import since
from cgid.plant.output import Output
from cgid.plant.state import PlantState, Record, stamped

#: Time limit of a command [s]; a command that waits longer than this for the one before it is reported [s].
MAX_RUN_TIME, MAX_WAIT = 30.0, 1.0
#: Descriptors needed to start a command, with a margin.
N_RESERVED = 10


@dataclass
class EventCommand:
    """The command of one option, and its counts."""

    option: str
    words: list[str]
    up: bool = True
    passed: int = 0
    dropped: int = 0

    @classmethod
    def of(cls, option: str, text: str) -> EventCommand:
        """Return the command of a line; raises `InvalidValue`."""
        try:
            words = shlex.split(text, posix=os.name != "nt")
        except ValueError as error:
            raise InvalidValue(f"{option} must be a command, got {text!r} ({error}); check its quotes") from None
        if not words or shutil.which(words[0]) is None:
            word = words[0] if words else text
            raise InvalidValue(
                f"{option} must begin with a program that can be run, got {word!r}; give its full path (a line for a "
                "shell: sh -c 'LINE')"
            )
        return cls(option, words)


@dataclass
class _Turn:
    """What waits for the command before it."""

    kind: str
    record: Record
    put_at: float
    is_late: bool = False

    def line(self, text: str) -> str:
        """Return a line about it."""
        return f"{spelled(f'on_{self.kind}')}: {text} (channel {self.record['channel']}, {self.record['time_s']:.6g} s)"


class Commands(Output):
    """Run commands without a shell: one at a time for each support, supports side by side, the newest turn only."""

    # A command gets the line as JSON on stdin, and its turn in its environment. Descriptors are reserved between the
    # starts, so that one can start even if none are left.

    def __init__(self, lines: Mapping[str, str], plant: PlantState, warn: Callable[[str], None]) -> None:
        super().__init__("commands", warn)
        self._plant, self._longest = plant, MAX_RUN_TIME
        self._commands = {kind: EventCommand.of(spelled(f"on_{kind}"), line) for kind, line in lines.items()}
        self._turns: dict[str, _Turn] = {}  # those that wait, by channel
        self._running: set[str] = set()
        self._blind: set[str] = set()
        self._lines: list[str] = []  # for stderr
        self._starting = Lock()
        self.reserved: list[int] = []

    def put(self, record: dict[str, Any]) -> None:
        """Take a turn in place of an older one of its support that waits."""
        with self._changed:
            if record["kind"] in ("shut", "open"):
                self._take(record["kind"], record)
            if record["kind"] in ("shut", "open", "state"):
                self._take_blind()

    def statuses(self) -> list[dict[str, Any]]:
        """Return the name, whether its last run worked, and the counts of each command."""
        with self._changed:
            waiting = [turn.kind for turn in self._turns.values()]
        return [
            {
                "name": f"--on-{kind}",
                "up": of.up,
                "passed": of.passed,
                "dropped": of.dropped,
                "waiting": waiting.count(kind),
            }
            for kind, of in self._commands.items()
        ]

    def run(self) -> None:
        """Look for supports that are no longer seen, and report, until all commands have run at the end."""
        self._reserve()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ending, 0.2)
                self._take_blind()
                self._start_all()
                for turn in self._turns.values():
                    if not turn.is_late and since(turn.put_at) > MAX_WAIT:
                        turn.is_late = True
                        self._lines.append(turn.line(f"waits for the command before it for more than {MAX_WAIT:g} s"))
                done = self._ending and not self._turns and not self._running
            self._print_lines()
            if done:
                return self._release()
            if self._ending:
                time.sleep(0.05)

    def wait(self, grace: float) -> None:
        """Wait for the end of the commands, at most for this time [s], and report those that will not run."""
        super().wait(grace)
        with self._changed:
            missed = "not run: the watch ends before the command before it"
            self._lines += [turn.line(missed) for turn in self._turns.values()]
            self._turns.clear()
        self._print_lines()

    def _take_blind(self) -> None:
        """Take a turn of each support that is no longer seen."""
        for record in self._plant.records():
            channel = record["channel"]
            if record["ground"] not in (Ground.BLIND, Ground.STOPPED):
                self._blind.discard(channel)
            elif channel not in self._blind and not self._plant.ended:
                self._blind.add(channel)
                self._take("blind", {"kind": "state", "source": self._plant.source, **stamped(record)})

    def _take(self, kind: str, record: Record) -> None:
        """Replace the turn of a support that waits."""
        channel = record["channel"]
        before = self._turns.get(channel)
        if before is not None and before.kind == "shut" and kind == "blind" and kind not in self._commands:
            return  # nothing safer comes in its place
        if before is not None:
            del self._turns[channel]
            self._commands[before.kind].dropped += 1
            self._lines.append(before.line(f"not run: replaced by {kind.upper()} before it could start"))
        if kind in self._commands:
            self._turns[channel] = _Turn(kind, record, time.monotonic())
            self._start_all()

    def _start_all(self) -> None:
        """Start a thread for each support with a turn and none."""
        for channel in self._turns.keys() - self._running:
            with suppress(RuntimeError):  # no thread can be started now: the next try is soon
                Thread(target=self._run_all, args=(channel,), name=f"command {channel}", daemon=True).start()
                self._running.add(channel)

    def _run_all(self, channel: str) -> None:
        """Run the newest command of a support until none waits."""
        while True:
            with self._changed:
                turn = self._turns.pop(channel, None)
                if turn is None:
                    return self._running.discard(channel)
            self._run(turn)

    def _run(self, turn: _Turn) -> None:
        record, command = turn.record, self._commands[turn.kind]
        share = record["gangue_share"]
        more = {
            "CGID_TURN": turn.kind,
            "CGID_CHANNEL": record["channel"],
            "CGID_TIME": f"{record['time_s']:.6f}",
            "CGID_SHARE": "nan" if share is None else f"{share:.4f}",
            "CGID_GROUND": record["ground"],
        }
        try:
            process = self._started(command.words, json.dumps(record).encode(), more)
            try:
                code = process.wait(self._longest)
                fault = f"failed with exit code {code}" if code else ""
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                fault = f"took longer than {self._longest:g} s and was ended"
        except (OSError, ValueError) as error:
            fault = f"cannot be run ({getattr(error, 'strerror', None) or error})"
        with self._changed:
            command.up, command.passed = not fault, command.passed + (not fault)
            if fault:
                self._lines.append(turn.line(f"the command {fault}"))
            self._changed.notify_all()

    def _started(self, words: list[str], line: bytes, more: dict[str, str]) -> subprocess.Popen[bytes]:
        """Start a command with a line on its stdin."""
        with self._starting:
            self._release()
            try:
                # Its output must not mix with the table on stdout.
                process = subprocess.Popen(
                    words,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    env=os.environ | more,
                )
                assert process.stdin is not None
                # The line fits into a pipe, so this does not wait for the command, which may not read it.
                with suppress(OSError), process.stdin:
                    process.stdin.write(line)
            finally:
                self._reserve()
        return process

    def _reserve(self) -> None:
        with suppress(OSError):
            while len(self.reserved) < N_RESERVED:
                self.reserved.append(os.open(os.devnull, os.O_RDONLY))

    def _release(self) -> None:
        while self.reserved:
            os.close(self.reserved.pop())

    def _print_lines(self) -> None:
        with self._changed:
            lines, self._lines = self._lines, []
        for line in lines:
            with suppress(OSError, ValueError):  # stderr is gone
                self._warn(line)
