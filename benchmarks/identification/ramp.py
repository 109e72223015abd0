"""Honest models of few recordings: train on two recordings of each material, judge on the third, three times.

    python benchmarks/identification/ramp.py [--real FOLDER] [--channel 1] [--seed 0]

The recordings are those of ../shared/realdata/bulk_ramp: five materials on a ramp, three recordings each. `cgid train`
and `cgid predict` run as a user runs them; a recording is judged as it is, and with white noise of a hundredth and a
tenth of its power. Prints Markdown, for each fold:

* the share of windows that are answered, and of these the share that is right, the confidence (mean probability of the
  answer) and the expected calibration error over ten bins; the same for votes of 0.5 s;
* the recordings whose mean log-probability is right;
* a peer: mean and deviation of 64 log-mel bands over frames of 23 ms, and linear discriminants with a shrunken
  covariance (scikit-learn). It answers every window; `same` is its accuracy on the windows that the model answers.
"""

import argparse
import csv
import io
import json
import sys
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.io import wavfile
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from cgid.cli.main import run
from cgid.identification.training.metrics import reliability
from cgid.recordings import read_recording

REAL = Path(__file__).parents[3] / "shared" / "realdata" / "bulk_ramp"
RATE, WINDOW, HOP = 44_100, 4410, 2205
#: Power of a recording over that of the added white noise [dB].
NOISES = (None, 20.0, 10.0)
N_MELS, FRAME, STEP = 64, 1024, 512


def material(file: Path) -> str:
    return file.stem[:-2]


