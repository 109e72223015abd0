"""cgid against other packages: accuracy of coal against gangue, and its cost.

    python benchmarks/identification.py             # tables, benchmarks/identification.csv and .png; 20 to 30 minutes
    python benchmarks/identification.py --reuse     # measures cgid only, against the peers' last answers
    python benchmarks/identification.py --only MiniRocket "aeon catch22"      # these peers only, no files

The peers are tsfresh, tsfel, pycatch22, and of aeon catch22, MiniRocket and Rocket. Their separate environment
(`--environment DIR`) is made if missing, by pip with its configured index; a peer that cannot be installed is left out,
with the reason. Each peer's answers are kept there, so --reuse also continues an interrupted run.
`benchmarks/identification_peers.py` describes the settings of each peer.

Signals are those of the shipped scene "peers" (2048 samples at 200 kHz, 2 % noise). All train on the same 1,500 and
answer the first n of the same 20,000, from other blocks of random numbers; n is what the peer can do in `--seconds`.
The interval is Wilson's for n answers and ignores the variation between training sets, so fast contestants are trained
on ten disjoint sets. Peers receive the whole frame, and 256 samples around the pulse; the first table shows the better
of the two for each (by the test signals, which favours the peer).

Every contestant is a separate process on one thread. Times are processor times; as two processes, and perhaps others,
run at once, compare ratios.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from identification_peers import FRAMES, PEERS, peak_memory, rows, timed

from cgid import __version__
from cgid.files import write_whole
from cgid.identification.classifier import ImpactClassifier
from cgid.identification.rows import Rows, linear_columns, measure
from cgid.identification.share import wilson_interval
from cgid.identification.training import pulse_sets
from cgid.plots import png, require_matplotlib
from cgid.signals import Batch

HERE = Path(__file__).parent
SCENE, SEED = "peers", 0
TRAIN, TEST, SETS = 1500, 20_000, 10
BLOCK = 256  # signals that share random numbers
#: First signals of disjoint ranges: training sets (each in its own blocks), test, unlimited training.
FIRST_TEST, FIRST_UNLIMITED = BLOCK * 10_000, BLOCK * 20_000
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
_CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
ENVIRONMENT = _CACHE / "cgid" / "identification_peers"


class Row(NamedTuple):
    """One contestant on one frame; times in s, memory in MB, `same`: cgid's accuracy on the same signals."""

    name: str
    version: str
    frame: str
    classifier: str
    accuracy: float
    signals: int
    same: float
    features: float
    fit: float
    predict: float
    memory: float
    accuracies: list[float]

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the accuracy."""
        return wilson_interval(self.accuracy, self.signals)


# --- signals ----------------------------------------------------------------------------------------------------------


def synthetic(n: int, first: int) -> Iterator[Batch]:
    """Yield n signals of the scene from `first` on."""
    # Local imports: a contestant that receives stored signals does not need these modules in memory.
    from cgid import shipped
    from cgid.scene import load_scene, synthesise

    return synthesise(load_scene(shipped.scene_path(SCENE)), n, SEED, first=first)


def write_signals(folder: Path) -> str:
    """Write training and test signals for all contestants; return their SHA-256."""
    stride = -(-TRAIN // BLOCK) * BLOCK
    batches = [list(synthetic(TRAIN, number * stride)) for number in range(SETS)]
    test = list(synthetic(TEST, FIRST_TEST))
    arrays = {
        "train": np.stack([np.concatenate([batch.signals for batch in one]) for one in batches]),
        "train_labels": np.stack([np.concatenate([batch.labels for batch in one]) for one in batches]),
        "test": np.concatenate([batch.signals for batch in test]),
        "test_labels": np.concatenate([batch.labels for batch in test]),
    }
    digest = hashlib.sha256()
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", values)
        digest.update(np.ascontiguousarray(values))
    known = {"sampling_rate": test[0].sampling_rate, "unit": test[0].unit, "pre_trigger": test[0].pre_trigger}
    (folder / "known.json").write_text(json.dumps(known))
    return digest.hexdigest()


def stored(folder: Path, kind: str, *place: int) -> Iterator[Batch]:
    """Yield stored signals in batches; the specimen is the number of the signal."""
    known = json.loads((folder / "known.json").read_text())
    labels = rows(folder, f"{kind}_labels", *place)
    for first in range(0, len(labels), BLOCK):
        part = slice(first, min(first + BLOCK, len(labels)))
        numbers = np.arange(part.start, part.stop, dtype=np.uint64)
        yield Batch(signals=rows(folder, kind, *place, part), labels=labels[part], specimen=numbers, **known)


# --- contestants ------------------------------------------------------------------------------------------------------


def learned(known: Rows) -> tuple[tuple[str, ...], ImpactClassifier]:
    """Return the features that `cgid train` would take, and the classifier of these impacts."""
    found = {
        names: ImpactClassifier(linear=linear_columns(names)).fit(known.columns(names), known.labels)
        for names in pulse_sets(len(known.labels))
    }
    return min(found.items(), key=lambda one: one[1].held_out_loss_)


def run_cgid(train_batches: Iterable[Batch], test_batches: Iterable[Batch]) -> dict[str, Any]:
    """Train cgid and return its answers for the test signals, and the time of each step.

    A test signal that cannot be measured has the answer "", which is wrong.
    """
    (names, classifier), fit = timed(learned, measure(train_batches))
    predictions: list[str] = []
    features = predict = 0.0
    for batch in test_batches:
        measured, seconds = timed(measure, [batch])
        answers, more = timed(classifier.predict, measured.columns(names))
        features, predict = features + seconds, predict + more
        found = dict(zip(measured.group.tolist(), answers.tolist(), strict=True))
        predictions += [found.get(number, "") for number in batch.specimen.tolist()]
    n = len(predictions)
    return {"predictions": predictions, "features": features / n, "fit": fit, "predict": predict / n}


def cgid_contest(folder: Path, unlimited: int) -> dict[str, Any]:
    """Return cgid's record: on the training sets, or on `unlimited` other synthetic signals."""
    truth = rows(folder, "test_labels")
    sources = [partial(stored, folder, "train", number) for number in range(SETS)]
    if unlimited:
        sources = [partial(synthetic, unlimited, FIRST_UNLIMITED)]
    run_cgid(stored(folder, "train", 0), [next(stored(folder, "test"))])  # triggers the lazy imports
    found = [run_cgid(source(), stored(folder, "test")) for source in sources]
    return {
        "name": f"cgid, {unlimited} to train" if unlimited else "cgid",
        "version": f"cgid {__version__}",
        "frame": "whole",
        "classifier": ImpactClassifier().family,
        **found[0],
        "accuracies": [float(np.mean(np.array(one["predictions"]) == truth)) for one in found],
        "memory": peak_memory(),
    }


