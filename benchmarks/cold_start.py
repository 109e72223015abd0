"""Concurrent start of processes with an empty kernel cache, and with damaged or impossible caches: 0 failures expected.

    python benchmarks/cold_start.py                          # 20 rounds of four processes, then every fault
    python benchmarks/cold_start.py --rounds 2 --kernels checksum          # the same in seconds
    python benchmarks/cold_start.py --rounds 2 --kernels beam              # with the largest kernels, minutes a round

The processes wait until all have started, then compile (or read) and run the same kernels. A process fails if its exit
code is not 0, if it prints anything, or if its result differs by a bit from that of a process without cache. After
every round, and after every fault that leaves a cache, a last process must find all kernels there and compile none.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
_SCENE = """
from pathlib import Path
from cgid.scene import load_scene, synthesise
def run():
    for batch in synthesise(load_scene(Path({scene!r})), 256, seed=1):
        yield batch.signals
"""
#: Code for the processes; it defines `run`, which yields arrays.
KERNELS = {
    "checksum": """
import numpy as np
from cgid.store._packing import fletcher32
def run():
    yield np.asarray(fletcher32(np.arange(20_000, dtype="<u2")))
""",
    "pulses": _SCENE.format(scene=str(ROOT / "datasets" / "reference.toml")),
    "beam": _SCENE.format(scene=str(ROOT / "datasets" / "tail_beam.toml")),
}
_REST = """
import hashlib, json, sys
print("ready", flush=True)
sys.stdin.readline()
found = hashlib.sha256(b"".join(array.tobytes() for array in run())).hexdigest()
kernels = {id(one): one for name, module in sys.modules.items() if name.startswith("cgid.")
           for one in vars(module).values() if hasattr(one, "py_func")}.values()
read, compiled = (sum(sum(getattr(one.stats, what).values()) for one in kernels)
                  for what in ("cache_hits", "cache_misses"))
print(json.dumps({"result": found, "read": read, "compiled": compiled}))
"""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The outcome of a process: SHA-256 of its arrays, and how many kernels it read and compiled."""

    result: str
    read: int
    compiled: int
    complaint: str = ""


@dataclass(frozen=True, kw_only=True)
class Processes:
    """The way to start processes.

    kernels : a key of `KERNELS`
    surroundings : environment variables to set, or to remove (None)
    before : code that runs first
    command : command that starts Python
    """

    kernels: str
    surroundings: dict[str, str | None]
    before: str = ""
    command: tuple[str, ...] = ()

    def run(self, number: int = 1) -> list[Outcome]:
        """Start this many processes at once and return their outcomes."""
        environment = {name: text for name, text in (os.environ | self.surroundings).items() if text is not None}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), environment.get("PYTHONPATH"))))
        command = [*self.command, sys.executable, "-c", self.before + KERNELS[self.kernels] + _REST]
        pipe = subprocess.PIPE
        started = [
            subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment)
            for _ in range(number)
        ]
        for process in started:
            process.stdout.readline()  # "ready"
        return [_outcome(process) for process in _go(started)]


def _go(started: list[subprocess.Popen[str]]) -> list[subprocess.Popen[str]]:
    for process in started:
        if process.poll() is None:
            process.stdin.write("\n")
            process.stdin.flush()
    return started


def _outcome(process: subprocess.Popen[str]) -> Outcome:
    output, complaint = process.communicate()
    if process.returncode or complaint:
        return Outcome(result="", read=0, compiled=0, complaint=f"exit {process.returncode}: {complaint}")
    return Outcome(**json.loads(output))


def cached(folder: Path, kernels: str) -> Processes:
    """Return processes that keep their kernels in a folder."""
    return Processes(kernels=kernels, surroundings={"NUMBA_CACHE_DIR": str(folder)})


def uncached(kernels: str) -> str:
    """Return the result of a process without cache."""
    (outcome,) = cached(Path(os.devnull), kernels).run()
    if outcome.complaint or outcome.read:
        raise SystemExit(f"without a cache: {outcome}")
    return outcome.result


def cold(folder: Path, kernels: str, expected: str, number: int = 4) -> list[str]:
    """Start processes at once with an empty cache, then one that must find it filled; return the failures."""
    processes = cached(folder, kernels)
    wrong = failures(processes.run(number), expected)
    return wrong + left_whole(processes, expected)


def failures(outcomes: list[Outcome], expected: str) -> list[str]:
    """Return the failures of processes."""
    return [one.complaint or "another result" for one in outcomes if one.result != expected]


