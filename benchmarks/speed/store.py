"""Full frames to the disk against h5py writing ready arrays with checksums; breakdown of the time; peak memory.

    python benchmarks/speed/store.py [--scene reference] [--signals 32768] [--rounds 5] [--jobs 2]
                               [--memory 10000 100000 1000000] [--folder DIR]

Rates are medians of alternating rounds, in megabytes of signals in memory. h5py (one process) writes an existing array
to one file, with fletcher32 as in cgid's shards, and flushes it to the disk, as cgid does with every shard;
`unflushed` is h5py's rate without the flush. `cgid` also makes the signals, hashes every shard, and writes a folder;
its worker processes are warm. `reading` is h5py reading the shards. On a busy machine compare processor times, not
rates. Needs psutil.
"""

import argparse
import hashlib
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from cgid import shipped
from cgid.scene import generate, load_scene, synthesise
from cgid.scene.synthesis.draws import parameter_units
from cgid.store.hdf5 import ShardBuilder, ShardPlan

SHARD = 4096
#: Shards of the run whose processor time is measured as a whole.
SHARDS = 4


@dataclass
class Times:
    """Times in each round [s], and the size relative to memory."""

    h5py: list[float] = field(default_factory=list)
    unflushed: list[float] = field(default_factory=list)
    one: list[float] = field(default_factory=list)
    several: list[float] = field(default_factory=list)
    reading: list[float] = field(default_factory=list)
    size: float = 0.0


def flush(path: Path) -> None:
    with path.open("rb+") as stream:
        os.fsync(stream.fileno())


