"""Runs cgid's command line in forked copies of this process, each with its own faults, up to the interpreter's exit.

Starting Python and importing libraries takes seconds, a command milliseconds, so this process imports once.
`benchmarks/safety/faults.py` starts it and defines the requests: one line of JSON on stdin per command, one on stdout
when it has ended. A copy ends as an ordinary process does, so that crashes at exit are seen.
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
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

#: Time limit of a command [s].
_LONGEST = 60
#: Computed once, since it takes minutes and does not depend on where it is written; the disk comes afterwards.
_TRAINING = "cgid.identification.training.training"
_COMPUTED = ((_TRAINING, "train_on_specimens"), (_TRAINING, "train_on_groups"))


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
    os.setpgid(0, 0)
    faulthandler.dump_traceback_later(_LONGEST, exit=True)
    for descriptor, name in ((1, asked["out"]), (2, asked["err"])):
        opened = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    if asked.get("size"):
        # Beyond this size the kernel itself fails a write with EFBIG.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (asked["size"], asked["size"]))
    if "below" in asked:
        faults = ctypes.CDLL(None)
        first, number, lasting, sent = (asked.get(name, 0) for name in ("first", "errno", "lasting", "signal"))
        faults.failing_calls_arm(asked["below"].encode(), ctypes.c_long(first), number, lasting, sent)


def _wait(child: int, asked: dict[str, Any]) -> dict[str, Any]:
    # A hanging copy is dumped by its own faulthandler and ends as a failure.
    code, calls = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), 0
    if "below" in asked:
        count = ctypes.CDLL(None).failing_calls_count
        count.restype = ctypes.c_long
        calls = count()
    return {"code": code, "calls": calls}


def main() -> None:
    from cgid.cli.main import run

    answers = os.dup(1)
    _compute_once()
    for line in sys.stdin:
        asked = json.loads(line)
        if asked.get("here"):  # imports the command's libraries and keeps its results
            with Path(asked["err"]).open("w") as err, redirect_stdout(io.StringIO()), redirect_stderr(err):
                answer: dict[str, Any] = {"code": run(asked["arguments"]), "calls": 0}
        else:
            gc.freeze()  # otherwise every copy scans all shared objects at exit, which takes seconds
            child = os.fork()
            if not child:
                _prepare(asked)
                sys.exit(run(asked["arguments"]))
            answer = _wait(child, asked)
        os.write(answers, (json.dumps(answer) + "\n").encode())


if __name__ == "__main__":
    main()