def left_whole(processes: Processes, expected: str) -> list[str]:
    """Return the faults that a last process finds in the cache of the others."""
    outcomes = processes.run()
    wrong = failures(outcomes, expected)
    return wrong or [f"{one.compiled} kernels were compiled again" for one in outcomes if one.compiled]


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _garbage(path: Path) -> None:
    path.write_bytes(random.Random(path.name).randbytes(path.stat().st_size))


def _flipped_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    chance = random.Random(path.name)
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    path.write_bytes(content)


def _swapped(path: Path) -> None:
    """Replace a kernel by another intact kernel."""
    others = sorted(path.parent.iterdir())
    shutil.copyfile(others[(others.index(path) + 1) % len(others)], path)


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _gone(path: Path) -> None:
    path.unlink()


#: Damage to every file of a cache, which is repaired afterwards.
DAMAGES: dict[str, Callable[[Path], None]] = {
    "empty files": _empty,
    "truncated files": _truncated,
    "garbage": _garbage,
    "a flipped bit in each": _flipped_bit,
    "one kernel in place of another": _swapped,
    "pipes for files": _pipe,
    "files gone": _gone,
}


def damage(folder: Path, change: Callable[[Path], None]) -> None:
    """Damage every compiled kernel below a folder."""
    for path in sorted(folder.glob("kernels-*/*")):
        change(path)


def without_a_place(folder: Path, kernels: str) -> Iterator[tuple[str, Processes]]:
    """Yield environments in which nothing can be cached; `folder` is empty and may be filled."""
    usual: dict[str, str | None] = {"NUMBA_CACHE_DIR": None, "XDG_CACHE_HOME": None}
    for name, home in {"a home that is not there": "/proc/nowhere", "a home that is no folder": os.devnull}.items():
        yield name, Processes(kernels=kernels, surroundings=usual | {"HOME": home})
    yield "no home", Processes(kernels=kernels, surroundings=usual | {"HOME": "."})
    asked: dict[str, str | None] = {"NUMBA_CACHE_DIR": str(folder)}
    limit = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0}))\n"
    for size in (0, 4096):
        name = f"a disk that is full after {size} bytes"
        yield name, Processes(kernels=kernels, surroundings=asked, before=limit.format(size))


def read_only(folder: Path, kernels: str) -> Processes | None:
    """Return processes that may not write below a folder; None if the system cannot restrict the administrator."""
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o500 if path.is_dir() else 0o400)
    command: tuple[str, ...] = ()
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            return None
        command = ("setpriv", "--bounding-set", "-dac_override,-dac_read_search")
    return Processes(kernels=kernels, surroundings={"NUMBA_CACHE_DIR": str(folder)}, command=command)


def _rows(kernels: str, rounds: int, number: int, folder: Path) -> Iterator[tuple[str, int, list[str]]]:
    """Yield the trial, its number of processes, and its failures."""
    expected = uncached(kernels)
    wrong = [text for k in range(rounds) for text in cold(folder / str(k), kernels, expected, number)]
    yield f"{rounds} times {number} at once, empty cache", rounds * (number + 1), wrong
    processes = cached(folder / "0", kernels)
    processes.run()
    for name, change in DAMAGES.items():
        damage(folder / "0", change)
        again = failures(processes.run(number), expected) + left_whole(processes, expected)
        yield f"{number} at once, {name}", number + 1, again
    for name, unlucky in without_a_place(folder / "none", kernels):
        yield name, number, failures(unlucky.run(number), expected)
    for name, place in {"filled": folder / "0", "empty": folder / "bare"}.items():
        place.mkdir(exist_ok=True)
        barred = read_only(place, kernels)
        if barred is not None:
            wrong = failures(barred.run(number), expected)
            wrong += left_whole(barred, expected) if name == "filled" else []
            yield f"a read-only cache, {name}", number, wrong


def main() -> None:
    """Print a line for each trial, and the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--kernels", choices=KERNELS, default="pulses")
    options = parser.parse_args()
    start, total = time.perf_counter(), 0
    print("| tried | processes | failures |\n|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, number, wrong in _rows(options.kernels, options.rounds, options.processes, Path(folder)):
            print(f"| {name} | {number} | {len(wrong)} |", flush=True)
            total += len(wrong)
            for text in wrong:
                print(text, file=sys.stderr)
    print(f"\n{total} failures, kernels: {options.kernels}, {time.perf_counter() - start:.0f} s")
    sys.exit(bool(total))


if __name__ == "__main__":
    main()