def run_process(command: list[str | Path], answer: Path) -> dict[str, Any]:
    """Return the record that a contestant's process writes, or the failure as {"error"}."""
    done = subprocess.run(command, env=os.environ | ONE_THREAD, capture_output=True, text=True, check=False)
    if done.returncode or not answer.exists():
        return {"error": (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]}
    return json.loads(answer.read_text())


def cgid_process(folder: Path, unlimited: int) -> dict[str, Any]:
    """Return cgid's record, from a separate process."""
    answer = folder / f"cgid-{unlimited}.json"
    command = [sys.executable, __file__, "--cgid", folder, answer, "--unlimited", str(unlimited)]
    return run_process(command, answer)


def peer_process(environment: Path, folder: Path, digest: str, seconds: float, key: tuple[str, str]) -> dict[str, Any]:
    """Return the record of a peer on a frame, from a process in the peers' environment, and keep it."""
    name, frame = key
    answer = folder / f"{name}-{frame}.json"
    program = [environment / "bin" / "python", "-E", "-W", "ignore", HERE / "identification_peers.py"]
    options = [name, frame, folder, answer, "--seconds", f"{seconds:g}", "--most", str(TEST), "--sets", str(SETS)]
    record = run_process([*program, *options], answer)
    print(f"{name}, {frame}: {record.get('error', 'done')}", file=sys.stderr, flush=True)
    if "error" not in record:
        path = kept(environment, *key)
        path.parent.mkdir(exist_ok=True)
        write_whole(path, json.dumps(record | {"signals": digest}).encode())
    return record


# --- the peers' environment -------------------------------------------------------------------------------------------


def install(environment: Path, packages: Iterable[str]) -> dict[str, str]:
    """Make the environment and install what is missing; return the reason for each failure."""
    python = environment / "bin" / "python"
    if not python.exists():
        venv.create(environment, with_pip=True)
    problems = {}
    for package in packages:
        if subprocess.run([python, "-E", "-c", f"import {package}"], capture_output=True, check=False).returncode == 0:
            continue
        command = [python, "-m", "pip", "install", "--quiet", package]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if "error" in line.lower()]
            problems[package] = (errors or ["pip failed"])[-1]
    return problems


