"""Malicious model files and thousands of mutants of sound ones, and the response of the loader.

    python benchmarks/hostile_models.py                  # all made by hand and 3,000 mutants, a minute or two
    python benchmarks/hostile_models.py --mutants 50000  # longer

The hand-made files are in `tests/hostile_models.py`. Mutants are golden models (`tests/golden`) with one of

    damage    bytes flipped, cut, doubled, exchanged, ... as in benchmarks/fuzz_recordings.py
    mended    numbers of an array changed and the archive's checksums adjusted: only the digest can tell
    signed    header or arrays changed, digest and checksums recomputed

A watched process loads each and answers some impacts with it. An audit hook in it (sys.addaudithook, PEP 578) logs
every event except the opening of the file itself: code compiled, run, imported or unpickled, other files, processes,
sockets. Its time and memory are measured. The outcomes are

    refused   with a one-line error message          same      the very model that it was made from
    another   signed anew, it answers with probabilities: a model by whoever signed it

All other outcomes are failures; so is "another" without a new signature.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib  # an error may suggest a name: loaded here, so that no watched process imports it
import io
import json
import os
import select
import signal
import struct
import sys
import tempfile
import time
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from cgid.errors import CgidError
from cgid.identification.model import Model

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.fuzz_recordings import MUTATIONS
from tests.hostile_models import CANARY, EXTREME, GOLDEN, HOSTILE, golden_files, written

#: Limits for a file: processor time [s], and memory beyond that of Python with the model's code [bytes].
TIME_LIMIT, MEMORY_LIMIT = 2.0, 256 << 20
#: Wall-clock limit of a sleeping or hanging process [s]; generous, because the machine may be busy.
_DEADLINE = 60.0
#: Number of impacts to answer.
_ROWS = 16


@dataclass(frozen=True)
class Outcome:
    """The outcome of one file."""

    name: str
    seconds: float
    #: Peak beyond the memory before [bytes].
    memory: int
    told: str

    @property
    def within_limits(self) -> bool:
        """Whether it kept to the limits of time and memory."""
        return self.seconds <= TIME_LIMIT and self.memory <= MEMORY_LIMIT


class Watched:
    """A separate process that loads files one after another; it is restarted when a file ends it.

    Examples
    --------
        with Watched() as watched:
            outcome = watched.judge(path)
    """

    def __init__(self) -> None:
        self._child = 0
        self._asking: Any = None
        self._hearing: Any = None

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def judge(self, path: Path, original: str | None = None) -> Outcome:
        """Return the outcome of a file; `original` names the golden model that it was made from."""
        if not self._child:
            self._begin()
        self._asking.write(json.dumps([str(path), original]) + "\n")
        self._asking.flush()
        ready, _, _ = select.select([self._hearing], [], [], _DEADLINE)
        told = self._hearing.readline() if ready else ""
        if told:
            return Outcome(**json.loads(told))
        status = self._end()
        return Outcome(f"crash ({status})" if ready else "hang", 0.0, 0, "")

    def _begin(self) -> None:
        ours, theirs, back, forth = *os.pipe(), *os.pipe()
        self._child = os.fork()
        if not self._child:
            os.close(theirs)
            os.close(back)
            try:
                _serve(os.fdopen(ours), os.fdopen(forth, "w"))
            finally:
                os._exit(0)
        os.close(ours)
        os.close(forth)
        self._asking, self._hearing = os.fdopen(theirs, "w"), os.fdopen(back)

    def _end(self) -> int:
        if not self._child:
            return 0
        os.kill(self._child, signal.SIGKILL)
        _, status = os.waitpid(self._child, 0)
        self._child = 0
        with contextlib.suppress(BrokenPipeError):
            self._asking.close()
        self._hearing.close()
        return os.waitstatus_to_exitcode(status)


def _serve(asked: TextIO, answers: TextIO) -> None:
    """Load the requested files and return their outcomes; an audit hook logs all events meanwhile."""
    events: list[str] = []
    loading: list[str] = []

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        # numpy parses the headers of arrays by ast.literal_eval, which builds a tree and runs nothing.
        is_literal = event == "compile" and arguments[1] == "<unknown>"
        if loading and not is_literal and not (event == "open" and arguments[0] == loading[0] and arguments[1] == "r"):
            events.append(f"{event} {arguments!r:.200}")

    sys.addaudithook(hook)
    for line in asked:
        path, name = json.loads(line)
        original = None if name is None else Model.load(GOLDEN / name)
        floor, started = _reset_peak(), time.process_time()
        loading.append(path)
        outcome, told = _outcome(path, original)
        loading.clear()
        seconds, memory = time.process_time() - started, max(_peak() - floor, 0)
        if events or Path(CANARY).exists():
            outcome, told = "event", "; ".join(events) or "a pickle was loaded"
            events.clear()
        found = {"name": outcome, "seconds": seconds, "memory": memory, "told": told[:4000]}
        answers.write(json.dumps(found) + "\n")
        answers.flush()


def _outcome(path: str, original: Model | None) -> tuple[str, str]:
    try:
        return _answered(path, original)
    except CgidError as error:
        told = str(error)
        return "refused" if told.isprintable() and len(told) < 1000 else "unsound", told
    except BaseException as error:
        return "traceback", f"{type(error).__name__}: {error}"


def _reset_peak() -> int:
    """Return the current memory of this process [bytes] and reset its peak (proc(5), clear_refs)."""
    Path("/proc/self/clear_refs").write_text("5")
    return _peak()


def _peak() -> int:
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0]) << 10


def _answered(path: str | Path, original: Model | None) -> tuple[str, str]:
    """Load a model and let it answer; return the outcome and its fault."""
    model = Model.load(path)
    random = np.random.default_rng(0)
    inputs = np.exp(random.normal(size=(_ROWS, len(model.inputs)))) * 1e3
    probabilities = model.probabilities(inputs)
    novelty = model.novelty(inputs, np.ones((_ROWS, len(model.guards))))
    model.decide(probabilities)
    sums = probabilities.sum(axis=1)
    if not (np.abs(sums - 1.0) < 1e-9).all() or (probabilities < 0).any() or np.isnan(novelty).any():
        return "unsound", f"probabilities that add up to {sums.min():g} to {sums.max():g}"
    if original is not None and model.header == original.header and _same_arrays(model, original):
        return "same", ""
    return "another", ""


def _same_arrays(model: Model, other: Model) -> bool:
    return model.arrays.keys() == other.arrays.keys() and all(
        array.dtype == other.arrays[name].dtype and np.array_equal(array, other.arrays[name])
        for name, array in model.arrays.items()
    )


# -- files made by hand -----------------------------------------------------------------------------------


def by_hand(folder: Path) -> dict[str, Outcome]:
    """Return the outcomes of the hand-made files: hostile ones must be refused, extreme ones may give answers."""
    _warm_up()
    found = {}
    with Watched() as watched:
        for name, make in (HOSTILE | EXTREME).items():
            path = folder / "hostile.npz"
            path.write_bytes(make())
            found[name] = watched.judge(path)
    return found


def failed_by_hand(found: dict[str, Outcome]) -> dict[str, Outcome]:
    """Return the outcomes that are failures."""
    return {
        name: outcome
        for name, outcome in found.items()
        if not outcome.within_limits
        or outcome.name not in (("refused",) if name in HOSTILE else ("refused", "another"))
    }


def _warm_up() -> None:
    """Load good and bad models, so that the watched processes import no module."""
    difflib.get_close_matches("peak", ["peak_force"])
    for path in golden_files():
        _answered(path, None)
    for make in (HOSTILE["no JSON"], HOSTILE["feature that does not exist"], HOSTILE["family of another world"]):
        with contextlib.suppress(CgidError):
            Model.from_bytes(make())


# -- mutants ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mutant:
    """A changed model file, and its source."""

    kind: str
    source: str
    content: bytes


#: Values that an attacker may put into the header.
_SAYINGS: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2, 64, 10**6, 2**63, -(2**31), 1e-320, 1e99, 1e308, float("nan"), float("inf"),
    "", "N", "m/s^2", "coal", "\x1b[2J", "network", "boosting", "logistic", "linear", "window_centroid",
    [], [0], [1e-9, 1e9], ["coal"], ["coal", "gangue", "stone"], ["peak_force"], ["drop_height"],
    ["window_centroid", "window_rms"], {}, {"metrics": []}, {"metrics": {"confusion": [[1, 2], [3, 4]]}},
    {"metrics": {"confusion": [[0, 0], [0, 0]]}},
)  # fmt: skip
#: Values that an attacker may put into an array.
_NUMBERS = (0.0, -1.0, 1.0, 2.0, 1e-300, -1e99, 1e99, 1e300, np.nan, np.inf, 2.0**31 - 1, -(2.0**31), 1e6)


def _damaged(content: bytes, model: Model, random: np.random.Generator, others: list[bytes]) -> bytes:
    mutation = MUTATIONS[int(random.integers(len(MUTATIONS)))]
    return bytes(mutation(bytearray(content), random, others))


def _mended(content: bytes, model: Model, random: np.random.Generator, others: list[bytes]) -> bytes:
    """Change a bit of an array or of the header, and adjust the archive's checksums."""
    with zipfile.ZipFile(io.BytesIO(content)) as stored:
        entry = stored.infolist()[int(random.integers(len(stored.infolist())))]
    start = entry.header_offset + 30 + len(entry.filename) + 20
    changed = bytearray(content)
    changed[start + int(random.integers(128, entry.file_size))] ^= 1 << int(random.integers(8))
    checksum = struct.pack("<L", zlib.crc32(changed[start : start + entry.file_size]))
    changed[entry.header_offset + 14 : entry.header_offset + 18] = checksum
    named = changed.rindex(b"PK\x01\x02", 0, changed.rindex(entry.filename.encode()))
    changed[named + 16 : named + 20] = checksum
    return bytes(changed)


