"""What fell, told from real recordings: five materials sliding down a ramp, each recording judged by the others.

    python benchmarks/real_materials.py [--real FOLDER] [--hop 0.05] [--checks]

The recordings are those of ../shared/realdata/bulk_ramp (its README says where they are from): five materials, three
recordings each, of 1 to 4 s. Every recording is left out as a whole in turn (windows of one recording are never on both
sides); features and the model are chosen on the others, by leaving out once more. Windows last 100 ms. Prints Markdown:

* what `cgid train MANIFEST` finds with one channel, the other, and both: a window, a whole recording by the vote of its
  windows, running votes; with 95 % intervals that count recordings, not windows;
* each set of features by itself, chosen by nobody.

With --checks also what an accuracy like this must be asked: what shuffled labels give, which material is told from
which, what is left without the material that was recorded on another set-up, how alike the ramp sounds in all
recordings, and what a gain or another response of the sensor costs and a reference run cures.
"""

import argparse
import csv
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from cgid.equalisation import Equalisation
from cgid.features import FEATURES, extract_array, supported
from cgid.identification.classifier import ImpactClassifier
from cgid.identification.clustered import clustered_interval
from cgid.identification.feature_sets import FEATURE_SETS, union_of
from cgid.identification.grouped import Rows, candidates_for, judge
from cgid.identification.manifest import read_manifest
from cgid.identification.recorded import Recorded, Slicing, record
from cgid.identification.recorded_training import train_recorded
from cgid.identification.reference import MeanSpectrum
from cgid.recordings import read_recording
from cgid.validation import Floats

HERE = Path(__file__).parent
REAL = HERE.parents[1] / "shared" / "realdata" / "bulk_ramp"
CHANNELS = {"left": "1", "right": "2", "both": "1+2"}
SETS = FEATURE_SETS["window"]
#: The material that was recorded on another set-up than the others: see `ramps`.
APART = "steel_nut_M4"
#: Of a sensor's response [dB]: standard deviation in each third octave, and how many such sensors are tried.
DEVIATION, SENSORS = 4.0, 5
GAIN = 2.0  # 6 dB
RATE, WINDOW = 44_100.0, 4410


def recordings(folder: Path) -> list[Path]:
    """Return the files, or stop with what is missing."""
    files = sorted(folder.glob("*_[0-9].wav"))
    if not files:
        sys.exit(f"there are no recordings in {folder}; say --real FOLDER")
    return files


def material(file: Path) -> str:
    """Return what slides in a recording: its name without its number."""
    return file.stem[:-2]


