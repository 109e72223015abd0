"""Rate and memory of `cgid generate`, cost of a million and a billion signals, and when storing none of them pays.

    python benchmarks/speed/generation.py [--signals 50000] [--scenes reference tail_beam] [--folder DIR]

A dataset follows from its scene and seed, so signals can be made again instead of read. The timings are of two worker
processes that make and write shards, and of one process that makes or reads batches and looks at them. The data read
stay in memory if there is room: a disk is slower, and the last column is the disk rate at which making is as quick.
The first table is that of whole runs by one job and by two, start-up included (`sums.py` compares their arrays); both
scenes take some five minutes of two otherwise idle cores.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import cgid
from benchmarks.speed.recordings import timed
from cgid import shipped
from cgid.scene import Scene, load_scene, synthesise
from cgid.signals import Batch
from cgid.store import Dataset

JOBS = 2
#: Signals of a batch of a training stream.
BATCH = 256


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Cost of one signal of a scene.

    runs : time [s] and peak memory of the largest process [bytes] of a whole run, by the number of jobs
    written, made, read : time [s]: made and written by all jobs; made again, or read, by one process
    streamed : time [s] in the batches of `cgid.stream`, by the number of workers, once they have started
    loaded : the same of the workers of a `DataLoader` of PyTorch, nan where it is not installed
    bytes, parameter_bytes : on the disk: with its samples, and of its drawn parameters alone
    """

    runs: dict[int, tuple[float, int]]
    written: float
    made: float
    read: float
    streamed: dict[int, float]
    loaded: dict[int, float]
    bytes: float
    parameter_bytes: float


def run(*arguments: str | Path) -> tuple[float, int]:
    """Run a command; return its time [s] and the peak memory of its largest process [bytes]."""
    run = timed(["-m", "cgid", *map(str, arguments)], environment=dict(os.environ))
    return run.wall, round(run.memory * 1024**2)


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


def loaded(scene: Scene, workers: int, n_signals: int) -> float:
    """Return the time of a signal [s] through the workers of a `DataLoader`, as in docs/how-to/learners.md."""
    try:
        import torch
        from torch.utils.data import DataLoader, IterableDataset, get_worker_info
    except ImportError:
        return float("nan")

    class Impacts(IterableDataset):  # type: ignore[misc]
        def __iter__(self) -> Iterator[Any]:
            info = get_worker_info()
            for signals, numbers, _ in cgid.stream(scene, batch_size=BATCH, shard=(info.id, info.num_workers)):
                yield torch.from_numpy(signals), torch.from_numpy(numbers)

    return streamed(iter(DataLoader(Impacts(), batch_size=None, num_workers=workers)), workers, n_signals)


def measured(name: str, n_signals: int, folder: Path) -> Rates:
    scene = load_scene(shipped.scene_path(name))
    data, table = folder / name, folder / f"{name}.h5"
    common = ["generate", name, "-n", str(n_signals)]
    jobs = ["--jobs", str(JOBS)]
    start_up, _ = run(
        "generate", name, "-n", str(JOBS), "--set", "shard_signals=1", "-o", folder / f"{name}-little", *jobs
    )
    runs = {count: run(*common, "-o", data, "--jobs", str(count), "--overwrite") for count in (1, JOBS)}
    run(*common, "-o", table, "--parameters-only")
    looked_at(synthesise(scene, 2000, 1))  # compiled
    return Rates(
        runs=runs,
        written=max(runs[JOBS][0] - start_up, 0.0) / n_signals,
        made=looked_at(synthesise(scene, n_signals)),
        read=min(looked_at(Dataset(data).batches()) for _ in range(2)),
        streamed={n: streamed(iter(cgid.stream(scene, batch_size=BATCH, workers=n)), n, n_signals) for n in (1, 2)},
        loaded={n: loaded(scene, n, n_signals) for n in (1, 2)},
        bytes=sum(file.stat().st_size for file in data.iterdir()) / n_signals,
        parameter_bytes=table.stat().st_size / n_signals,
    )


def duration(seconds: float) -> str:
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.3g} s"


def size(count: float) -> str:
    for unit, factor in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= factor:
            return f"{count / factor:.3g} {unit}"
    return f"{count:.0f} bytes"


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
    print(f"\n| signals, `--jobs {JOBS}` | time | disk | memory of the largest process | drawn parameters alone |")
    print("|---|---|---|---|---|")
    for scene, one in rates.items():
        for n_signals in (1e6, 1e9):
            cells = [duration(n_signals * one.written), size(n_signals * one.bytes), size(one.runs[JOBS][1])]
            what = f"{n_signals:.0e}".replace("e+0", "e")
            print(f"| {what} of `{scene}` | {' | '.join(cells)} | {size(n_signals * one.parameter_bytes)} |")
    print("\n| a signal of | made again | read and checked | made again is quicker where the disk gives less than |")
    print("|---|---|---|---|")
    for scene, one in rates.items():
        limit = size(one.bytes / one.made)
        print(f"| `{scene}` | {1e6 * one.made:.0f} us | {1e6 * one.read:.0f} us | {limit}/s for each process |")
    print(
        f"\n| batches of {BATCH} a second | `cgid.stream`, 1 worker | 2 workers | `DataLoader`, 1 worker | 2 workers | "
        "read from HDF5 |\n|---|---|---|---|---|---|"
    )
    for scene, one in rates.items():
        cells = [1 / (BATCH * seconds) for seconds in (*one.streamed.values(), *one.loaded.values(), one.read)]
        print(f"| `{scene}` | {' | '.join(f'{cell:.0f}' for cell in cells)} |")


if __name__ == "__main__":
    main()
