"""Performance of a model on impacts unlike its training: another rig, another seam, another theory, strangers.

python models/domain_shift.py [MODEL] [-n 5120]   # prints Markdown; the shipped default model if none is given
"""

import argparse
import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import identify_frames
from cgid.identification.training.card import plain, table
from cgid.identification.training.metrics import evaluate
from cgid.scene import Scene, load_scene, parse_scene, synthesise, varied

#: No training uses it.
SEED = 2_000_003


def shifted_scenes() -> Iterator[tuple[str, Scene]]:
    """Yield names and scenes to judge on."""
    reference = load_scene(shipped.scene_path("reference"))
    yield "the reference scene", reference
    yield from laws_and_shapes()
    yield "corners, faces and breaking rock (scene corners)", load_scene(shipped.scene_path("corners"))
    for rate in ("1 MHz", "100 kHz", "50 kHz", "20 kHz"):
        yield f"... sampled at {rate}", varied(reference, sampling_rate=rate, keep_frame=True)
    for noise in (0.0001, 0.001, 0.03, 0.1, 0.3):
        yield f"... at a noise of {noise:.2%}", varied(reference, relative_noise=noise)
    for noise in (0.01, 0.05):
        yield f"... at a pink noise of {noise:.0%}", varied(reference, relative_noise=noise, noise_exponent=1.0)
    hum = {"hum": [{"frequency": "50 Hz", "relative_amplitude": 0.05}]}
    yield "... with a hum of 5 %, 50 Hz", parse_scene(json.loads(reference.text) | {"background": hum})
    for full_scale in (1.25, 5.0):
        yield f"... by 12 bits of {full_scale:g} peaks", varied(reference, relative_range=full_scale, bits=12)
    for edge in ("20 kHz", "10 kHz", "5 kHz"):
        yield f"... behind a low-pass at {edge}", varied(reference, bandwidth=edge)
    for order, edge in ((8, "20 kHz"), (3, "8 kHz")):
        told = f"... behind an anti-alias filter of order {order} at {edge}"
        yield told, varied(reference, anti_alias={"frequency": edge, "order": order})
    yield "... with clipped peaks (at .7)", varied(reference, clipped_at=0.7)
    plate = {"density": 7850, "youngs_modulus": "210 GPa", "poisson_ratio": 0.3, "thickness": "30 mm"}
    yield "... on a steel plate of 30 mm", varied(reference, target=plate)
    yield "... if the series theory were true", varied(reference, stiffness="series")
    yield "another population (scene peers)", load_scene(shipped.scene_path("peers"))
    yield "strangers (scene strangers)", load_scene(shipped.scene_path("strangers"))
    yield "strangers with pulses like the classes' (scene lookalikes)", load_scene(shipped.scene_path("lookalikes"))


def laws_and_shapes() -> Iterator[tuple[str, Scene]]:
    """Yield names and scenes of the rocks of scene `rock`, one law of loss and shape after the other."""
    rock = load_scene(shipped.scene_path("rock"))
    kinds: dict[str, list[Any]] = {}
    for population, law in zip(rock.populations, rock.dissipations, strict=True):
        strength = " by strength" if population.strength is not None else ""
        shape = "spheres" if population.curvature is None else "lumps"
        kinds.setdefault(f"{shape}, {law}{strength}", []).append(population)
    for name, populations in sorted(kinds.items(), reverse=True):
        yield f"... {name}", rock.model_copy(update={"populations": tuple(populations)})
    yield "all of these (scene rock)", rock


def shifted_vibrations() -> Iterator[tuple[str, Scene]]:
    """Yield names and scenes to judge a model of acceleration on."""
    beam = load_scene(shipped.scene_path("tail_beam"))
    yield "the scene tail_beam", beam
    for rate in ("51.2 kHz", "48 kHz"):
        yield f"... sampled at {rate}", varied(beam, sampling_rate=rate, keep_frame=True)
    for noise, decibel in ((0.03, 30), (0.1, 20)):
        yield f"... at a noise of {noise:.0%} ({decibel} dB)", varied(beam, relative_noise=noise)


def domain_shift(model: StoredModel, n_impacts: int = 5120) -> list[dict[str, Any]]:
    """Return, for each shifted scene, accuracy among the measured (None for strangers) and the share flagged.

    `calibration_error` is the expected one, over ten bins, of all that were measured.
    """
    rows = []
    for name, scene in shifted_vibrations() if model.kind == "vibration" else shifted_scenes():
        answers, truth = [], []
        for batch in synthesise(scene, n_impacts, SEED):
            answers += identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger)
            truth += batch.labels.tolist()
        measured = [(answer, label) for answer, label in zip(answers, truth, strict=True) if answer.probabilities]
        found: dict[str, Any] = {"accuracy": None, "calibration_error": None}
        if measured and set(truth) <= set(model.labels):
            labels = np.array([label for _, label in measured])
            probabilities = np.array([[answer.probabilities[name] for name in model.labels] for answer, _ in measured])
            metrics = evaluate(labels, probabilities, model.labels)
            found = {"accuracy": metrics["accuracy"], "calibration_error": metrics["expected_calibration_error"]}
        rows.append(
            {
                "name": name,
                "n": len(answers),
                **found,
                "flagged_share": float(np.mean([not answer.in_training_range for answer in answers])),
            }
        )
    return rows


def domain_shift_table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of a model in other domains.

    `rows` have name, n, accuracy and calibration_error (None for unknown labels) and flagged_share.
    """
    cells = [
        (
            plain(row["name"]),
            row["n"],
            *("-" if row.get(name) is None else f"{row[name]:.4f}" for name in ("accuracy", "calibration_error")),
            f"{row['flagged_share']:.2%}",
        )
        for row in rows
    ]
    return table(("impacts of", "number", "accuracy", "calibration error", "flagged as strange"), cells)


def main() -> None:
    """Print the table of one model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default=shipped.path_of("models", shipped.DEFAULT_MODEL))
    parser.add_argument("-n", "--signals", type=int, default=5120)
    arguments = parser.parse_args()
    print("\n".join(domain_shift_table(domain_shift(StoredModel.load(arguments.model), arguments.signals))))


if __name__ == "__main__":
    main()
