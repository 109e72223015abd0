"""Identification of the material in real recordings: five materials sliding down a ramp, cross-validated by recording.

    python benchmarks/identification/real_materials.py [--real FOLDER] [--hop 0.05]

The recordings are those of ../shared/realdata/bulk_ramp (for sources see its README): five materials, three recordings
each, of 1 to 4 s. Each recording is left out as a whole in turn (windows of one recording are never on both sides);
features and model are chosen on the others by an inner leave-one-out, as by `cgid train MANIFEST`. Windows last 100 ms.
The 95 % intervals count recordings, not windows.
"""

import argparse
import csv
import tempfile
from pathlib import Path

from benchmarks.identification.ramp import REAL, material
from cgid.identification.training import train_on_groups
from cgid.identification.training.manifest import read_manifest
from cgid.identification.training.recordings import record
from cgid.identification.training.rows import Rows, Slicing

CHANNELS = {"left": "1", "right": "2", "both": "1+2"}


def measured(files: list[Path], channel: str, hop: float) -> Rows:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "manifest.csv"
        with path.open("w", newline="") as stream:
            rows = csv.writer(stream)
            rows.writerow(["path", "label", "channel"])
            rows.writerows([file.resolve(), material(file), channel] for file in files)
        return record(read_manifest(path), slicing=Slicing(by="window", hop_time=hop), augment=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=REAL)
    parser.add_argument("--hop", type=float, default=0.05, help="from the start of a window to that of the next [s]")
    parser.add_argument("--channels", nargs="+", choices=CHANNELS, default=list(CHANNELS))
    options = parser.parse_args()
    files = sorted(options.real.glob("*_[0-9].wav"))
    if not files:
        print(f"skipped: there are no recordings in {options.real}; say --real FOLDER")
        return
    print("| channel | a window | a recording | votes over 0.5 s | over 1 s | features taken (of 15 folds) |")
    print("|---|---|---|---|---|---|")
    for channel in options.channels:
        training = train_on_groups(measured(files, CHANNELS[channel], options.hop)).model.header["training"]
        metrics, candidates = training["metrics"], training["recorded"]["candidates"]
        taken = ", ".join(f"{one['name']} ({one['taken_in_folds']})" for one in candidates if one["taken_in_folds"])
        shares = [metrics, metrics["recordings"], *metrics["running"]]
        cells = ("{:.3f} ({:.2f} to {:.2f})".format(one["accuracy"], *one["accuracy_interval_95"]) for one in shares)
        print(f"| {channel} | {' | '.join(cells)} | {taken} |", flush=True)


if __name__ == "__main__":
    main()
