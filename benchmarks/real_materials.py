"""Identification of the material in real recordings: five materials sliding down a ramp, cross-validated by recording.

    python benchmarks/real_materials.py [--real FOLDER] [--hop 0.05] [--checks]

The recordings are those of ../shared/realdata/bulk_ramp (for sources see its README): five materials, three recordings
each, of 1 to 4 s. Each recording is left out as a whole in turn (windows of one recording are never on both sides);
features and model are chosen on the others by an inner leave-one-out. Windows last 100 ms. Prints Markdown:

* the accuracy of `cgid train MANIFEST` with either channel and with both: by window, by recording (vote of its
  windows), and by running vote; the 95 % intervals count recordings, not windows;
* each set of features by itself, without selection.

`--checks` separates the material from the set-up; every model is trained on the other recordings, by one set of
features without selection:

* similarity of the ramp in all recordings: the fine structure of their spectra is that of the ramp and the sensor;
* accuracy by material, and without the material that was recorded on another set-up;
* labels shuffled among the recordings: by chance a recording gets the label of the other two of its material, 2 of 14;
* discrimination of recordings of one material, first halves against second: not due to the material;
* a model of the left channel on the right one and back, where the ramp sounds different;
* the cost of a gain or another sensor response, and how much a reference run repairs.
"""

import argparse
import csv
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from cgid.identification.classifier import ImpactClassifier
from cgid.identification.grouped import Lesson, candidates_for, judge
from cgid.identification.labelled_recordings import record
from cgid.identification.manifest import read_manifest
from cgid.identification.metrics import clustered_interval
from cgid.identification.reference import MeanSpectrum
from cgid.identification.rows import Rows, Slicing, sets_for, union_of
from cgid.identification.training import train
from cgid.measure.features import FEATURES, extract_array, supported
from cgid.measure.filters import Equalisation
from cgid.recordings import read_recording
from cgid.validation import Floats

HERE = Path(__file__).parent
REAL = HERE.parents[1] / "shared" / "realdata" / "bulk_ramp"
CHANNELS = {"left": "1", "right": "2", "both": "1+2"}
SETS = sets_for("window")
#: The material that was recorded on another set-up than the others, as `ramps` shows.
APART = "steel_nut_M4"
#: Standard deviation of a sensor's response in each third octave [dB], and the number of such sensors.
DEVIATION, SENSORS = 4.0, 5
GAIN = 2.0  # 6 dB
SHUFFLES = 10
RATE, WINDOW = 44_100.0, 4410
NAMES = supported(union_of(SETS), RATE, WINDOW)
#: Columns of each set in a table of `NAMES`.
COLUMNS = {name: [NAMES.index(one) for one in wanted if one in NAMES] for name, wanted in SETS.items()}
FLAT = np.ones(1)


def recordings(folder: Path) -> list[Path]:
    """Return the files; exit if any is missing."""
    files = sorted(folder.glob("*_[0-9].wav"))
    if not files:
        sys.exit(f"there are no recordings in {folder}; say --real FOLDER")
    return files


def material(file: Path) -> str:
    """Return the material of a recording: its name without the number."""
    return file.stem[:-2]


