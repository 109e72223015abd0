"""Training on a dataset several times larger than the allowed memory.

    python benchmarks/identification/streamed_training.py [--signals 98304] [--room 48]

One process first trains on a small dataset, so that its libraries have all the memory that they need for any data.
From then on it may take this many MB more (RLIMIT_DATA: all writable memory, touched or not). It trains on a quarter of
a dataset and on the whole; then, as a check of the limit, with all batches in memory, which must fail.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from cgid import shipped
from cgid.identification.training import train_on_specimens
from cgid.scene import generate, load_scene
from cgid.signals import Batch
from cgid.store import Dataset

#: Features that are quick to measure; this is about memory.
FEATURES = ("peak_force", "impulse", "contact_duration")
#: Signals of the first dataset: two batches, because the second is read while the first is still in use.
_LITTLE = 2048


def made(folder: Path, n_signals: int) -> tuple[Path, Path]:
    scene = load_scene(shipped.scene_path("reference"))
    return generate(scene, folder / "little", _LITTLE, 1), generate(scene, folder / "large", n_signals, 2)


def trained_within(room: int, little: Path, large: Path) -> dict[str, Any]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, __file__, "--within", str(room), str(little), str(large)]
    told = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout
    found: dict[str, Any] = json.loads(told)
    return found


def _within(room: int, little: Path, large: Path) -> dict[str, Any]:
    _trained(Dataset(little).batches())
    limit = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize() + room
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    data, peaks = Dataset(large), [_peak()]
    # A peak never falls, so the smaller dataset comes first.
    for batches in (_quarter(data), data.batches()):
        _trained(batches)
        peaks.append(_peak())
    return {"peaks": peaks, "fails_at_once": not _fits(data)}


def _quarter(data: Dataset) -> Iterator[Batch]:
    count = 0
    for batch in data.batches():
        yield batch
        count += len(batch)
        if 4 * count >= len(data):
            return


def _fits(data: Dataset) -> bool:
    try:
        _trained(list(data.batches()))
    except MemoryError:
        return False
    return True


def _trained(batches: Iterable[Batch]) -> None:
    train_on_specimens(batches, features=FEATURES, guards=())


def _peak() -> int:
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) * 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--signals", type=int, default=98_304)
    parser.add_argument("--room", type=int, default=48, help="beyond the libraries' own [MB]")
    parser.add_argument("--within", nargs=3, metavar=("BYTES", "LITTLE", "LARGE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.within:
        room, *paths = arguments.within
        print(json.dumps(_within(int(room), *map(Path, paths))))
        return
    with tempfile.TemporaryDirectory() as name:
        little, large = made(Path(name), arguments.signals)
        size = sum(file.stat().st_size for file in large.iterdir())
        found = trained_within(arguments.room * 10**6, little, large)
    before, quarter, whole = found["peaks"]
    print(f"dataset {size / 1e6:.0f} MB, room beyond the libraries {arguments.room} MB")
    print("| trained on | signals | peak of the process [MB] |")
    print("|---|---|---|")
    for what, count, peak in (
        ("a little dataset, libraries", _LITTLE, before),
        ("a quarter", arguments.signals // 4, quarter),
        ("the whole", arguments.signals, whole),
    ):
        print(f"| {what} | {count} | {peak / 1e6:.0f} |")
    print(f"\na further signal takes {(whole - quarter) / (0.75 * arguments.signals):.0f} bytes of memory, and")
    print(f"{size / arguments.signals:.0f} bytes of the disk")
    print(f"with all batches in memory at once: {'no room' if found['fails_at_once'] else 'there was room'}")
    sys.exit(not found["fails_at_once"])


if __name__ == "__main__":
    main()
