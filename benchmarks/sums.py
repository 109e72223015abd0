"""SHA-256 of every array of a dataset made in four ways, and of a model trained in three: all must be equal.

    python benchmarks/sums.py [--signals 20000] [--scene reference] [--seed 3]

The ways: `--jobs 1`, `--jobs 2`, a dask cluster of two worker processes, and a run killed half-way and resumed.
"""

import argparse
import hashlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

#: Small enough that the killed run has finished some.
SHARD_SIGNALS = 512


@contextmanager
def two_workers() -> Iterator[str]:
    """Yield the address of a dask scheduler with two worker processes on this machine."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1") as cluster:
        yield str(cluster.scheduler_address)


def cgid(*arguments: str | Path) -> None:
    """Run a command; exit if it fails."""
    subprocess.run(
        [sys.executable, "-m", "cgid", *map(str, arguments)],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def array_sums(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every array of a dataset, and of every file."""
    arrays: dict[str, hashlib._Hash] = {}
    for shard in sorted(folder.glob("*.h5")):
        with h5py.File(shard) as file:
            for name in ("signals", "labels", "specimen", *(f"parameters/{one}" for one in file["parameters"])):
                arrays.setdefault(name, hashlib.sha256()).update(file[name][:].tobytes())
    files = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        files.update(path.name.encode() + path.read_bytes())
    return {name: digest.hexdigest() for name, digest in arrays.items()} | {"all files": files.hexdigest()}


def interrupted(arguments: list[str | Path], folder: Path, n_shards: int) -> None:
    """Start a run, kill it when half of its shards exist, and resume it."""
    command = [sys.executable, "-m", "cgid", *map(str, arguments)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while process.poll() is None and len(list(folder.glob("shard-*.h5"))) < n_shards // 2:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    print(f"killed with {len(list(folder.glob('shard-*.h5')))} of {n_shards} shards there")
    cgid(*arguments, "--resume")


def datasets(folder: Path, arguments: argparse.Namespace, scheduler: str) -> dict[str, dict[str, str]]:
    """Make the dataset in each way; return the sums of each."""
    common = ["generate", arguments.scene, "-n", str(arguments.signals), "--seed", str(arguments.seed)]
    common += ["--shard-signals", str(SHARD_SIGNALS)]
    cgid(*common, "-o", folder / "one")
    cgid(*common, "-o", folder / "two", "--jobs", "2")
    cgid(*common, "-o", folder / "dask", "--scheduler", scheduler)
    interrupted([*common, "-o", folder / "resumed"], folder / "resumed", -(-arguments.signals // SHARD_SIGNALS))
    return {way: array_sums(folder / way) for way in ("one", "two", "dask", "resumed")}


def models(folder: Path, scheduler: str) -> dict[str, dict[str, str]]:
    """Train on the dataset in each way; return the sum of each model."""
    ways: dict[str, list[str]] = {"one": [], "two": ["--jobs", "2"], "dask": ["--scheduler", scheduler]}
    for way, options in ways.items():
        cgid("train", folder / "one", "-o", folder / f"{way}.npz", *options)
    digests = {way: hashlib.sha256((folder / f"{way}.npz").read_bytes()).hexdigest() for way in ways}
    return {way: {"model": digest} for way, digest in digests.items()}


def told(sums: dict[str, dict[str, str]]) -> bool:
    """Print the sums of all ways; return whether they are equal."""
    ways = list(sums)
    print(f"| | {' | '.join(ways)} |\n|---|{'---|' * len(ways)}")
    for name in sums[ways[0]]:
        print(f"| {name} | {' | '.join(sums[way][name][:16] for way in ways)} |")
    return all(one == sums[ways[0]] for one in sums.values())


def main() -> None:
    """Make, compare, print; exit 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--signals", type=int, default=20_000)
    parser.add_argument("--scene", default="reference")
    parser.add_argument("--seed", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, two_workers() as scheduler:
        alike = told(datasets(Path(name), arguments, scheduler))
        alike &= told(models(Path(name), scheduler))
    print(f"\nall alike: {alike}")
    sys.exit(not alike)


if __name__ == "__main__":
    main()