def kept(environment: Path, name: str, frame: str) -> Path:
    """Return the path of a peer's last record."""
    return environment / "answers" / f"{name}-{frame}.json"


def remembered(environment: Path, digest: str, wanted: list[tuple[str, str]]) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the kept records of these signals."""
    paths = {key: kept(environment, *key) for key in wanted}
    records = {key: json.loads(path.read_text()) for key, path in paths.items() if path.exists()}
    return {key: record for key, record in records.items() if record["signals"] == digest}


def peers_records(
    folder: Path, digest: str, names: list[str], options: argparse.Namespace
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the records of the peers on both frames, kept ones if requested; print the peers left out."""
    wanted = [(name, frame) for name in names for frame in FRAMES]
    records = remembered(options.environment, digest, wanted) if options.reuse else {}
    missing = [key for key in wanted if key not in records]
    problems = install(options.environment, {PEERS[name].package: None for name, _ in missing}) if missing else {}
    for name in dict.fromkeys(name for name, _ in missing if PEERS[name].package in problems):
        print(f"Left out, {PEERS[name].package} cannot be installed: {name} ({problems[PEERS[name].package]}).")
    missing = [key for key in missing if PEERS[key[0]].package not in problems]
    with ThreadPoolExecutor(options.jobs) as pool:
        run = partial(peer_process, options.environment, folder, digest, options.seconds)
        records |= dict(zip(missing, pool.map(run, missing), strict=True))
    for key in missing:
        if "error" in records[key]:
            print(f"Left out, failed: {', '.join(key)} ({records.pop(key)['error']}).")
    return {key: records[key] for key in wanted if key in records}


# --- results ----------------------------------------------------------------------------------------------------------


def row(record: dict[str, Any], truth: np.ndarray, ours: np.ndarray) -> Row:
    """Return the row of a record; `ours` are cgid's answers."""
    n = len(record["predictions"])
    accuracy = float(np.mean(np.array(record["predictions"]) == truth[:n]))
    same = float(np.mean(ours[:n] == truth[:n]))
    details = {name: record[name] for name in Row._fields if name not in ("accuracy", "signals", "same")}
    return Row(accuracy=accuracy, signals=n, same=same, **details)


def better_frames(peers: list[Row]) -> tuple[list[Row], list[Row]]:
    """Return each peer on its better frame, best first, and the others."""
    best = {r.name: r for r in sorted(peers, key=lambda r: r.accuracy)}
    order = sorted(best.values(), key=lambda r: -r.accuracy)
    return order, [r for first in order for r in peers if r.name == first.name and r is not first]


