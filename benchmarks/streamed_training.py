"""Training on a dataset larger than the memory it may take, and what each further signal costs of it.

    python benchmarks/streamed_training.py [--signals 60000] [--scene reference]

A process that may take less memory for data (RLIMIT_DATA) than the dataset has bytes trains on all of it, and its peak
is measured on half and on all of the signals. The limit counts memory that is written to, of libraries as well.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from cgid.store import Dataset

#: Quick to measure: what is asked here is what is kept.
FEATURES = "peak_force,impulse,contact_duration"


def trained(data: Path, model: Path, limit: int | None = None) -> tuple[int, float]:
    """Train in a process of its own; return its exit code and its peak resident memory [MB]."""

    def narrow() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))

    command = [sys.executable, "-m", "cgid", "train", str(data), "-o", str(model), "--features", FEATURES]
    # Threads that never run reserve memory, too.
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(command, preexec_fn=narrow, env=environment, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_maxrss / 1e3


def made(folder: Path, scene: str, n_signals: int) -> tuple[Path, int]:
    """Make a dataset; return its folder and its bytes."""
    path = folder / str(n_signals)
    command = [sys.executable, "-m", "cgid", "generate", scene, "-o", str(path), "-n", str(n_signals)]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    return path, sum(file.stat().st_size for file in path.iterdir())


def main() -> None:
    """Make, train under the limit, print; exit 1 if it does not fit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--signals", type=int, default=60_000)
    parser.add_argument("--scene", default="reference")
    arguments = parser.parse_args()
    peaks, codes = [], []
    with tempfile.TemporaryDirectory() as name:
        print("| signals | dataset [MB] | may take [MB] | exit code | peak of the process [MB] |")
        print("|---|---|---|---|---|")
        for n_signals in (arguments.signals // 2, arguments.signals):
            data, size = made(Path(name), arguments.scene, n_signals)
            assert len(Dataset(data)) == n_signals
            limit = size * 9 // 10 if n_signals == arguments.signals else None
            code, peak = trained(data, Path(name) / f"{n_signals}.npz", limit)
            allowed = "all" if limit is None else f"{limit / 1e6:.0f}"
            print(f"| {n_signals} | {size / 1e6:.0f} | {allowed} | {code} | {peak:.0f} |", flush=True)
            peaks.append(peak)
            codes.append(code)
    further = 1e6 * (peaks[1] - peaks[0]) / (arguments.signals - arguments.signals // 2)
    print(f"\na further signal takes {further:.0f} bytes of memory, its samples 8192 bytes of the disk")
    sys.exit(max(codes))


if __name__ == "__main__":
    main()