def measured(files: list[Path], channel: str, hop: float, augment: bool = False) -> Rows:
    """Return the features of the windows of all recordings; if `augment` with noisy copies, as in `cgid train`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "manifest.csv"
        with path.open("w", newline="") as stream:
            rows = csv.writer(stream)
            rows.writerow(["path", "label", "channel"])
            rows.writerows([file.resolve(), material(file), channel] for file in files)
        return record(read_manifest(path), slicing=Slicing(by="window", hop_time=hop), augment=augment)


def share(accuracy: float, interval: tuple[float, float]) -> str:
    """Return a share with its interval."""
    return f"{accuracy:.3f} ({interval[0]:.2f} to {interval[1]:.2f})"


def nested(files: list[Path], hop: float) -> None:
    """Print the results of training with features chosen inside the folds."""
    print("| channel | a window | a recording | votes over 0.5 s | over 1 s | features taken (of 15 folds) |")
    print("|---|---|---|---|---|---|")
    for channel, columns in CHANNELS.items():
        training = train(measured(files, columns, hop, augment=True))
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


# --- material or set-up ---


def titles(first: str, columns: list[str]) -> None:
    """Print the head of a table."""
    print(f"\n| {first} | {' | '.join(columns)} |")
    print("|---" * (len(columns) + 1) + "|")


@cache
def samples_of(file: Path, channel: int = 1) -> Floats:
    """Return one channel."""
    return np.asarray(read_recording(file, channel=channel)[0].samples, np.float64)


def ramps(files: list[Path]) -> None:
    """Print the correlation of the fine structure of the spectra: modes of the ramp and position of the sensor.

    The sliding material shapes a spectrum smoothly; lines common to all recordings are those of the ramp. A material
    whose recordings share other lines was recorded on another set-up, and may be recognised by that.
    """
    levels, labels = [], np.array([material(file) for file in files])
    for file in files:
        frequency, power = signal.welch(samples_of(file), RATE, nperseg=8192, noverlap=6144)
        level = 10 * np.log10(power + 1e-20)
        levels.append((level - ndimage.uniform_filter1d(level, 81))[(frequency > 3000) & (frequency < 8000)])
    likeness = np.corrcoef(levels)
    print("\nCorrelation of the spectra's fine structure, 3 to 8 kHz (the mean over pairs of recordings):")
    different = np.unique(labels)
    titles("", different.tolist())
    for one in different:
        cells = []
        for other in different:
            pairs = np.outer(labels == one, labels == other) & ~np.eye(len(labels), dtype=bool)
            cells.append(f"{likeness[pairs].mean():.2f}")
        print(f"| {one} | {' | '.join(cells)} |")


def materials(table: Rows) -> None:
    """Print the accuracy by material."""
    labels = np.unique(table.labels)
    four = table[table.labels != APART]
    titles("features", [*labels.tolist(), f"four without {APART}"])
    for name, names in SETS.items():
        found = answers(table, names)
        cells = [f"{np.mean(found[table.labels == label] == label):.2f}" for label in labels]
        print(f"| {name} | {' | '.join(cells)} | {np.mean(answers(four, names) == four.labels):.3f} |", flush=True)


def shuffled(table: Rows) -> None:
    """Print the accuracy with labels shuffled among the recordings."""
    _, first = np.unique(table.source, return_index=True)
    random, name = np.random.default_rng(0), next(iter(SETS))
    shares = []
    while len(shares) < SHUFFLES:
        other = replace(table, labels=random.permutation(table.labels[first])[table.source])
        shares.append(np.mean(answers(other, SETS[name]) == other.labels))
    print(f"\nLabels shuffled among the recordings, {name}: {np.mean(shares):.3f}, {SHUFFLES} times (2 / 14 = 0.143)")


def fingerprints(files: list[Path]) -> None:
    """Print the accuracy with which the recordings of one material are discriminated."""
    tables = {file: measured_windows(file) for file in files}
    labels = sorted({material(file) for file in files})
    titles("which of three recordings", [*labels, "mean"])
    for name, columns in COLUMNS.items():
        shares = []
        for label in labels:
            own = [tables[file] for file in files if material(file) == label]
            halves = [(table[: len(table) // 2], table[len(table) // 2 + 1 :]) for table in own]
            first, second = (np.concatenate(parts) for parts in zip(*halves, strict=True))
            numbers = [np.repeat(range(3), [len(half[k]) for half in halves]).astype(str) for k in (0, 1)]
            shares.append(np.mean(fitted(first, numbers[0], columns).predict(second[:, columns]) == numbers[1]))
        print(f"| {name} | {' | '.join(f'{one:.2f}' for one in [*shares, np.mean(shares)])} |", flush=True)


def channels(files: list[Path]) -> None:
    """Print the accuracy of a model of one channel on the other, with and without a reference run."""
    titles("trained on, judged on", list(SETS))
    for trained, judged in ((1, 2), (2, 1)):
        models = models_without(files, trained)
        for cured in (False, True):
            title = f"{trained}, {judged}{', reference run' if cured else ''}"
            row(title, files, models, FLAT, judged, trained if cured else None)


def sensors() -> Iterator[tuple[str, Floats]]:
    """Yield sensor responses as filter taps: a gain, and random ones of 4 dB in each third octave."""
    yield "as trained", np.ones(1)
    yield "6 dB louder", np.full(1, GAIN)
    edges = np.append(0.0, 100 * 2 ** (np.arange(24) / 3))
    edges = np.append(edges[edges < 0.49 * RATE], RATE / 2)
    for seed in range(SENSORS):
        levels = np.random.default_rng(seed).normal(0, DEVIATION, edges.size)
        yield f"response {seed + 1}", signal.firwin2(1023, edges, 10 ** (levels / 20), fs=RATE)


def windows_of(file: Path, taps: Floats, channel: int) -> Floats:
    """Return the windows of a recording after a sensor response, (n_windows, n_samples)."""
    heard = signal.oaconvolve(samples_of(file, channel), taps, mode="same")
    return heard[: heard.size // WINDOW * WINDOW].reshape(-1, WINDOW)


def measured_windows(file: Path, taps: Floats = FLAT, channel: int = 1, made_up: Equalisation | None = None) -> Floats:
    """Return the features of a recording's windows, (n_windows, n_features)."""
    return extract_array(windows_of(file, taps, channel), RATE, NAMES, equalisation=made_up)


