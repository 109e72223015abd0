"""Training on a dataset several times as large as the memory it may take.

    python benchmarks/streamed_training.py [--signals 98304] [--room 48]

One process trains on a little dataset first, so that its libraries have what they take, whatever the data. From then
on it may take so many MB more (RLIMIT_DATA: all that is written to, touched or not), and the process that reads HDF5
for it may, too. It trains on a quarter of a dataset and on the whole; then, for comparison, with all of its batches in
memory, which must fail, or the limit shows nothing.
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
from cgid.identification.training import train
from cgid.scene import generate, load_scene
from cgid.signals import Batch
from cgid.store import Dataset

#: Quick to measure: what is asked here is what is kept.
FEATURES = ("peak_force", "impulse", "contact_duration")
#: Signals of the first dataset: two batches, as the second is read while the first is still held.
_LITTLE = 2048


def made(folder: Path, n_signals: int) -> tuple[Path, Path]:
    """Make a little dataset and a large one of the reference scene."""
    scene = load_scene(shipped.scene_path("reference"))
    return generate(scene, folder / "little", _LITTLE, 1), generate(scene, folder / "large", n_signals, 2)


def trained_within(room: int, little: Path, large: Path) -> dict[str, Any]:
    """Return what a process of its own tells of training with so many bytes beyond what its libraries take."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, __file__, "--within", str(room), str(little), str(large)]
    told = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout
    found: dict[str, Any] = json.loads(told)
    return found


def _within(room: int, little: Path, large: Path) -> dict[str, Any]:
    """Train under the limit in this process; see the top of this file."""
    _trained(Dataset(little))
    readers = [int(number) for number in Path("/proc/thread-self/children").read_text().split()]
    for process in (os.getpid(), *readers):
        limit = _data(process) + room
        resource.prlimit(process, resource.RLIMIT_DATA, (limit, limit))
    data, peaks = Dataset(large), [_peak()]
    # A peak never falls, so the smaller comes first.
    for batches in (_quarter(data), data.batches()):
        _trained(batches)
        peaks.append(_peak())
    return {"peaks": peaks, "readers": [_peak(number) for number in readers], "fails_at_once": not _fits(data)}


def _quarter(data: Dataset) -> Iterator[Batch]:
    """Yield the first batches, up to a quarter of the signals."""
    count = 0
    for batch in data:
        yield batch
        count += len(batch)
        if 4 * count >= len(data):
            return


def _fits(data: Dataset) -> bool:
    """Return whether the same training has room enough with all batches in memory."""
    try:
        _trained(list(data))
    except MemoryError:
        return False
    return True


def _trained(batches: Iterable[Batch]) -> None:
    train(batches, features=FEATURES, guards=())


def _data(process: int) -> int:
    """Return what counts for RLIMIT_DATA [bytes]."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[5]) * resource.getpagesize()


def _peak(process: int | str = "self") -> int:
    """Return the most memory that a process has held [bytes]."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


def main() -> None:
    """Make, train under the limit, print; exit 1 unless it shows what it is to show."""
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
    print(f"dataset {size / 1e6:.0f} MB, room beyond the libraries {arguments.room} MB, for each of two processes")
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
    print(f"peak of the process that reads HDF5: {max(found['readers']) / 1e6:.0f} MB")
    print(f"with all batches in memory at once: {'no room' if found['fails_at_once'] else 'there was room'}")
    sys.exit(not found["fails_at_once"])


if __name__ == "__main__":
    main()
