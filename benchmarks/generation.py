"""Rate and peak memory of `cgid generate`, at two sizes and with one and two workers.

    python benchmarks/generation.py [--small 10000] [--large 100000] [--folder DIR]

Each run is a separate process. Checks that one and two workers give identical arrays.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from cgid.store import Dataset


def run(arguments: list[str]) -> tuple[float, float]:
    """Return wall time [s] and peak resident memory [MB] of one command."""
    start = time.perf_counter()
    pid = os.posix_spawn(sys.executable, [sys.executable, "-m", "cgid", *arguments], os.environ)
    _, status, usage = os.wait4(pid, 0)
    if status:
        raise SystemExit(f"cgid {' '.join(arguments)} failed")
    return time.perf_counter() - start, usage.ru_maxrss / 1e3


def same(one: Path, other: Path) -> bool:
    """Return whether two datasets hold identical arrays."""
    for a, b in zip(Dataset(one).batches(), Dataset(other).batches(), strict=True):
        pairs = [(a.signals, b.signals), (a.labels, b.labels), (a.specimen, b.specimen)]
        pairs += [(a.parameters[name], b.parameters[name]) for name in a.parameters]
        if not all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs):
            return False
    return True


def main() -> None:
    """Run, compare, print Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", type=int, default=10_000)
    parser.add_argument("--large", type=int, default=100_000)
    parser.add_argument("--scene", default="reference")
    parser.add_argument("--folder", help="where the datasets go (by default a temporary folder)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        print("| signals | jobs | s | signals/s | MB/s | peak memory of the process [MB] |\n|---|---|---|---|---|---|")
        for count, jobs in ((arguments.small, 1), (arguments.large, 1), (arguments.large, 2)):
            output = folder / f"{count}-{jobs}"
            seconds, memory = run(
                ["generate", arguments.scene, "-o", str(output), "-n", str(count), "--jobs", str(jobs)]
            )
            size = sum(path.stat().st_size for path in output.iterdir()) / 1e6
            print(f"| {count} | {jobs} | {seconds:.1f} | {count / seconds:.0f} | {size / seconds:.0f} | {memory:.0f} |")
        equal = same(folder / f"{arguments.large}-1", folder / f"{arguments.large}-2")
        print(f"\n--jobs 1 and --jobs 2 hold identical arrays: {equal}")


if __name__ == "__main__":
    main()