def spectrum(files: list[Path], taps: Floats, channel: int) -> Floats:
    """Return the mean spectrum of a reference run that consists of these recordings."""
    run = MeanSpectrum(RATE)
    for file in files:
        run.feed(windows_of(file, taps, channel))
    return run.levels


def fitted(table: Floats, labels: NDArray[np.str_], columns: list[int]) -> ImpactClassifier:
    """Return a linear discriminant of some columns."""
    linear = tuple(np.flatnonzero([FEATURES[NAMES[column]].linear for column in columns]).tolist())
    classifier = ImpactClassifier("linear", linear=linear, calibration_folds=0, rejects=False)
    return classifier.fit(table[:, columns], labels)


def models_without(files: list[Path], channel: int) -> dict[Path, dict[str, ImpactClassifier]]:
    """Return a model of each set for each recording, trained on the others."""
    tables, models = {file: measured_windows(file, channel=channel) for file in files}, {}
    for left_out in files:
        others = [file for file in files if file != left_out]
        table = np.concatenate([tables[file] for file in others])
        labels = np.repeat([material(file) for file in others], [len(tables[file]) for file in others])
        models[left_out] = {name: fitted(table, labels, columns) for name, columns in COLUMNS.items()}
    return models


def row(
    title: str,
    files: list[Path],
    models: dict[Path, dict[str, ImpactClassifier]],
    taps: Floats,
    channel: int,
    meant: int | None,
) -> None:
    """Print the accuracy of each set with a response; a reference run equalises to the channel `meant`."""
    hits: dict[str, list[NDArray[np.bool_]]] = {name: [] for name in COLUMNS}
    for file in files:
        table = measured_windows(file, taps, channel, _made_up(files, file, taps, channel, meant) if meant else None)
        for name, columns in COLUMNS.items():
            hits[name].append(models[file][name].predict(table[:, columns]) == material(file))
    print(f"| {title} | {' | '.join(f'{np.concatenate(one).mean():.3f}' for one in hits.values())} |", flush=True)


def _made_up(files: list[Path], judged: Path, taps: Floats, channel: int, meant: int) -> Equalisation:
    """Return the equalisation by reference runs that exclude the judged recording; each side has its own recordings."""
    number = int(judged.stem[-1])
    heard, own = ([file for file in files if int(file.stem[-1]) == (number + k) % 3 + 1] for k in (0, 1))
    return Equalisation.between(spectrum(heard, taps, channel), spectrum(own, FLAT, meant))


def responses(files: list[Path]) -> None:
    """Print the loss due to a sensor other than that of the training, and the repair by its reference run."""
    models = models_without(files, 1)
    titles("sensor", list(SETS))
    for title, taps in sensors():
        row(title, files, models, taps, 1, None)
        if title.startswith("response"):
            row(f"{title}, reference run", files, models, taps, 1, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=REAL)
    parser.add_argument("--hop", type=float, default=0.05, help="from the start of a window to that of the next [s]")
    parser.add_argument("--checks", action="store_true", help="material or set-up?")
    asked = parser.parse_args()
    files = recordings(asked.real)
    if asked.checks:
        table = measured(files, CHANNELS["left"], asked.hop)
        ramps(files)
        materials(table)
        shuffled(table)
        fingerprints(files)
        channels(files)
        responses(files)
        return
    tables = {name: measured(files, channel, asked.hop) for name, channel in CHANNELS.items()}
    print(f"{len(files)} recordings, {len(tables['left'].labels)} windows of 100 ms every {asked.hop * 1e3:g} ms\n")
    nested(files, asked.hop)
    one_by_one(tables)


if __name__ == "__main__":
    main()