def write_ready(path: Path, signals: Any) -> tuple[float, float]:
    """Return the time of h5py to write existing signals, with and without flushing them to the disk [s]."""
    rows = max(1, (1 << 19) // signals[0].nbytes)
    start = time.perf_counter()
    with h5py.File(path, "w") as file:
        file.create_dataset("signals", data=signals, chunks=(rows, signals.shape[1]), fletcher32=True)
    written = time.perf_counter() - start
    flush(path)
    return time.perf_counter() - start, written


def seconds_of(work: Callable[[], object]) -> float:
    """Return the time of a call [s]."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def read(folder: Path) -> None:
    for shard in sorted(folder.glob("shard-*.h5")):
        with h5py.File(shard) as file:
            file["signals"][:]


def take_turns(scene: Any, signals: Any, folder: Path, rounds: int, jobs: int) -> Times:
    """Return the times; the first round, which compiles and starts workers, does not count."""
    taken = Times()
    for number in range(rounds + 1):
        n_signals = len(signals) if number else SHARD * jobs
        flushed, written = write_ready(folder / "ready.h5", signals[:n_signals])
        (folder / "ready.h5").unlink()
        made = {}
        for workers in (1, jobs):
            output = folder / f"made-{workers}"
            shutil.rmtree(output, ignore_errors=True)
            made[workers] = seconds_of(
                lambda out=output, n=n_signals, workers=workers: generate(scene, out, n, jobs=workers)
            )
        if number:
            taken.h5py.append(flushed)
            taken.unflushed.append(written)
            taken.one.append(made[1])
            taken.several.append(made[jobs])
            taken.reading.append(seconds_of(lambda out=output: read(out)))
            stored = sum(shard.stat().st_size for shard in output.glob("shard-*.h5"))
            taken.size = stored / (signals[0].nbytes * n_signals)
    return taken


def stages(scene: Any, folder: Path) -> dict[str, float]:
    """Return the processor time of each stage on one thread [us/signal], and the time waiting for the disk."""
    batches = list(synthesise(scene, SHARD, 1))
    plan = ShardPlan(
        n_samples=scene.sampling.samples,
        dtype="float32",
        label_width=max(map(len, scene.labels)),
        parameter_units=parameter_units(scene),
        attributes={"format": "cgid-dataset"},
    )
    image: list[memoryview] = []

    def build() -> None:
        builder = ShardBuilder(plan, 0, SHARD)
        for batch in batches:
            builder.add(batch)
        image[:] = [builder.image()]

    path = folder / "stage.h5"
    work: dict[str, Callable[[], object]] = {
        "making the signals": lambda: [len(batch) for batch in synthesise(scene, SHARD, 1)],
        "the shard in memory: chunks, checksums": build,
        "SHA-256": lambda: hashlib.sha256(image[0]),
        "writing": lambda: path.write_bytes(image[0]),
    }
    signals = np.concatenate([batch.signals for batch in batches])
    work |= {
        # Work done once per run counts for all of its shards.
        "all of `generate`, one job": lambda: generate(scene, folder / "whole", SHARDS * SHARD, overwrite=True),
        "h5py, for an array that is there": lambda: write_ready(path, signals),
    }
    took = {}
    for name, run in work.items():
        rounds = []
        for _ in range(3):
            start = time.process_time()
            run()
            rounds.append(time.process_time() - start)
        took[name] = min(rounds) / SHARD * 1e6 / (SHARDS if "generate" in name else 1)
    waits = []
    for _ in range(5):
        path.write_bytes(image[0])
        waits.append(seconds_of(lambda: flush(path)))
    took["waiting for the disk (no processor time)"] = statistics.median(waits) / SHARD * 1e6
    path.unlink()
    return took


def peak_memory(arguments: Sequence[str]) -> float:
    """Return the sum of the peaks of a command's processes [MB] (Linux: VmHWM)."""
    import psutil

    peaks: dict[int, int] = {}
    process = subprocess.Popen([sys.executable, "-m", "cgid", *arguments], stderr=subprocess.DEVNULL)
    watched = psutil.Process(process.pid)
    while process.poll() is None:
        try:
            alive = [watched.pid, *(child.pid for child in watched.children(recursive=True))]
        except psutil.NoSuchProcess:
            break
        for pid in alive:
            try:
                status = Path(f"/proc/{pid}/status").read_text()
            except OSError:
                continue
            # A process that has just ended has no memory.
            peak = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")), 0)
            peaks[pid] = max(peak, peaks.get(pid, 0))
        time.sleep(0.05)
    if process.wait():
        raise SystemExit(f"cgid {' '.join(arguments)} failed")
    return sum(peaks.values()) * 1024 / 1e6


def show_rates(taken: Times, megabytes: float, jobs: int) -> None:
    print(
        f"| samples | size | h5py | unflushed | cgid, 1 job | cgid, {jobs} jobs | beside h5py | reading |\n"
        + "|---" * 8
        + "|"
    )
    h5py_rate, unflushed, one, several, reading = (
        megabytes / statistics.median(getattr(taken, name))
        for name in ("h5py", "unflushed", "one", "several", "reading")
    )
    ratio = statistics.median(ready / made for ready, made in zip(taken.h5py, taken.several, strict=True))
    print(
        f"| float32 | {taken.size:.3f} | {h5py_rate:.0f} | {unflushed:.0f} | {one:.0f} | {several:.0f} "
        f"| {ratio:.0%} | {reading:.0f} |"
    )


def show_stages(scene: Any, folder: Path) -> None:
    print("\n| processor time [us a signal] | |\n|---|---|")
    for stage, took in stages(scene, folder).items():
        print(f"| {stage} | {took:.1f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="reference")
    parser.add_argument("--signals", type=int, default=8 * SHARD)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--memory", type=int, nargs="*", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--folder", help="where the datasets go (by default a temporary folder)")
    arguments = parser.parse_args()
    scene = load_scene(shipped.scene_path(arguments.scene))
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        if arguments.rounds:
            signals = np.concatenate([batch.signals for batch in synthesise(scene, arguments.signals)])
            print(f"Scene `{scene.name}`, {len(signals)} signals of {signals.shape[1]} samples; MB/s.\n")
            times = take_turns(scene, signals, folder, arguments.rounds, arguments.jobs)
            show_rates(times, signals.nbytes / 1e6, arguments.jobs)
            del signals
            shutil.rmtree(folder / f"made-{arguments.jobs}")
        show_stages(scene, folder)
        if arguments.memory:
            print(f"\n| signals, {arguments.jobs} jobs | peak memory of all processes [MB] |\n|---|---|")
        for count in arguments.memory:
            output, jobs = str(folder / "large"), str(arguments.jobs)
            peak = peak_memory(["generate", arguments.scene, "-o", output, "-n", str(count), "--jobs", jobs])
            print(f"| {count} | {peak:.0f} |")
            shutil.rmtree(output)


if __name__ == "__main__":
    main()
