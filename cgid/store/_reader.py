"""The process that reads HDF5 files for another, which asks by its standard input; see `apart`.

It knows a few functions and nothing else, has limits of time and memory, and ends when nobody can ask any more.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from inspect import isgenerator
from typing import Any

import numpy as np

from cgid.errors import CgidError
from cgid.store import examining, foreign_reading, limits, own_reading, wire

#: What can be asked. Each is given the path, its name in messages, and what else it needs; it returns what JSON can
#: hold or a dict of arrays, or yields such dicts.
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "examine": examining.examine,
    "foreign_blocks": foreign_reading.foreign_blocks,
    "foreign_names": foreign_reading.foreign_names,
    "foreign_survey": foreign_reading.foreign_survey,
    "foreign_texts": foreign_reading.foreign_texts,
    "format_said": own_reading.format_said,
    "recording_header": own_reading.recording_header,
    "shard_header": own_reading.shard_header,
    "table_header": own_reading.table_header,
    "rows": own_reading.rows,
}


def _main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries may print; the answers have a way of their own.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    wire.send(answers, {})
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    limits.settle()
    requests = sys.stdin.buffer
    for line in requests:
        request = json.loads(line)
        if "function" in request:
            _serve(request["function"], request["arguments"], requests, answers)


def _serve(function: str, arguments: list[Any], requests: Any, answers: Any) -> None:
    for number, (message, arrays) in enumerate(_replies(function, arguments)):
        limits.rest()
        # The next item is ready before it is asked for.
        if number and not json.loads(requests.readline() or "{}").get("next"):
            wire.send(answers, {"end": True})
            return
        try:
            wire.send(answers, message, arrays)
        except wire.BrokenWire as error:
            text = f"{arguments[1]}: says more of itself than a file may ({error}); copy it again, or leave it out"
            wire.send(answers, {"error": "BadData", "text": text})
            return


def _replies(function: str, arguments: list[Any]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    path, source = arguments[:2]
    try:
        limits.begin(path)
        found = FUNCTIONS[function](*arguments)
        if not isgenerator(found):
            yield _reply(found)
            return
        for item in found:
            yield _reply(item)
            limits.begin(path)
        yield {"end": True}, {}
    except CgidError as error:
        yield {"error": type(error).__name__, "text": str(error)}, {}
    except MemoryError:
        cure = "it is damaged or hostile: copy it again, or leave it out"
        yield {"error": "BadData", "text": f"{source}: reading this file takes more memory than it may; {cure}"}, {}
    except Exception as error:  # whatever h5py makes of a file, it is one line
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        yield {"error": "BadData", "text": f"{source}: is damaged ({reason}); copy it again, or generate it anew"}, {}


def _reply(found: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    if isinstance(found, dict) and found and all(isinstance(value, np.ndarray) for value in found.values()):
        return {}, found
    return {"value": found}, {}


if __name__ == "__main__":
    _main()
