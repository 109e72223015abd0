"""Runs cgid's command line in forked copies of itself, each with its own faults, each to its interpreter's end.

Starting Python and loading libraries takes seconds, a command milliseconds: so this process does the first once. Run by
`benchmarks/faults.py`, which says what is asked for: a line of JSON on stdin for each command, one back on stdout when
it has ended. A copy ends as a process of its own does, so that what crashes at exit is seen.
"""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import io
import json
import os
import resource
import signal
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

#: A command that takes longer hangs [s].
_LONGEST = 60
#: What does not depend on where it is written is computed once: it takes minutes, and the disk comes after it.
_COMPUTED = (
    ("cgid.reproduction.output", "_contents"),
    ("cgid.ceiling.survey", "survey"),
    ("cgid.identification.training", "train"),
)


def _compute_once() -> None:
    import importlib

    for module, name in _COMPUTED:
        loaded = importlib.import_module(module)
        setattr(loaded, name, _kept(getattr(loaded, name)))


def _kept(function: Any) -> Any:
    found: list[Any] = []

    def first_time(*arguments: Any, **options: Any) -> Any:
        if not found:
            found.append(function(*arguments, **options))
        return found[0]

    return first_time


def _prepare(asked: dict[str, Any]) -> None:
    """Make this process what was asked for: its streams, place, user, limits and faults."""
    os.setpgid(0, 0)
    faulthandler.dump_traceback_later(_LONGEST, exit=True)
    for descriptor, name in ((1, asked["out"]), (2, asked["err"])):
        opened = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for name, value in asked.get("environment", {}).items():
        os.environ.pop(name, None)
        if value is not None:
            os.environ[name] = value
    if asked.get("folder"):
        os.chdir(asked["folder"])
    if asked.get("gone"):
        Path.cwd().rmdir()
    if asked.get("size"):
        # Beyond this size a write fails with EFBIG: the kernel's own doing.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (asked["size"], asked["size"]))
    if asked.get("user"):
        os.setgid(asked["user"])
        os.setuid(asked["user"])
    if "below" in asked:
        faults = ctypes.CDLL(None)
        first, number, lasting, sent = (asked.get(name, 0) for name in ("first", "errno", "lasting", "signal"))
        faults.failing_calls_arm(asked["below"].encode(), ctypes.c_long(first), number, lasting, sent)


def _wait(children: list[int], asked: dict[str, Any]) -> dict[str, Any]:
    """Return how the copies ended, how many calls they made below their folder, and how long they took [s]."""
    began = time.perf_counter()
    if asked.get("interrupt_after") is not None:
        time.sleep(asked["interrupt_after"])
        os.kill(children[0], signal.SIGINT)
    # Whatever hangs is dumped by its own faulthandler, and ends as a failure.
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    calls = 0
    if "below" in asked:
        count = ctypes.CDLL(None).failing_calls_count
        count.restype = ctypes.c_long
        calls = count()
    return {"codes": codes, "calls": calls, "seconds": time.perf_counter() - began}


def main() -> None:
    """Answer requests until stdin ends; in a copy, run the command."""
    from cgid.cli.main import main as command_line
    from cgid.cli.main import run

    answers = os.dup(1)
    _compute_once()
    for line in sys.stdin:
        asked = json.loads(line)
        if asked.get("here"):  # loads what the command needs, and keeps what it computes
            with Path(asked["err"]).open("w") as err, redirect_stdout(io.StringIO()), redirect_stderr(err):
                answer: dict[str, Any] = {"codes": [run(asked["arguments"])], "calls": 0, "seconds": 0.0}
        else:
            gc.freeze()  # else every copy looks through all that it shares when it ends, which takes seconds
            children = []
            for _ in range(asked.get("copies", 1)):
                child = os.fork()
                if not child:
                    _prepare(asked)
                    command_line(asked["arguments"])
                children.append(child)
            answer = _wait(children, asked)
        os.write(answers, (json.dumps(answer) + "\n").encode())


if __name__ == "__main__":
    main()
