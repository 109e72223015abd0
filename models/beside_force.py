"""What a model of acceleration loses against a model of the force itself, on the same impacts.

python models/beside_force.py [MODEL] [-n 100000]   # prints Markdown; of the shipped model if none is given
"""

import argparse
from itertools import chain
from typing import Any

import numpy as np

from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import Answer, identify_frames
from cgid.identification.training import train_on_specimens
from cgid.identification.training.card import plain, table
from cgid.identification.training.metrics import paired_difference
from cgid.scene import Scene, load_scene, synthesise, varied

#: No training uses it.
SEED = 2_000_003
SCENE = "tail_beam"


def beside_force(model: StoredModel, scene: Scene, rival: StoredModel, n_impacts: int = 5120) -> dict[str, Any]:
    """Return how often two models are right on the same impacts: one sees the vibration, the other the force.

    The same seed draws the same rocks and blows; only what is recorded of them differs. An impact that either model
    cannot measure counts as wrong for that one.

    Parameters
    ----------
    model : StoredModel
        Of acceleration.
    scene : Scene
        Whose quantity is acceleration.
    n_impacts : int
    rival : StoredModel
        Of the force.
    """
    vibrations = list(synthesise(scene, n_impacts, SEED))
    forces = list(synthesise(of_force(scene), n_impacts, SEED))
    specimen, own = (np.concatenate([batch.specimen for batch in batches]) for batches in (vibrations, forces))
    if not np.array_equal(specimen, own):
        raise ValueError("both scenes must draw the same impacts; a setting that differs changes what is drawn")
    hits, others = _hits(model, vibrations), _hits(rival, forces)
    difference, error = paired_difference(others, hits, specimen)
    return {
        "name": f"{rival.family} of force, trained on the same rocks, on the force at 200 kHz with 1 % noise",
        "n": len(hits),
        "accuracy": float(hits.mean()),
        "force_accuracy": float(others.mean()),
        "difference": difference,
        "standard_error": error,
    }


def of_force(scene: Scene) -> Scene:
    """Return the scene as a force sensor at the point of impact sees it: 200 kHz, 1 % noise, nothing that rings."""
    off = {"noise_density": None, "mounting": None, "anti_alias": None, "range": None, "bits": None}
    return varied(scene, quantity="force", sampling_rate="200 kHz", keep_frame=True, relative_noise=0.01, **off)


def force_model(scene: Scene, n_signals: int, seed: int) -> StoredModel:
    """Return a model of the force, trained on the same rocks and blows."""
    return train_on_specimens(synthesise(of_force(scene), n_signals, seed), family="logistic", seed=seed).model


def _hits(model: StoredModel, batches: list[Any]) -> Any:
    """Return for which impacts the most probable label is the right one, (n_impacts,)."""
    answers = chain.from_iterable(
        identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger) for batch in batches
    )
    truth = chain.from_iterable(batch.labels.tolist() for batch in batches)
    return np.array([_most_probable(answer) == label for answer, label in zip(answers, truth, strict=True)])


def _most_probable(answer: Answer) -> str | None:
    return max(answer.probabilities, key=answer.probabilities.__getitem__) if answer.probabilities else None


def force_table(row: dict[str, Any]) -> list[str]:
    """Return the comparison of a model of vibrations with one of the contact force of the same impacts.

    `row` has name (of the other model), n, accuracy, force_accuracy, difference, standard_error.
    """
    rows = [
        ("this model, on the vibration", row["n"], f"{row['accuracy']:.4f}"),
        (plain(row["name"]), row["n"], f"{row['force_accuracy']:.4f}"),
    ]
    lost = f"{row['difference']:.4f} ± {row['standard_error']:.4f} of the accuracy"
    return [*table(("the same impacts", "number", "accuracy"), rows), "", f"The way through the beam costs {lost}."]


def main() -> None:
    """Print the table of one model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default=None)
    parser.add_argument("-n", "--signals", type=int, default=100_000, help="to train the model of the force on")
    arguments = parser.parse_args()
    model = StoredModel.load(arguments.model or shipped.path_of("models", shipped.ACCELERATION_MODEL))
    scene = load_scene(shipped.scene_path(SCENE))
    print("\n".join(force_table(beside_force(model, scene, force_model(scene, arguments.signals, seed=1)))))


if __name__ == "__main__":
    main()