def _signed(content: bytes, model: Model, random: np.random.Generator, others: list[bytes]) -> bytes:
    """Make one or two changes to header and arrays as an attacker would, with all checksums recomputed."""
    header, arrays = dict(model.header), dict(model.arrays)
    for _ in range(int(random.integers(1, 3))):
        if random.random() < 0.4:
            name = str(random.choice(sorted(header)))
            header[name] = _SAYINGS[int(random.integers(len(_SAYINGS)))]
        else:
            name = str(random.choice(sorted(arrays)))
            arrays[name] = _changed_array(arrays[name], random)
    return written(header, arrays)


def _changed_array(array: np.ndarray, random: np.random.Generator) -> np.ndarray:
    changes: tuple[Callable[[], np.ndarray], ...] = (
        lambda: _set(array, random),
        lambda: _set(array, random),
        lambda: array[:-1],
        lambda: array.ravel(),
        lambda: np.concatenate([array, array]),
        lambda: array[::-1].copy(),
        lambda: random.permutation(array),
        lambda: array.astype(str(random.choice(["f4", "f8", "i4", "i8", "u4", "?", ">f8", "S3", "c16"]))),
        lambda: np.asfortranarray(array),
    )
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return changes[int(random.integers(len(changes)))]()


def _set(array: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Set one number, or all of them."""
    value, new = _NUMBERS[int(random.integers(len(_NUMBERS)))], array.copy()
    where = slice(None) if random.random() < 0.2 else int(random.integers(array.size))
    new.reshape(-1)[where] = np.array(value).astype(array.dtype)
    return new


MUTANTS: dict[str, Callable[[bytes, Model, np.random.Generator, list[bytes]], bytes]] = {
    "damage": _damaged,
    "mended": _mended,
    "signed": _signed,
}


def mutants(n_mutants: int, seed: int, folder: Path) -> list[tuple[Mutant, Outcome]]:
    """Return mutants of the golden models, with their outcomes."""
    _warm_up()
    contents = {path.name: path.read_bytes() for path in golden_files()}
    models = {name: Model.from_bytes(content) for name, content in contents.items()}
    names, everything, found = list(contents), list(contents.values()), []
    with Watched() as watched:
        for number in range(n_mutants):
            random = np.random.default_rng([seed, number])
            kind = list(MUTANTS)[number % len(MUTANTS)]
            # Only models of this schema have a digest that detects mended files.
            possible = [name for name in names if name.startswith("models-4")] if kind == "mended" else names
            source = possible[int(random.integers(len(possible)))]
            mutant = Mutant(kind, source, MUTANTS[kind](contents[source], models[source], random, everything))
            path = folder / "mutant.npz"
            path.write_bytes(mutant.content)
            found.append((mutant, watched.judge(path, source)))
    return found


def failed_mutants(found: list[tuple[Mutant, Outcome]]) -> list[tuple[Mutant, Outcome]]:
    """Return those that did harm, or whose change was not noticed."""
    allowed = {"damage": ("refused", "same"), "mended": ("refused", "same"), "signed": ("refused", "same", "another")}
    return [
        (mutant, outcome)
        for mutant, outcome in found
        if outcome.name not in allowed[mutant.kind] or not outcome.within_limits
    ]


def main() -> None:
    """Print the outcomes of each kind, and every failure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="print what is said of each file made by hand")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        crafted = by_hand(Path(folder))
        changed = mutants(arguments.mutants, arguments.seed, Path(folder))
    if arguments.list:
        for name, outcome in crafted.items():
            print(f"{name}: {outcome.name}, {outcome.seconds:.2f} s, {outcome.memory / 1e6:.0f} MB: {outcome.told}")
    rows = {"made by hand": list(crafted.values())}
    rows |= {kind: [outcome for mutant, outcome in changed if mutant.kind == kind] for kind in MUTANTS}
    print(
        "| files | number | refused | same | another | slowest [s] | most memory [MB] |\n|---|---|---|---|---|---|---|"
    )
    for kind, outcomes in rows.items():
        tally = Counter(outcome.name for outcome in outcomes)
        counts = " | ".join(str(tally[name]) for name in ("refused", "same", "another"))
        slowest = max((outcome.seconds for outcome in outcomes), default=0.0)
        memory = max((outcome.memory for outcome in outcomes), default=0) / 1e6
        print(f"| {kind} | {len(outcomes)} | {counts} | {slowest:.2f} | {memory:.0f} |")
    bad = list(failed_by_hand(crafted).items())
    bad += [(f"{mutant.kind} of {mutant.source}", outcome) for mutant, outcome in failed_mutants(changed)]
    print(f"\n{len(crafted) + len(changed)} files, {len(bad)} failed")
    for name, outcome in bad[:20]:
        print(f"{name}: {outcome.name}, {outcome.seconds:.2f} s, {outcome.memory / 1e6:.0f} MB: {outcome.told}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
