"""Thousands of damaged recordings, and the response of the readers.

    python benchmarks/safety/fuzz_recordings.py                  # 2,000 files over all formats, some minutes
    python benchmarks/safety/fuzz_recordings.py --files 100000   # longer
    python benchmarks/safety/fuzz_recordings.py --files 2100 --only cut   # cut off only, 100 of each format
    python benchmarks/safety/fuzz_recordings.py --files 3000 --formats HDF5

A file of every format (`tests/recording_files.py`) is changed: bits flipped; bytes set to extremes; the end cut off;
stretches removed, doubled, exchanged or overwritten by those of another format; numbers in the header replaced by huge
ones. Each is read to its end in a separate process with limits on time and memory. The outcomes are

    refused   with a one-line error message          warned    part of the data, and a warning
    same      everything is unchanged                values    as many numbers, some of other values
    facts     another rate, unit, name or start      changed   more or fewer numbers, without a message

Without a checksum nobody can know that a number of the file has another value, be it a sample or a rate; a format with
a checksum must never have "values" or "facts". One that states its length must never be "changed", unless it is that
number itself which is damaged (FLAC; the channels of AU); text has no length, so one cut at the end of a line looks
like a shorter one.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import CgidError
from cgid.recordings import open_recording

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.recording_files import SPECIMENS, Specimen, blows

#: Limits for a file: time [s], and memory beyond that of Python with all libraries [bytes].
TIME_LIMIT, MEMORY_LIMIT = 5.0, 512 << 20
RATE = 51_200.0
#: Meaning of a child's exit codes; any other is a crash.
OUTCOMES = ("same", "refused", "warned", "values", "facts", "changed", "traceback")
#: Those that are no failure.
ANSWERS = OUTCOMES[:6]


@dataclass(frozen=True)
class Outcome:
    """The outcome of one file."""

    name: str
    seconds: float
    memory: int
    #: Memory of this process at the fork [bytes].
    floor: int
    told: str

    @property
    def failed(self) -> bool:
        """Whether it is no answer, or took too much memory."""
        return self.name not in ANSWERS or self.memory - self.floor > MEMORY_LIMIT


@dataclass(frozen=True)
class Read:
    """What was read of a file: samples (n_channels, n_samples), warnings, and what else is known of them."""

    samples: np.ndarray
    warnings: tuple[str, ...]
    facts: tuple[Any, ...]


def read(path: Path, options: dict[str, Any]) -> Read:
    """Return the whole recording, read as the commands do."""
    recording = open_recording(path, **options)
    blocks = list(recording.blocks_with_gaps())
    facts = recording.sampling_rate, recording.channels, recording.start_time
    return Read(np.concatenate(blocks, axis=1), recording.warnings, facts)


def judge(path: Path, specimen: Specimen, expected: Read) -> Outcome:
    reading, writing = os.pipe()
    floor = _resident()
    started = time.perf_counter()
    child = os.fork()
    if not child:
        os.close(reading)
        os._exit(_read_and_tell(path, specimen, expected, writing))
    os.close(writing)
    status, usage = _await(child, started + TIME_LIMIT)
    seconds = time.perf_counter() - started
    with os.fdopen(reading, "rb") as pipe:
        told = pipe.read().decode(errors="replace")
    if status is None:
        return Outcome("hang", seconds, usage, floor, told)
    code = os.waitstatus_to_exitcode(status)
    name = OUTCOMES[code] if 0 <= code < len(OUTCOMES) else f"crash ({code})"
    return Outcome(name, seconds, usage, floor, told)


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _await(child: int, deadline: float) -> tuple[int | None, int]:
    while time.perf_counter() < deadline:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            return status, usage.ru_maxrss << 10
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    _, _, usage = os.wait4(child, 0)
    return None, usage.ru_maxrss << 10


def _read_and_tell(path: Path, specimen: Specimen, expected: Read, pipe: int) -> int:
    warnings.simplefilter("ignore")
    # Hides what libraries print to the terminal.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        found = read(path, specimen.options)
        if found.warnings:
            os.write(pipe, found.warnings[0].encode())
            return OUTCOMES.index("warned")
        if found.samples.shape != expected.samples.shape:
            return OUTCOMES.index("changed")
        if found.facts != expected.facts:
            os.write(pipe, f"{expected.facts} became {found.facts}".encode())
            return OUTCOMES.index("facts")
        return OUTCOMES.index("same" if np.array_equal(found.samples, expected.samples, equal_nan=True) else "values")
    except CgidError as error:
        os.write(pipe, str(error).encode()[:4000])
        return OUTCOMES.index("refused" if "\n" not in str(error) else "traceback")
    except BaseException as error:
        os.write(pipe, f"{type(error).__name__}: {error}".encode()[:4000])
        return OUTCOMES.index("traceback")


# -- mutations ----------------------------------------------------------------------------------------


def _place(random: np.random.Generator, size: int) -> int:
    return int(random.integers(min(size, 1024) if random.random() < 0.5 else size))


def _flip(content: bytearray, random: np.random.Generator, others: list[bytes]) -> bytearray:
    for _ in range(int(random.integers(1, 4))):
        content[_place(random, len(content))] ^= 1 << int(random.integers(8))
    return content


def _extreme(content: bytearray, random: np.random.Generator, others: list[bytes]) -> bytearray:
    width, place = int(random.choice([1, 2, 4, 8])), _place(random, len(content))
    values = (0, 1, (1 << 8 * width - 1) - 1, 1 << 8 * width - 1, (1 << 8 * width) - 1)
    content[place : place + width] = values[int(random.integers(len(values)))].to_bytes(width, "little")
    return content


def _cut(content: bytearray, random: np.random.Generator, others: list[bytes]) -> bytearray:
    return content[: _place(random, len(content))]


def _cut_out(content: bytearray, random: np.random.Generator, others: list[bytes]) -> bytearray:
    first = _place(random, len(content))
    del content[first : first + int(2 ** random.uniform(0, 14))]
    return content


def _doubled(content: bytearray, random: np.random.Generator, others: list[bytes]) -> bytearray:
    first, length = _place(random, len(content)), int(2 ** random.uniform(0, 14))
    return content[: first + length] + content[first:]


def _spliced(content: bytearray, random: np.random.Generator, others: list[bytes]) -> bytearray:
    other = others[int(random.integers(len(others)))]
    first, place, length = _place(random, len(content)), _place(random, len(other)), int(2 ** random.uniform(0, 12))
    content[first : first + length] = other[place : place + length]
    return content


def _noise(content: bytearray, random: np.random.Generator, others: list[bytes]) -> bytearray:
    first, length = _place(random, len(content)), int(2 ** random.uniform(0, 10))
    content[first : first + length] = random.bytes(length)
    return content


def _digits(content: bytearray, random: np.random.Generator, others: list[bytes]) -> bytearray:
    places = [k for k, byte in enumerate(content[:4096]) if 48 <= byte <= 57]
    if places:
        first = int(random.choice(places))
        numbers = (b"999999999999", b"-1", b"1e308", b"nan", b"0", b",", b"")
        content[first : first + 1] = numbers[int(random.integers(len(numbers)))]
    return content


MUTATIONS: tuple[Callable[[bytearray, np.random.Generator, list[bytes]], bytearray], ...] = (
    _flip,
    _extreme,
    _cut,
    _cut_out,
    _doubled,
    _spliced,
    _noise,
    _digits,
)


def fuzz(
    n_files: int,
    seed: int,
    folder: Path,
    *,
    n_samples: int = 4000,
    formats: Sequence[str] = (),
    mutations: Sequence[str] = (),
) -> dict[str, list[tuple[str, Outcome, bytes]]]:
    """Return, for each format, mutation, outcome and content of every damaged file; by default of all of them."""
    specimens = [one for one in SPECIMENS if one.is_possible and (not formats or one.name in formats)]
    chosen = [one for one in MUTATIONS if not mutations or one.__name__.strip("_") in mutations]
    originals: dict[str, bytes] = {}
    expected: dict[str, Read] = {}
    for specimen in specimens:
        path = folder / f"original{specimen.suffix}"
        path.unlink(missing_ok=True)
        specimen.write(path, blows(n_samples), RATE)
        originals[specimen.name] = path.read_bytes()
        expected[specimen.name] = read(path, specimen.options)
    everything = list(originals.values())
    found: dict[str, list[tuple[str, Outcome, bytes]]] = {specimen.name: [] for specimen in specimens}
    for number in range(n_files):
        specimen = specimens[number % len(specimens)]
        random = np.random.default_rng([seed, number])
        mutation = chosen[int(random.integers(len(chosen)))]
        content = bytes(mutation(bytearray(originals[specimen.name]), random, everything))
        path = folder / f"damaged{specimen.suffix}"
        path.write_bytes(content)
        outcome = judge(path, specimen, expected[specimen.name])
        found[specimen.name].append((mutation.__name__.strip("_"), outcome, content))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the files that were not refused as they should")
    parser.add_argument("--formats", nargs="+", default=(), help="only these, as in the table")
    names = [one.__name__.strip("_") for one in MUTATIONS]
    parser.add_argument("--only", nargs="+", default=(), choices=names, help="only these kinds of damage")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = fuzz(arguments.files, arguments.seed, Path(folder), formats=arguments.formats, mutations=arguments.only)
    titles = (*ANSWERS, "failed", "slowest [s]", "most memory [MB]")
    print(f"| format | files | {' | '.join(titles)} |\n|{'---|' * (len(titles) + 2)}")
    bad: list[tuple[str, str, Outcome, bytes]] = []
    for name, rows in found.items():
        tally = Counter(outcome.name for _, outcome, _ in rows)
        failed = [(name, *row) for row in rows if row[1].failed or row[1].memory > MEMORY_LIMIT]
        bad += failed
        slowest = max(outcome.seconds for _, outcome, _ in rows)
        memory = max(outcome.memory for _, outcome, _ in rows) / 1e6
        counts = [tally[outcome] for outcome in ANSWERS]
        print(
            f"| {name} | {len(rows)} | {' | '.join(map(str, counts))} | {len(failed)} | {slowest:.2f} | {memory:.0f} |"
        )
    n_files = sum(map(len, found.values()))
    print(f"\n{n_files} files, {len(bad)} failed; Python with all libraries takes {_resident() / 1e6:.0f} MB")
    for name, mutation, outcome, _ in bad[:20]:
        print(f"{name}, {mutation}: {outcome.name} after {outcome.seconds:.1f} s: {outcome.told}")
    if arguments.keep:
        _keep(arguments.keep, found)
    sys.exit(bool(bad))


def _keep(folder: Path, found: dict[str, list[tuple[str, Outcome, bytes]]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    suffixes = {specimen.name: specimen.suffix for specimen in SPECIMENS}
    for name, rows in found.items():
        for number, (mutation, outcome, content) in enumerate(rows):
            if outcome.name not in ("refused", "warned", "same"):
                label = f"{name}-{number}-{mutation}-{outcome.name}".replace(" ", "_").replace(",", "")
                (folder / f"{label}{suffixes[name]}").write_bytes(content)


if __name__ == "__main__":
    main()
