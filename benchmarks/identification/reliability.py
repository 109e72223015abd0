"""Reliability of a model: calibration, coverage and detection of strangers on many unseen impacts.

    # prints Markdown; the shipped default model if none is given
    python benchmarks/identification/reliability.py [MODEL] [-n 100000]

Impacts are of the reference scene, from blocks of random numbers that no training uses. Strangers are of the shipped
scenes `strangers` and `lookalikes`; real ones are the shocks of ../shared/realdata, if present (assuming an impactor of
1 kg). Flagged are impacts outside the training range: strange, overdriven, or impossible to measure.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import identify, identify_frames, suited
from cgid.identification.training.card import table
from cgid.identification.training.metrics import evaluate
from cgid.measure.features.extraction import extract_array
from cgid.recordings import read_recording
from cgid.scene import load_scene, synthesise

SEED = 3_000_003
SHOCKS = Path(__file__).parents[3] / "shared" / "realdata" / "shock"


def judged(model: StoredModel, n: int) -> None:
    labels, probabilities = [], []
    for batch in synthesise(load_scene(shipped.scene_path("reference")), n, SEED):
        features = extract_array(
            batch.signals, batch.sampling_rate, model.features, pre_trigger=batch.pre_trigger, invalid="nan"
        )
        sound = np.isfinite(features).all(axis=1)
        labels.append(batch.labels[sound])
        probabilities.append(model.probabilities(features[sound]))
    truth, p = np.concatenate(labels), np.concatenate(probabilities)
    m = evaluate(truth, p, model.labels)
    print(f"{len(truth)} of {n} impacts of the reference scene measured: accuracy {m['accuracy']:.4f}, ", end="")
    print(f"Brier {m['brier_score']:.4f}, expected calibration error {m['expected_calibration_error']:.4f}.\n")
    print(
        "\n".join(
            table(
                ("probability said", "right", "impacts"), [(f"{c:.3f}", f"{a:.3f}", k) for c, a, k in m["reliability"]]
            )
        )
    )
    rows = []
    for coverage in (0.8, 0.9, 0.95):
        held = model.prediction_set(p, coverage)
        single = held.sum(axis=1) == 1
        right = held[truth[:, None] == np.array(model.labels)]
        answered = np.array(model.labels)[held[single].argmax(axis=1)] == truth[single]
        shares = (right.mean(), *(right[truth == label].mean() for label in model.labels), single.mean())
        rows.append((coverage, *(f"{share:.4f}" for share in (*shares, answered.mean()))))
    titles = (
        "asked",
        "covered",
        *(f"of {label}" for label in model.labels),
        "single label",
        "accuracy of single",
    )
    print("\n" + "\n".join(table(titles, rows)) + "\n")


def strangers(model: StoredModel, n: int) -> None:
    rows = []
    for scene in ("reference", "strangers", "lookalikes"):
        answers = defaultdict(list)
        for batch in synthesise(load_scene(shipped.scene_path(scene)), n, SEED + 1):
            found = identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger)
            for answer, label in zip(found, batch.labels.tolist(), strict=True):
                answers[label].append(answer)
        for label, found in sorted(answers.items()):
            gangue = [a.probabilities["gangue"] for a in found if a.probabilities]
            rows.append(
                (
                    scene,
                    label,
                    len(found),
                    f"{np.mean([not a.in_training_range for a in found]):.2%}",
                    f"{np.mean(gangue):.3f}",
                )
            )
    for path in sorted(SHOCKS.glob("*.txt")):
        for signal in read_recording(str(path)):
            found = identify(suited(signal, model, mass=1.0), model)
            flagged = np.mean([not a.in_training_range for a in found])
            rows.append(("shared/realdata", path.name, len(found), f"{flagged:.2%}", "-"))
    print("\n".join(table(("scene", "label", "impacts", "flagged", "mean probability of gangue"), rows)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default=shipped.path_of("models", shipped.DEFAULT_MODEL))
    parser.add_argument("-n", "--signals", type=int, default=100_000)
    arguments = parser.parse_args()
    model = StoredModel.load(arguments.model)
    judged(model, arguments.signals)
    strangers(model, max(arguments.signals // 5, 256))


if __name__ == "__main__":
    main()
