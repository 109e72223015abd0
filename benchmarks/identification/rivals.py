"""cgid against learners of another kind, on several scenes, with up to 150,000 signals to train.

    python benchmarks/identification/rivals.py reference peers dull tail_beam    # 1,500 and 15,000 to train
    python benchmarks/identification/rivals.py dull --sizes 1500 15000 150000 --only LightGBM "1-D CNN"
    PYTHONPATH=. python benchmarks/identification/rivals.py --open sets --only LightGBM      # LightGBM-frames.csv

Boosters (LightGBM, CatBoost) learn from cgid's features; a convolutional network, InceptionTime and MultiRocket-HYDRA
from the pulse, `peers.py` says how. "dull" is rock of low restitution, as in `rock.py`. All train on the
first of the same signals, and answer others, from other blocks of random numbers. Intervals are Wilson's. Differences
are paired, from cgid's logistic regression on as many signals; a shipped model answers as it is.

--open enters the open benchmark (`benchmarks/open`) as anybody would: a rival learns from the frames of each training
part (or of those of SCENE alone), and answers the test parts, resampled to the rate of the training, with
probabilities; nothing is unknown. MultiRocket-HYDRA says 0 or 1.

Rivals live in an environment of their own (`--environment DIR`), made if missing, by pip with its configured index; one
that cannot be installed is left out, with the reason. It also keeps signals, features and answers, for --reuse. Each
rival is a separate process on one thread. Times are processor times of a busy machine: compare ratios.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import venv
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import resample_poly
from threadpoolctl import threadpool_limits

from benchmarks.identification.peers import RIVALS, rows, timed
from benchmarks.identification.rock import limits
from cgid import shipped
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.model.confusion import wilson_interval
from cgid.identification.model.model import StoredModel
from cgid.identification.training import ImpactClassifier
from cgid.identification.training.rows import BEAM_FEATURES, BEAM_GUARDS, DEFAULT_FEATURES, DEFAULT_GUARDS
from cgid.measure.features import extraction as known
from cgid.measure.features.extraction import extract_array
from cgid.scene import load_scene, synthesise
from cgid.scene.synthesis.through_beam import beam_of

HERE, SEED = Path(__file__).parent, 0
#: First of the test signals; 256 signals share random numbers.
FIRST_TEST = 256 * 10_000
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
ENVIRONMENT = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "cgid" / "identification_peers"
#: Samples that rivals receive of each scene: the pulse, or the first 20 ms of what a beam does.
CUTS = {
    "reference": slice(188, 444),
    "peers": slice(88, 344),
    "dull": slice(188, 444),
    "tail_beam": slice(116, 628),
}


def measured_by(beam: ThroughBeam | None, signals: np.ndarray, rate: float, trigger: int) -> np.ndarray:
    features = (*BEAM_FEATURES, *BEAM_GUARDS) if beam else (*DEFAULT_FEATURES, *DEFAULT_GUARDS)
    return extract_array(signals, rate, features, pre_trigger=trigger, invalid="nan", beam=beam)


def beam_in(name: str) -> ThroughBeam | None:
    return ThroughBeam(beam_of(load_scene(shipped.scene_path(name)))) if name == "tail_beam" else None


def write_rivals(folder: Path, name: str, n_train: int, n_test: int) -> float:
    """Write pulses, features and labels of a scene; return the time that cgid measures a signal for [s]."""
    scene = limits()[name] if name == "dull" else load_scene(shipped.scene_path(name))
    beam, spent = beam_in(name), 0.0
    for kind, n, first in (("train", n_train, 0), ("test", n_test, FIRST_TEST)):
        found = []
        for batch in synthesise(scene, n, SEED, first=first):
            measured, seconds = timed(measured_by, beam, batch.signals, batch.sampling_rate, batch.pre_trigger)
            spent += seconds
            found.append((batch.signals[:, CUTS[name]].astype(np.float32), measured, batch.labels))
        for suffix, column in zip(("", "_features", "_labels"), zip(*found, strict=True), strict=True):
            whole = np.concatenate(column)
            np.save(folder / f"{kind}{suffix}.npy", whole)
    return spent / (n_train + n_test)


def enter_open(options: argparse.Namespace) -> Iterator[str]:
    """Write the predictions of rivals for the open benchmark; yield their files and what they took."""
    from benchmarks.open.entries import parts_of, write_predictions
    from benchmarks.open.judge import Frames, Truth

    signals = options.open / "signals"
    labels, test = Truth.read(signals).frames, parts_of(signals, "test").values()
    for name in options.only or RIVALS:
        found = {}
        for learn, part in parts_of(signals, "train").items():
            if part.is_stream or (options.scenes and learn not in options.scenes):
                continue
            asked = [one for one in test if one.learn == learn and not one.is_stream]
            folder = options.environment / "rivals" / f"open-{learn}"
            if not (folder / "train_labels.npy").exists():
                write_open(folder, learn, part.rate, {"train": [part], "test": asked}, labels[learn])
            record = rival_process(options, folder, name, len(labels[learn]), "--probabilities")
            if "error" in record:
                yield f"Left out, failed: {name}, {learn} ({record['error']})."
                continue
            curve = np.round(record["curve"], 3).tolist()
            yield f"{name}, {learn}: {record['fit']:.2g} s to fit, held-out loss by epoch {curve}"
            ends = np.cumsum([len(one.signals) for one in asked])[:-1]
            for one, own in zip(asked, np.split(np.array(record["probabilities"]), ends), strict=True):
                found[one.name] = Frames(own, np.zeros(len(own), bool))
        yield from map(str, write_predictions(found, Path(), name.replace(" ", "-")))


def write_open(folder: Path, learn: str, rate: float, parts: dict[str, list[Any]], labels: np.ndarray) -> None:
    """Write pulses at one rate, features and labels of a training part and of those that are answered from it."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind, own in parts.items():
        pulses, features = [], []
        for part in own:
            ratio = Fraction(rate / part.rate).limit_denominator(100)
            signals = resample_poly(part.signals, ratio.numerator, ratio.denominator, axis=1)
            pulses.append(signals[:, CUTS[learn]].astype(np.float32))  # their pre-triggers last equally long
            for some in np.array_split(part.signals, -(-len(part.signals) // 500)):
                features.append(measured_by(beam_in(learn), np.array(some), part.rate, part.trigger))
        for suffix, column in (("", pulses), ("_features", features)):
            whole = np.concatenate(column)
            np.save(folder / f"{kind}{suffix}.npy", whole)
    np.save(folder / "train_labels.npy", labels)


def own_rivals(folder: Path, scene: str, size: int) -> Iterator[dict[str, Any]]:
    """Yield cgid's records: families trained on features of `size` signals, and the shipped model (`size` 0)."""
    names = BEAM_FEATURES if scene == "tail_beam" else DEFAULT_FEATURES
    own = slice(len(names))  # without the guards, which boosters may use
    x = rows(folder, "test_features")[:, own]
    measured = np.isfinite(x).all(axis=1)
    if not size:
        model = StoredModel.load(shipped.model_path("default-acceleration" if scene == "tail_beam" else "default"))
        proba, seconds = timed(model.probabilities, x[measured])
        found = {"cgid as shipped": (np.array(model.labels)[proba.argmax(1)], 0.0, seconds)}
    else:
        table, labels = (rows(folder, f"train_{kind}", slice(size)) for kind in ("features", "labels"))
        sound = np.isfinite(table).all(axis=1)
        linear = tuple(k for k, name in enumerate(names) if known.FEATURES[name].unit == "1")
        found = {}
        for family in ("logistic", "network"):
            learner = ImpactClassifier(family, linear=linear, rejects=False)
            classifier, fit = timed(learner.fit, table[sound, own], labels[sound])
            answers, seconds = timed(classifier.predict, x[measured])
            found[f"cgid, {family}"] = (answers, fit, seconds)
    for name, (answers, fit, seconds) in found.items():
        predictions = np.full(len(x), "", dtype="U16")
        predictions[measured] = answers
        yield {"name": name, "predictions": predictions.tolist(), "fit": fit, "predict": seconds / len(x)}


def rivals(scene: str, options: argparse.Namespace) -> Iterator[str]:
    """Yield the table of a scene, line by line."""
    folder = options.environment / "rivals" / f"{scene}-{max(options.sizes)}-{options.test}"
    if not (folder / "time.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        seconds = write_rivals(folder, scene, max(options.sizes), options.test)
        (folder / "time.json").write_text(json.dumps(seconds))
    features = json.loads((folder / "time.json").read_text())
    names = [name for name in RIVALS if not options.only or name in options.only]
    problems = install(options.environment, {RIVALS[name].package: None for name in names})
    truth = rows(folder, "test_labels")
    heads = "scene", "to train", "", "accuracy", "95 % interval", "better than the first by", "signals", "fit [s]"
    yield f"| {' | '.join(heads)} | ms a signal |\n|{'---|' * (len(heads) + 1)}"
    for size in (0, *options.sizes):
        with threadpool_limits(1):
            records = list(own_rivals(folder, scene, size))
        ours = np.array(records[0]["predictions"]) == truth
        for record in records:
            yield line_of(scene, size, record | {"features": features}, truth, ours)
        for name in names if size else ():
            if name in problems:
                yield f"Left out, {RIVALS[name].package} cannot be installed: {name} ({problems[name]})."
            elif size <= RIVALS[name].most:
                record = rival_process(options, folder, name, size)
                if RIVALS[name].on_features and "error" not in record:
                    record["features"] += features
                yield line_of(scene, size, record, truth, ours)


def rival_process(options: argparse.Namespace, folder: Path, name: str, size: int, *more: str) -> dict[str, Any]:
    """Return the record of a rival that learns from `size` signals, from a process in the peers' environment."""
    answer = folder / f"{name}-{size}{f'-{options.epochs}' * bool(options.epochs)}.json"
    if options.reuse and answer.exists():
        return json.loads(answer.read_text())
    program = [options.environment / "bin" / "python", "-E", "-W", "ignore", HERE / "peers.py"]
    command = [*program, name, folder, answer, "--to-train", str(size), "--most", str(options.test), *more]
    command += ["--epochs", str(options.epochs)]
    done = subprocess.run(command, env=os.environ | ONE_THREAD, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"name": name, "error": (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]}
    return {"features": 0.0, **json.loads(answer.read_text())}


def install(environment: Path, packages: Iterable[str]) -> dict[str, str]:
    """Make the environment and install what is missing; return the reason for each failure."""
    python = environment / "bin" / "python"
    if not python.exists():
        venv.create(environment, with_pip=True)
    problems = {}
    for package in packages:
        if subprocess.run([python, "-E", "-c", f"import sklearn, {package}"], capture_output=True).returncode:
            command = [python, "-m", "pip", "install", "--quiet", "scikit-learn", package]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                problems[package] = (done.stderr.strip().splitlines() or ["pip failed"])[-1]
    return problems


def line_of(scene: str, size: int, record: dict[str, Any], truth: np.ndarray, ours: np.ndarray) -> str:
    """Return a line of the table of rivals; `ours`: where cgid's logistic regression on as many signals is right."""
    if "error" in record:
        return f"Left out, failed: {record['name']}, {size} to train ({record['error']})."
    n = len(record["predictions"])
    right = np.array(record["predictions"]) == truth[:n]
    low, high = wilson_interval(float(right.mean()), n)
    better = right.astype(float) - ours[:n]
    paired = f"{better.mean():+.4f} ± {1.96 * better.std() / n**0.5:.4f}"
    cells = [scene, str(size or "-"), record["name"], f"{right.mean():.4f}", f"{low:.4f} to {high:.4f}", paired, str(n)]
    cells += [f"{record['fit']:.2g}" if size else "-", f"{(record['features'] + record['predict']) * 1e3:.3g}"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(CUTS)}")
    parser.add_argument("--open", type=Path, metavar="SETS", help="write predictions for the open benchmark, here")
    parser.add_argument("--sizes", type=int, nargs="+", default=(1500, 15_000), help="signals to train")
    parser.add_argument("--test", type=int, default=10_000, help="signals to answer")
    parser.add_argument("--only", nargs="+", choices=RIVALS, metavar="RIVAL", help=f"of {', '.join(RIVALS)}")
    parser.add_argument("--epochs", type=int, default=0, help="of networks; default: 40 of 1,500, fewer of more")
    parser.add_argument("--environment", type=Path, default=ENVIRONMENT, metavar="DIR")
    parser.add_argument("--reuse", action="store_true", help="rivals' kept answers")
    options = parser.parse_args()
    options.environment = options.environment.expanduser().absolute()
    if unknown := set(options.scenes) - set(CUTS):
        parser.error(f"SCENE must be of {', '.join(CUTS)}, got {min(unknown)}")
    tables = [enter_open(options)] if options.open else (rivals(scene, options) for scene in options.scenes)
    for line in chain.from_iterable(tables):
        print(line, flush=True)


if __name__ == "__main__":
    main()
