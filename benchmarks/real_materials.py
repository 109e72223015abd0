"""Identification of the material in real recordings: five materials sliding down a ramp, cross-validated by recording.

    python benchmarks/real_materials.py [--real FOLDER] [--hop 0.05]

The recordings are those of ../shared/realdata/bulk_ramp (for sources see its README): five materials, three recordings
each, of 1 to 4 s. Each recording is left out as a whole in turn (windows of one recording are never on both sides);
features and model are chosen on the others by an inner leave-one-out. Windows last 100 ms. Prints Markdown:

* the accuracy of `cgid train MANIFEST` with either channel and with both: by window, by recording (vote of its
  windows), and by running vote; the 95 % intervals count recordings, not windows;
* each set of features by itself, without selection.

`real_materials_checks.py` separates the material from the set-up in this accuracy.
"""

import argparse
import csv
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cgid.identification.grouped import Lesson, candidates_for, judge
from cgid.identification.labelled_recordings import record
from cgid.identification.manifest import read_manifest
from cgid.identification.metrics import clustered_interval
from cgid.identification.rows import Rows, Slicing, sets_for
from cgid.identification.training import train

HERE = Path(__file__).parent
REAL = HERE.parents[1] / "shared" / "realdata" / "bulk_ramp"
CHANNELS = {"left": "1", "right": "2", "both": "1+2"}
SETS = sets_for("window")


def recordings(folder: Path) -> list[Path]:
    """Return the files; exit if any is missing."""
    files = sorted(folder.glob("*_[0-9].wav"))
    if not files:
        sys.exit(f"there are no recordings in {folder}; say --real FOLDER")
    return files


def material(file: Path) -> str:
    """Return the material of a recording: its name without the number."""
    return file.stem[:-2]


def measured(files: list[Path], channel: str, hop: float) -> Rows:
    """Return the features of the windows of all recordings, as in `cgid train`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "manifest.csv"
        with path.open("w", newline="") as stream:
            rows = csv.writer(stream)
            rows.writerow(["path", "label", "channel"])
            rows.writerows([file.resolve(), material(file), channel] for file in files)
        return record(read_manifest(path), slicing=Slicing(by="window", hop_time=hop))


def share(accuracy: float, interval: tuple[float, float]) -> str:
    """Return a share with its interval."""
    return f"{accuracy:.3f} ({interval[0]:.2f} to {interval[1]:.2f})"


def nested(tables: dict[str, Rows]) -> None:
    """Print the results of training with features chosen inside the folds."""
    print("| channel | a window | a recording | votes over 0.5 s | over 1 s | features taken (of 15 folds) |")
    print("|---|---|---|---|---|---|")
    for channel, table in tables.items():
        training = train(table)
        metrics, about = training.model.header["training"]["metrics"], training.model.header["training"]["recorded"]
        shares = [metrics, metrics["recordings"], *metrics["running"]]
        taken = ", ".join(f"{c['name']} ({c['taken_in_folds']})" for c in about["candidates"] if c["taken_in_folds"])
        cells = [share(one["accuracy"], tuple(one["accuracy_interval_95"])) for one in shares]
        print(f"| {channel} | {' | '.join(cells)} | {taken} |", flush=True)


def answers(table: Rows, names: tuple[str, ...]) -> NDArray[np.str_]:
    """Return each window's answer by a model of these features, trained on the other recordings."""
    candidates = candidates_for({"": names}, table.names, "linear")
    found = judge(Lesson(rows=table, candidates=candidates, weights=None, seed=0))
    return np.asarray(np.unique(table.labels)[np.argmax(found.probabilities, axis=1)])


def one_by_one(tables: dict[str, Rows]) -> None:
    """Print each set by itself."""
    print(f"\n| features | number | {' | '.join(tables)} |")
    print("|---|---|---|---|---|")
    for name, names in SETS.items():
        cells = []
        for table in tables.values():
            hits = answers(table, names) == table.labels
            cells.append(share(float(hits.mean()), clustered_interval(hits, table.group)))
        held = sum(feature in next(iter(tables.values())).names for feature in names)
        print(f"| {name} | {held} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=REAL)
    parser.add_argument("--hop", type=float, default=0.05, help="from the start of a window to that of the next [s]")
    asked = parser.parse_args()
    files = recordings(asked.real)
    tables = {name: measured(files, channel, asked.hop) for name, channel in CHANNELS.items()}
    print(f"{len(files)} recordings, {len(tables['left'].labels)} windows of 100 ms every {asked.hop * 1e3:g} ms\n")
    nested(tables)
    one_by_one(tables)


if __name__ == "__main__":
    main()
