"""Rate and memory of `cgid generate`, of training streams, and when storing no signals pays.

    python benchmarks/generation.py [--signals 50000] [--scenes reference tail_beam] [--folder DIR]

A dataset follows from its scene and seed, so signals can be made again instead of read. The first table is
that of whole runs by one job and by two, start-up included; the others are of one process that makes or reads batches
and looks at them. The data read stay in memory if there is room: a disk is slower, and the last column of the second
table is the disk rate at which making is as quick. Both scenes take some five minutes of two otherwise idle cores.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import cgid
from cgid import shipped
from cgid.scene import load_scene, synthesise
from cgid.signals import Batch
from cgid.store import Dataset

JOBS = 2
#: Signals of a batch of a training stream.
BATCH = 256


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Cost of one signal of a scene.

    runs : time [s] and peak memory of the largest process [bytes] of a whole run, by the number of jobs
    made, read : time [s]: made again, or read, by one process
    streamed : time [s] in the batches of `cgid.stream`, by the number of workers, once they have started
    bytes : on the disk
    """

    runs: dict[int, tuple[float, int]]
    made: float
    read: float
    streamed: dict[int, float]
    bytes: float


def run(*arguments: str | Path) -> tuple[float, int]:
    """Run a command; return its time [s] and the peak memory of its largest process [bytes]."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "cgid", *map(str, arguments)], stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise SystemExit(f"cgid {' '.join(map(str, arguments))} failed")
    return time.perf_counter() - start, usage.ru_maxrss * 1024


def looked_at(batches: Iterable[Batch]) -> float:
    """Return the time of one of these signals [s]; each is looked at, otherwise some would never be fetched."""
    start, count, total = time.perf_counter(), 0, 0.0
    for batch in batches:
        total += float(batch.signals[:, ::64].sum())
        count += len(batch)
    return (time.perf_counter() - start) / count


def streamed(batches: Iterator[Any], workers: int, n_signals: int) -> float:
    """Return the time of a signal of a training stream [s], of batches that are only looked at."""
    total = sum(float(signals[0, 0]) for signals, *_ in islice(batches, 16 * workers))
    start = time.perf_counter()
    for signals, *_ in islice(batches, n_signals // BATCH):
        total += float(signals[:, ::64].sum())
    return (time.perf_counter() - start) / (n_signals // BATCH * BATCH)


def measured(name: str, n_signals: int, folder: Path) -> Rates:
    scene = load_scene(shipped.scene_path(name))
    data = folder / name
    common = ["generate", name, "-n", str(n_signals)]
    runs = {count: run(*common, "-o", data, "--jobs", str(count), "--overwrite") for count in (1, JOBS)}
    looked_at(synthesise(scene, 2000, 1))  # compiled
    return Rates(
        runs=runs,
        made=looked_at(synthesise(scene, n_signals)),
        read=min(looked_at(Dataset(data).batches()) for _ in range(2)),
        streamed={n: streamed(iter(cgid.stream(scene, batch_size=BATCH, workers=n)), n, n_signals) for n in (1, 2)},
        bytes=sum(file.stat().st_size for file in data.iterdir()) / n_signals,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--signals", type=int, default=50_000)
    parser.add_argument("--scenes", nargs="+", default=["reference", "tail_beam"])
    parser.add_argument("--folder", help="where the datasets go (by default a temporary folder)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        rates = {scene: measured(scene, arguments.signals, Path(name)) for scene in arguments.scenes}
    print("| signals | jobs | s | signals/s | MB/s | memory of the largest process [MB] |\n|---|---|---|---|---|---|")
    for scene, one in rates.items():
        for jobs, (seconds, memory) in one.runs.items():
            rate = arguments.signals / seconds
            print(
                f"| {arguments.signals} of `{scene}` | {jobs} | {seconds:.1f} | {rate:.0f} | "
                f"{rate * one.bytes / 1e6:.0f} | {memory / 1e6:.0f} |"
            )
    print("\n| a signal of | made again | read and checked | made again is quicker where the disk gives less than |")
    print("|---|---|---|---|")
    for scene, one in rates.items():
        limit = f"{one.bytes / one.made / 1e6:.3g} MB/s for each process"
        print(f"| `{scene}` | {1e6 * one.made:.0f} us | {1e6 * one.read:.0f} us | {limit} |")
    print(
        f"\n| batches of {BATCH} a second | `cgid.stream`, 1 worker | 2 workers | read from HDF5 |\n|---|---|---|---|"
    )
    for scene, one in rates.items():
        cells = [1 / (BATCH * seconds) for seconds in (*one.streamed.values(), one.read)]
        print(f"| `{scene}` | {' | '.join(f'{cell:.0f}' for cell in cells)} |")


if __name__ == "__main__":
    main()