def command(*arguments: str) -> str:
    """Run a command of cgid and return its stdout; exit with its message where it fails."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(list(arguments))
    if code:
        sys.exit(err.getvalue())
    return out.getvalue()


def noisy(samples: NDArray[np.float64], noise: float | None, seed: int) -> NDArray[np.float32]:
    if noise is None:
        return samples.astype(np.float32)
    deviation = np.sqrt(np.mean(samples**2) * 10 ** (-noise / 10))
    return (samples + np.random.default_rng(seed).normal(0, deviation, samples.size)).astype(np.float32)


# -- the peer -----------------------------------------------------------------------------------------------


def mel_filters() -> NDArray[np.float64]:
    """Return triangular filters even in mel, (n_mels, n_bins) (O'Shaughnessy 1987)."""
    corners = 700 * (10 ** (np.linspace(0, 2595 * np.log10(1 + RATE / 1400), N_MELS + 2) / 2595) - 1)
    low, middle, high = corners[:-2, None], corners[1:-1, None], corners[2:, None]
    bins = np.fft.rfftfreq(FRAME, 1 / RATE)[None]
    return np.asarray(np.maximum(0, np.minimum((bins - low) / (middle - low), (high - bins) / (high - middle))))


def log_mel(samples: NDArray[Any]) -> NDArray[np.float64]:
    """Return mean and deviation of the log-mel bands over the frames of each window, (n_windows, 2 n_mels)."""
    windows = np.lib.stride_tricks.sliding_window_view(samples.astype(np.float64), WINDOW)[::HOP]
    frames = np.lib.stride_tricks.sliding_window_view(windows, FRAME, axis=1)[:, ::STEP]
    power = np.abs(np.fft.rfft(frames * signal.get_window("hann", FRAME))) ** 2 @ mel_filters().T
    levels = np.log(np.maximum(power, 1e-10 * power.max()))
    return np.hstack([levels.mean(axis=1), levels.std(axis=1)])


# -- judging ------------------------------------------------------------------------------------------------


class Told(NamedTuple):
    """Answers for windows: label, probability of the label and whether it is right."""

    known: NDArray[np.bool_]
    confidence: NDArray[np.float64]
    right: NDArray[np.bool_]

    def cells(self) -> list[str]:
        """Return shares answered and right, confidence and calibration error of the answered."""
        own, n = self.known, max(int(self.known.sum()), 1)
        bins = reliability(self.confidence[own], self.right[own])
        error = sum(count * abs(sure - right) for sure, right, count in bins) / n
        told = (self.right[own].mean(), self.confidence[own].mean(), error) if own.any() else (np.nan,) * 3
        return [f"{own.mean():.2f}", *(f"{value:.3f}" for value in told)]


def answers(file: Path, model: Path, vote: float) -> list[dict[str, Any]]:
    lines = command("predict", str(file), "--model", str(model), "--set", f"vote={vote:g}", "--json").splitlines()
    return [line for line in map(json.loads, lines) if line["kind"] == "window"]


def told(rows: list[dict[str, Any]], truth: str) -> Told:
    return Told(
        np.array([row["label"] != "unknown" for row in rows]),
        np.array([max(row["probabilities"].values(), default=0.0) for row in rows]),
        np.array([row["most_likely"] == truth for row in rows]),
    )


def joined(parts: list[Told]) -> Told:
    return Told(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def is_voted(rows: list[dict[str, Any]], truth: str) -> str:
    known = [row["probabilities"] for row in rows if row["label"] != "unknown"]
    if not known:
        return "open"
    sums = {label: sum(np.log(max(one[label], 1e-6)) for one in known) for label in known[0]}
    return "right" if max(sums, key=lambda label: sums[label]) == truth else "wrong"


def fold(files: list[Path], number: str, channel: int, seed: int, folder: Path) -> Iterator[list[str]]:
    """Yield a row of the table for each noise, for the recordings of one number."""
    samples = {file: np.asarray(read_recording(file, channel=channel)[0].samples, np.float64) for file in files}
    training = [file for file in files if file.stem[-1] != number]
    with (folder / "m.csv").open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["path", "label", "channel"])
        rows.writerows([file.resolve(), material(file), channel] for file in training)
    model = folder / "m.npz"
    said = json.loads(command("train", str(folder / "m.csv"), "-o", str(model), "--overwrite", "--json"))
    low, high = said["accuracy_interval_95"]
    print(f"fold {number}: promised {said['accuracy']:.3f} ({low:.2f} to {high:.2f})", file=sys.stderr)
    peer = make_pipeline(StandardScaler(), LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"))
    tables = [log_mel(samples[file]) for file in training]
    peer.fit(np.concatenate(tables), np.repeat([material(file) for file in training], [len(own) for own in tables]))
    for noise in NOISES:
        single, votes, voted, others = [], [], [], []
        for k, file in enumerate(file for file in files if file not in training):
            heard = noisy(samples[file], noise, seed + k)
            wavfile.write(folder / "heard.wav", RATE, heard)
            rows_alone = answers(folder / "heard.wav", model, 0.0)
            single.append(told(rows_alone, material(file)))
            votes.append(told(answers(folder / "heard.wav", model, 0.5), material(file)))
            voted.append(is_voted(rows_alone, material(file)))
            others.append(peer.predict(log_mel(heard)) == material(file))
        alone, beside = joined(single), np.concatenate(others)
        same = beside[alone.known].mean() if alone.known.any() else np.nan
        tally = f"{voted.count('right')} of {len(voted)}" + f", {voted.count('open')} open" * ("open" in voted)
        yield [
            number,
            "none" if noise is None else f"{noise:g} dB",
            *alone.cells(),
            f"{alone.right.mean():.3f}",
            f"{beside.mean():.3f}",
            f"{same:.3f}",
            *joined(votes).cells(),
            tally,
        ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=REAL)
    parser.add_argument("--channel", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    asked = parser.parse_args()
    files = sorted(asked.real.glob("*_[123].wav"))
    if not files:
        print(f"skipped: there are no recordings in {asked.real}; say --real FOLDER")
        return
    titles = (
        "fold, noise, answered, right, sure, error, right of all, peer, peer same, votes answered, right, sure, error"
    )
    print(f"| {' | '.join([*titles.split(', '), 'recordings'])} |")
    print("|---" * 14 + "|")
    with tempfile.TemporaryDirectory() as folder:
        for number in "123":
            for cells in fold(files, number, asked.channel, asked.seed, Path(folder)):
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
