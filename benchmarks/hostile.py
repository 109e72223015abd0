"""Hostile HDF5 files and thousands of mutants, and the response of the readers.

    python benchmarks/hostile.py                   # all hand-made files and 5,000 mutants, a quarter of an hour
    python benchmarks/hostile.py --mutants 100     # a minute

Each file (`tests/hostile_hdf5.py`) is read to its end as a dataset, a recording, a table or a foreign recording. The
checksums of mutants are recomputed (`tests/hdf5_mutants.py`), so that HDF5 accepts the changes. The checks are

    answers     arrays or a one-line error message; never another exception, never a crash of this process
    processor   time of both processes for a file [s]
    memory      of both processes, beyond their memory before [MB]
    outside     whether the targets of links and external storage were opened (inotify)
    code        whether anything forbidden was run, loaded or opened (audit hooks in both processes)
"""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cgid.errors import CgidError
from cgid.store import sandbox

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.hdf5_mutants import mutant, pieces
from tests.hostile_hdf5 import KINDS, Outside, hostile_files

#: Limits for a file: processor time [s] and memory [bytes], both processes together.
TIME_LIMIT, MEMORY_LIMIT = 2.0, 256 << 20
_IN_ACCESS, _IN_OPEN = 0x1, 0x20
#: Audit events that run or load code, or act outside the process.
_FORBIDDEN = (
    "exec", "compile", "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pickle.find_class",
    "marshal.loads", "marshal.load", "ctypes.dlopen", "socket.__new__", "socket.connect",
)  # fmt: skip
#: The hook in a reading process. After the first resource limit is set, it logs every action other than reading.
_HOOK = f"""
import encodings.ascii, encodings.utf_16, os, sys
_armed = False
def _hook(event, arguments):
    global _armed
    if event == "resource.setrlimit":
        _armed = True
    elif _armed and (event in {_FORBIDDEN!r} or (event == "open" and not str(arguments[0]).startswith("/proc/self/"))):
        os.write(_log, (event + " " + repr(arguments)[:200] + "\\n").encode())
if "CGID_AUDIT" in os.environ:
    _log = os.open(os.environ["CGID_AUDIT"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    sys.addaudithook(_hook)
"""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one file."""

    name: str
    told: str
    processor: float
    memory: int

    @property
    def failed(self) -> bool:
        """Whether it is no answer, or exceeded a limit."""
        return self.name not in ("read", "refused") or self.processor > TIME_LIMIT or self.memory > MEMORY_LIMIT


def judge(kind: str, path: Path) -> Outcome:
    """Return the outcome of a file."""
    floor, started = _memory(reset=True), _processor()
    try:
        arrays = KINDS[kind].read(path)
        name, told = "read", f"{sum(array.nbytes for array in arrays)} bytes"
    except CgidError as error:
        name, told = ("refused" if "\n" not in str(error) else "two lines"), str(error)
    except Exception as error:
        name, told = "traceback", f"{type(error).__name__}: {error}"
    return Outcome(name, told, _processor() - started, _memory() - floor)


def _readers() -> list[int]:
    return [child.process.pid for child in sandbox._alive]


def _memory(reset: bool = False) -> int:
    """Return the sum of the peak memories of this process and its readers since the last reset [bytes]."""
    total = 0
    for pid in ("self", *_readers()):
        try:
            if reset:
                Path(f"/proc/{pid}/clear_refs").write_text("5")
            status = Path(f"/proc/{pid}/status").read_text()
        except OSError:
            continue
        if "VmHWM:" in status:
            total += int(status.partition("VmHWM:")[2].split()[0]) << 10
    return total


def _processor() -> float:
    """Return the processor time of this process, its readers and its ended readers [s]."""
    own, ended = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    total = own.ru_utime + own.ru_stime + ended.ru_utime + ended.ru_stime
    for pid in _readers():
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


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


@contextmanager
def audited(folder: Path) -> Iterator[list[str]]:
    """Yield a list that holds, at the end, the code that both processes have run or loaded besides reading."""
    hook, log, events = folder / "hook", folder / "log", []
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(_HOOK)
    armed = True

    def note(event: str, arguments: object) -> None:
        # This process may start a reader.
        if (
            armed
            and event in _FORBIDDEN
            and not (event == "subprocess.Popen" and "cgid.store._reader" in repr(arguments))
        ):
            events.append(f"{event} {arguments!r}"[:200])

    sandbox._end_all()
    os.environ["CGID_AUDIT"] = str(log)
    sys.path.insert(0, str(hook))
    sys.addaudithook(note)
    try:
        yield events
    finally:
        armed = False
        sys.path.remove(str(hook))
        del os.environ["CGID_AUDIT"]
        sandbox._end_all()
        events += log.read_text().splitlines() if log.exists() else []


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


def run(folder: Path, n_mutants: int, seed: int) -> tuple[list[tuple[str, str, Outcome]], list[str], list[str]]:
    """Return the outcome of each file, the opened outside files, and the code that was run."""
    outside = Outside.make(folder / "outside")
    files = hostile_files(folder, outside)
    changed = mutants(n_mutants, seed, folder)
    found = []
    # Trigger the lazy imports now.
    for name, kind in KINDS.items():
        kind.read(folder / f"{name}.h5")
    watch = Watch(outside.folder)
    with audited(folder) as code:
        for source in (files, changed):
            for kind, attack, path in source:
                found.append((kind, attack, judge(kind, path)))
    return found, watch.opened(), code


def main() -> None:
    """Print the outcomes of each kind, and every failure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        found, opened, code = run(Path(folder), arguments.mutants, arguments.seed)
    print(
        "| kind | files | mutants | refused | read | failed | processor, most [s] | memory, most [MB] |\n|" + "---|" * 8
    )
    for kind in KINDS:
        rows = [(attack, outcome) for name, attack, outcome in found if name == kind]
        tally = Counter(outcome.name for _, outcome in rows)
        n_mutants = sum(attack.startswith("mutant") for attack, _ in rows)
        failed = sum(outcome.failed for _, outcome in rows)
        processor, memory = (max(getattr(outcome, what) for _, outcome in rows) for what in ("processor", "memory"))
        print(
            f"| {kind} | {len(rows) - n_mutants} | {n_mutants} | {tally['refused']} | {tally['read']} | {failed} | "
            f"{processor:.2f} | {memory / 1e6:.0f} |"
        )
    bad = [row for row in found if row[2].failed]
    ended = sum("the HDF5 library" in outcome.told for _, _, outcome in found)
    print(
        f"\n{len(found)} files in {time.perf_counter() - started:.0f} s: {len(bad)} failed, {ended} times HDF5 broke "
        f"down in its own process; files outside opened: {len(opened)}; code run: {len(code)}"
    )
    for kind, attack, outcome in bad[:20]:
        print(
            f"{kind}, {attack}: {outcome.name}, {outcome.processor:.1f} s, {outcome.memory / 1e6:.0f} MB: "
            f"{outcome.told[:300]}"
        )
    for line in (*opened[:10], *code[:10]):
        print(line)
    sys.exit(bool(bad or opened or code))


if __name__ == "__main__":
    main()