def table(found: list[Row], ours: Row) -> str:
    """Return rows as Markdown; times of features also as multiples of cgid's."""
    heads = ["", "frame", "classifier", "accuracy", "95 % interval", "signals", "cgid on the same", "mean of ten"]
    heads += ["features a signal [ms]", "times cgid's", "fit [s]", "answer a signal [us]", "memory [MB]"]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for r in found:
        low, high = r.interval
        ten = f"{np.mean(r.accuracies):.4f}" if len(r.accuracies) == SETS else "-"
        cells = [r.name, r.frame, r.classifier, f"{r.accuracy:.4f}", f"{low:.4f} to {high:.4f}", str(r.signals)]
        cells += [f"{r.same:.4f}", ten, f"{r.features * 1e3:.3g}", f"{r.features / ours.features:.3g}"]
        cells += [f"{r.fit:.2g}", f"{r.predict * 1e6:.2g}", f"{r.memory:.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def spread(found: list[Row]) -> str:
    """Return the spread of the accuracies over the training sets."""
    lines = [
        f"{r.name} ({r.frame}): {min(r.accuracies):.4f} to {max(r.accuracies):.4f}"
        for r in found
        if len(r.accuracies) == SETS
    ]
    return f"Lowest and highest of {SETS} training sets: " + "; ".join(lines) + "."


def table_csv(found: list[Row]) -> bytes:
    """Return every row, times in SI units."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    heads = ["name", "version", "frame", "classifier", "accuracy", "interval low", "interval high", "test signals"]
    heads += ["cgid on the same", "features a signal [s]", "fit [s]", "answer a signal [s]", "peak memory [MB]"]
    writer.writerow([*heads, "training sets", "mean accuracy", "lowest", "highest"])
    for r in found:
        judged = [f"{value:.4f}" for value in (r.accuracy, *r.interval)]
        spent = [f"{value:.4g}" for value in (r.features, r.fit, r.predict, r.memory)]
        over = [f"{value:.4f}" for value in (np.mean(r.accuracies), min(r.accuracies), max(r.accuracies))]
        who = [r.name, r.version, r.frame, r.classifier]
        writer.writerow([*who, *judged, r.signals, f"{r.same:.4f}", *spent, len(r.accuracies), *over])
    return stream.getvalue().encode()


def picture(ours: list[Row], best: list[Row], others: list[Row]) -> bytes:
    """Draw accuracy against time per signal (features and answer); the worse frame of a peer is hollow."""
    figure = require_matplotlib()(figsize=(7.5, 5), layout="constrained")
    axes = figure.subplots()
    colours = {r.name: f"C{k}" for k, r in enumerate(best)} | {r.name: "k" for r in ours}
    for r in [*ours, *best, *others]:
        low, high = r.interval
        shape = "*" if r in ours else "o" if r.frame == "pulse" else "s"
        axes.errorbar(
            (r.features + r.predict) * 1e3,
            r.accuracy,
            [[r.accuracy - low], [high - r.accuracy]],
            fmt=shape,
            color=colours[r.name],
            markersize=12 if shape == "*" else 6,
            markerfacecolor="none" if r in others or "," in r.name else colours[r.name],
            linewidth=1,
            capsize=2,
            label=r.name if r not in others else None,
        )
    axes.set_xscale("log")
    axes.set(xlabel="features and answer, ms a signal, one thread", ylabel="accuracy, 95 % interval")
    title = f"{TRAIN} signals to train; circles: 256 samples around the pulse, squares: all 2048; hollow: the worse"
    axes.set_title(title, fontsize=9)
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(fontsize=8)
    return png(figure)


def compare(folder: Path, options: argparse.Namespace) -> tuple[list[Row], list[Row], list[Row]]:
    """Return the rows of cgid, of the peers on their better frame, and on the other."""
    digest = write_signals(folder)
    names = [name for name in PEERS if not options.only or name in options.only]
    peers = peers_records(folder, digest, names, options)
    own = [cgid_process(folder, 0), *([cgid_process(folder, options.unlimited)] if options.unlimited else [])]
    for record in own:
        if "error" in record:
            raise SystemExit(f"cgid failed: {record['error']}")
    truth, ours = rows(folder, "test_labels"), np.array(own[0]["predictions"])
    best, others = better_frames([row(record, truth, ours) for record in peers.values()])
    return [row(record, truth, ours) for record in own], best, others


def main() -> None:
    """Print the tables, write CSV and picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--environment", type=Path, default=ENVIRONMENT, metavar="DIR")
    parser.add_argument("--reuse", action="store_true", help="peers' kept answers where they are of the same signals")
    parser.add_argument("--seconds", type=float, default=120.0, help="of the processor for a peer's test signals")
    parser.add_argument("--unlimited", type=int, default=100_000, help="signals of a second training of cgid; 0: none")
    parser.add_argument("--only", nargs="+", choices=PEERS, metavar="PEER", help=f"of {', '.join(PEERS)}; no files")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="peers at once")
    parser.add_argument("--cgid", nargs=2, type=Path, metavar=("FOLDER", "ANSWER"), help="for its own process")
    options = parser.parse_args()
    if options.cgid:
        folder, answer = options.cgid
        answer.write_text(json.dumps(cgid_contest(folder, options.unlimited)))
        return
    options.environment = options.environment.expanduser().absolute()
    with tempfile.TemporaryDirectory() as folder:
        ours, best, others = compare(Path(folder), options)
    print(f"\nScene `{SCENE}`, {TRAIN} signals to train; processor times on one thread: ratios count, not figures.\n")
    print(f"{table([*ours, *best], ours[0])}\n\nThe same peers on the other frame:\n\n{table(others, ours[0])}\n")
    print(spread([*ours, *best, *others]))
    if not options.only:
        write_whole(HERE / "identification.csv", table_csv([*ours, *best, *others]))
        write_whole(HERE / "identification.png", picture(ours, best, others))


if __name__ == "__main__":
    main()