def measured(files: list[Path], channel: str, hop: float) -> Recorded:
    """Return the features of the windows of all recordings, as `cgid train` has them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "manifest.csv"
        with path.open("w", newline="") as stream:
            rows = csv.writer(stream)
            rows.writerow(["path", "label", "channel"])
            rows.writerows([file.resolve(), material(file), channel] for file in files)
        return record(read_manifest(path), slicing=Slicing(hop_time=hop))


def share(accuracy: float, interval: tuple[float, float]) -> str:
    """Return a share with its interval."""
    return f"{accuracy:.3f} ({interval[0]:.2f} to {interval[1]:.2f})"


def nested(tables: dict[str, Recorded]) -> None:
    """Print what training finds, features chosen inside the folds."""
    print("| channel | a window | a recording | votes over 0.5 s | over 1 s | features taken (of 15 folds) |")
    print("|---|---|---|---|---|---|")
    for channel, table in tables.items():
        training = train_recorded(table)
        metrics, about = training.model.header["training"]["metrics"], training.model.header["training"]["recorded"]
        shares = [metrics, metrics["recordings"], *metrics["running"]]
        taken = ", ".join(f"{c['name']} ({c['taken_in_folds']})" for c in about["candidates"] if c["taken_in_folds"])
        cells = [share(one["accuracy"], tuple(one["accuracy_interval_95"])) for one in shares]
        print(f"| {channel} | {' | '.join(cells)} | {taken} |", flush=True)


def answers(table: Recorded, names: tuple[str, ...]) -> NDArray[np.str_]:
    """Return what each window is called by a model of these features, trained on the other recordings."""
    rows = Rows(names=table.names, features=table.features, labels=table.labels, group=table.group)
    found = judge(rows, candidates_for({"": names}, table.names, ("linear",)), None, 0)
    return np.asarray(np.unique(table.labels)[np.argmax(found.probabilities, axis=1)])


def one_by_one(tables: dict[str, Recorded]) -> None:
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


# -- checks -----------------------------------------------------------------------------------------------


def some(table: Recorded, kept: NDArray[np.bool_]) -> Recorded:
    """Return some of the windows."""
    from dataclasses import replace

    parts = {name: getattr(table, name)[kept] for name in ("features", "labels", "time", "piece", "group")}
    return replace(table, **parts)


def suspicions(table: Recorded) -> None:
    """Print what shuffled labels give, what is mistaken for what, and what is left without the odd one out."""
    chance = train_recorded(table, shuffle_labels=True).model.header["training"]["metrics"]["accuracy"]
    print(f"\nLabels shuffled among the recordings: {chance:.3f} (guessing: 0.2)")
    print(f"\n| features | {' | '.join(np.unique(table.labels))} | four without {APART} |")
    print("|---" * 7 + "|")
    four = some(table, table.labels != APART)
    for name, names in SETS.items():
        found = answers(table, names)
        cells = [f"{np.mean(found[table.labels == label] == label):.2f}" for label in np.unique(table.labels)]
        print(f"| {name} | {' | '.join(cells)} | {np.mean(answers(four, names) == four.labels):.3f} |", flush=True)


def samples_of(file: Path) -> Floats:
    """Return the left channel."""
    return np.asarray(read_recording(file, channel=1)[0].samples, np.float64)


def ramps(files: list[Path]) -> None:
    """Print how the fine structure of the spectra correlates: the modes of the ramp and the place of the sensor.

    What slides shapes a spectrum smoothly; lines that all recordings share are those of the ramp. A material whose
    recordings share other lines was recorded on another set-up, and may be told by that.
    """
    levels, labels = [], np.array([material(file) for file in files])
    for file in files:
        frequency, power = signal.welch(samples_of(file), RATE, nperseg=8192, noverlap=6144)
        level = 10 * np.log10(power + 1e-20)
        levels.append((level - ndimage.uniform_filter1d(level, 81))[(frequency > 3000) & (frequency < 8000)])
    likeness = np.corrcoef(levels)
    print("\nCorrelation of the spectra's fine structure, 3 to 8 kHz (the mean over pairs of recordings):\n")
    different = np.unique(labels)
    print(f"| | {' | '.join(different)} |")
    print("|---" * (len(different) + 1) + "|")
    for one in different:
        cells = []
        for other in different:
            pairs = np.outer(labels == one, labels == other) & ~np.eye(len(labels), dtype=bool)
            cells.append(f"{likeness[pairs].mean():.2f}")
        print(f"| {one} | {' | '.join(cells)} |")


def sensors() -> Iterator[tuple[str, Floats]]:
    """Yield responses as taps of a filter: a gain, and random ones of 4 dB in each third octave."""
    yield "as trained", np.ones(1)
    yield "6 dB louder", np.full(1, GAIN)
    edges = np.append(0.0, 100 * 2 ** (np.arange(24) / 3))
    edges = np.append(edges[edges < 0.49 * RATE], RATE / 2)
    for seed in range(SENSORS):
        levels = np.random.default_rng(seed).normal(0, DEVIATION, edges.size)
        yield f"response {seed + 1}", signal.firwin2(1023, edges, 10 ** (levels / 20), fs=RATE)


def windows_of(file: Path, taps: Floats) -> Floats:
    """Return the windows of a recording through a response, (n_windows, n_samples)."""
    heard = signal.oaconvolve(samples_of(file), taps, mode="same")
    return heard[: heard.size // WINDOW * WINDOW].reshape(-1, WINDOW)


def spectrum(files: list[Path], taps: Floats) -> Floats:
    """Return the mean spectrum of a reference run: what these recordings sound like together."""
    run = MeanSpectrum(RATE)
    for file in files:
        run.feed(windows_of(file, taps))
    return run.levels


def responses(files: list[Path]) -> None:
    """Print what is lost when a sensor is not the one that was trained on, and what its reference run cures.

    The reference runs of either sensor are of other recordings than the one that is judged, and of different ones.
    """
    names = supported(union_of(SETS), RATE, WINDOW)
    flat = np.ones(1)
    tables = {file: extract_array(windows_of(file, flat), RATE, names) for file in files}
    shown = {name: [names.index(one) for one in wanted if one in names] for name, wanted in SETS.items()}
    print(f"\n| sensor | {' | '.join(shown)} |")
    print("|---" * (len(shown) + 1) + "|")
    models = {file: dict(_models(files, file, tables, names, shown)) for file in files}
    for title, taps in sensors():
        for cured in (False, True) if title.startswith("response") else (False,):
            hits: dict[str, list[NDArray[np.bool_]]] = {name: [] for name in shown}
            for file in files:
                table = extract_array(
                    windows_of(file, taps), RATE, names, equalisation=_made_up(files, file, taps) if cured else None
                )
                for name, columns in shown.items():
                    hits[name].append(models[file][name].predict(table[:, columns]) == material(file))
            cells = [f"{np.concatenate(one).mean():.3f}" for one in hits.values()]
            print(f"| {title}{', reference run' if cured else ''} | {' | '.join(cells)} |", flush=True)


def _models(
    files: list[Path], left_out: Path, tables: dict[Path, Floats], names: tuple[str, ...], shown: dict[str, list[int]]
) -> Iterator[tuple[str, ImpactClassifier]]:
    others = [file for file in files if file != left_out]
    rows = np.concatenate([tables[file] for file in others])
    labels = np.repeat([material(file) for file in others], [len(tables[file]) for file in others])
    for name, columns in shown.items():
        linear = tuple(np.flatnonzero([FEATURES[names[column]].linear for column in columns]).tolist())
        classifier = ImpactClassifier("linear", linear=linear, calibration_folds=0, rejects=False)
        yield name, classifier.fit(rows[:, columns], labels)


def _made_up(files: list[Path], judged: Path, taps: Floats) -> Equalisation:
    """Return the equalisation by reference runs of recordings with other numbers than the one that is judged."""
    heard, meant = (
        [file for file in files if int(file.stem[-1]) == (int(judged.stem[-1]) + k) % 3 + 1] for k in (0, 1)
    )
    return Equalisation.between(spectrum(heard, taps), spectrum(meant, np.ones(1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=REAL)
    parser.add_argument("--hop", type=float, default=0.05, help="from the start of a window to that of the next [s]")
    parser.add_argument("--checks", action="store_true")
    asked = parser.parse_args()
    files = recordings(asked.real)
    tables = {name: measured(files, channel, asked.hop) for name, channel in CHANNELS.items()}
    print(f"{len(files)} recordings, {len(tables['left'].labels)} windows of 100 ms every {asked.hop * 1e3:g} ms\n")
    nested(tables)
    one_by_one(tables)
    if asked.checks:
        suspicions(tables["left"])
        ramps(files)
        responses(files)


if __name__ == "__main__":
    main()
