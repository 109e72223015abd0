"""Concurrent start of processes with an empty kernel cache: 0 failures expected.

    python benchmarks/cold_start.py                                        # 20 rounds of four processes
    python benchmarks/cold_start.py --rounds 2 --kernels checksum          # the same in seconds
    python benchmarks/cold_start.py --rounds 2 --kernels beam              # with the largest kernels, minutes a round

The processes wait until all have started, then compile (or read) and run the same kernels. A process fails if its exit
code is not 0, if it prints anything, or if its result differs by a bit from that of a process without cache. After
every round a last process must find all kernels there and compile none. Damaged and impossible caches are for
`tests/test_compiled.py`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
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
    """Processes with a key of `KERNELS`, the folder of their cache, and code that runs first."""

    kernels: str
    folder: Path
    before: str = ""

    def run(self, number: int = 1) -> list[Outcome]:
        """Start this many processes at once and return their outcomes."""
        environment = os.environ | {"NUMBA_CACHE_DIR": str(self.folder)}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), environment.get("PYTHONPATH"))))
        command = [sys.executable, "-c", self.before + KERNELS[self.kernels] + _REST]
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


def uncached(kernels: str) -> str:
    """Return the result of a process without cache."""
    (outcome,) = Processes(kernels=kernels, folder=Path(os.devnull)).run()
    if outcome.complaint or outcome.read:
        raise SystemExit(f"without a cache: {outcome}")
    return outcome.result


def cold(folder: Path, kernels: str, expected: str, number: int = 4) -> list[str]:
    """Start processes at once with an empty cache, then one that must find it filled; return the failures."""
    processes = Processes(kernels=kernels, folder=folder)
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


def main() -> None:
    """Print the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--kernels", choices=KERNELS, default="pulses")
    options = parser.parse_args()
    start, total = time.perf_counter(), 0
    with tempfile.TemporaryDirectory() as folder:
        expected = uncached(options.kernels)
        for k in range(options.rounds):
            for text in cold(Path(folder) / str(k), options.kernels, expected, options.processes):
                total += 1
                print(text, file=sys.stderr)
    trials = f"{options.rounds} rounds of {options.processes} processes with {options.kernels}"
    print(f"{trials}: {total} failures, {time.perf_counter() - start:.0f} s")
    sys.exit(bool(total))


if __name__ == "__main__":
    main()
