"""Hostile HDF5 files: what they do to the process that reads them.

    python benchmarks/hostile.py [--mutants 3000] [--seed 0]

Files made by hand (`tests/hostile_hdf5.py`), and mutants with valid checksums (`tests/hdf5_mutants.py`), of each kind
that cgid reads. Each is read in a forked process. It must be read or refused in one line; no other file may be opened.
A crafted file may end the process or hang it: `SECURITY.md` says so, and this counts how often.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
import signal
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cgid.errors import CgidError
from tests.hdf5_mutants import mutant, pieces
from tests.hostile_hdf5 import KINDS, Outside, hostile_files

#: Processor time [s] and memory in addition [bytes] for one file.
TIME_LIMIT, MEMORY_LIMIT = 4, 512 << 20
#: By exit code.
OUTCOMES = ("read", "refused", "two lines", "traceback", "memory", "crash", "hang")
#: Allowed outcomes.
SOUND = ("read", "refused")
_IN_ACCESS, _IN_OPEN = 0x1, 0x20


def judge(kind: str, path: Path) -> str:
    """Return the outcome of reading a file in a forked process."""
    process = os.fork()
    if not process:
        os._exit(_read(kind, path))
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return "hang"
    return OUTCOMES[code] if code >= 0 else "crash"


def _read(kind: str, path: Path) -> int:
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime) + TIME_LIMIT
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    pages = int(Path("/proc/self/statm").read_bytes().split()[5])
    resource.setrlimit(resource.RLIMIT_DATA, (pages * resource.getpagesize() + MEMORY_LIMIT,) * 2)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        KINDS[kind].read(path)
    except CgidError as error:
        return OUTCOMES.index("two lines" if "\n" in str(error) else "refused")
    except MemoryError:
        return OUTCOMES.index("memory")
    except Exception:
        return OUTCOMES.index("traceback")
    return OUTCOMES.index("read")


class Watch:
    """Watches whether the files of a folder are opened."""

    def __init__(self, folder: Path) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._number = self._libc.inotify_init1(os.O_NONBLOCK)
        if self._libc.inotify_add_watch(self._number, os.fsencode(folder), _IN_OPEN | _IN_ACCESS) < 0:
            raise OSError(ctypes.get_errno(), "inotify cannot watch", str(folder))

    def opened(self) -> list[str]:
        """Return the names of the files opened or read since the last call."""
        try:
            content = os.read(self._number, 1 << 20)
        except BlockingIOError:
            return []
        found, place = [], 0
        while place < len(content):
            (length,) = struct.unpack_from("<12xI", content, place)
            found.append(content[place + 16 : place + 16 + length].rstrip(b"\0").decode())
            place += 16 + length
        return found


def mutants(n_files: int, seed: int, folder: Path) -> Iterator[tuple[str, str, Path]]:
    """Iterate over kind, number and path of mutants; all use the same path."""
    sound = {}
    for name in KINDS if n_files else ():
        content = (folder / f"{name}.h5").read_bytes()
        sound[name] = content, pieces(content)
    path = folder / "mutant.h5"

    def made() -> Iterator[tuple[str, str, Path]]:
        for number in range(n_files):
            name = tuple(KINDS)[number % len(KINDS)]
            path.write_bytes(mutant(*sound[name], np.random.default_rng([seed, number])))
            yield name, f"mutant {number}", path

    return made()


def run(folder: Path, n_mutants: int, seed: int) -> tuple[list[tuple[str, str, str]], list[str]]:
    """Return kind, name and outcome of each file, and the outside files that were opened."""
    outside = Outside.make(folder / "outside")
    files = hostile_files(folder, outside)
    changed = mutants(n_mutants, seed, folder)
    for name, kind in KINDS.items():
        kind.read(folder / f"{name}.h5")  # loads what reading needs
    watch = Watch(outside.folder)
    found = [(kind, name, judge(kind, path)) for source in (files, changed) for kind, name, path in source]
    return found, watch.opened()


def main() -> None:
    """Print the outcomes of each kind, and the files with others than the allowed ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        found, opened = run(Path(folder), arguments.mutants, arguments.seed)
    print(f"| kind | files | mutants | {' | '.join(OUTCOMES)} |\n|" + "---|" * (len(OUTCOMES) + 3))
    for kind in KINDS:
        rows = [(name, outcome) for one, name, outcome in found if one == kind]
        n_mutants = sum(name.startswith("mutant") for name, _ in rows)
        tally = Counter(outcome for _, outcome in rows)
        print(f"| {kind} | {len(rows) - n_mutants} | {n_mutants} | {' | '.join(str(tally[o]) for o in OUTCOMES)} |")
    print(f"\n{len(found)} files in {time.perf_counter() - started:.0f} s; files outside opened: {len(opened)}")
    for kind, name, outcome in found:
        if outcome not in SOUND:
            print(f"{kind}, {name}: {outcome}")
    sys.exit(bool(opened) or any(outcome in ("two lines", "traceback") for *_, outcome in found))


if __name__ == "__main__":
    main()
