"""What a model of acceleration loses against a model of the force itself, on the same impacts.

python models/beside_force.py [MODEL] [-n 5120]   # prints Markdown; the shipped model of acceleration if none is given
"""

import argparse
from itertools import chain
from typing import Any

import numpy as np

from cgid import shipped
from cgid.identification.answers import Answer, identify_frames
from cgid.identification.card import force_table
from cgid.identification.model import Model
from cgid.identification.selection import paired_difference
from cgid.scene import Scene, load_scene, synthesise, varied

#: No training uses it.
SEED = 2_000_003
SCENE = "tail_beam"


def beside_force(model: Model, scene: Scene, n_impacts: int = 5120, force_model: Model | None = None) -> dict[str, Any]:
    """Return how often two models are right on the same impacts: one sees the vibration, the other the force.

    The same seed draws the same rocks and blows; only what is recorded of them differs. An impact that either model
    cannot measure counts as wrong for that one.

    Parameters
    ----------
    model : Model
        Of acceleration.
    scene : Scene
        Whose quantity is acceleration.
    n_impacts : int
    force_model : Model, optional
        The shipped default model if not given.
    """
    force_model = force_model or Model.load(shipped.path_of("models", shipped.DEFAULT_MODEL))
    vibrations = list(synthesise(scene, n_impacts, SEED))
    # The force wants the sampling that the model of force was made for.
    forces = list(
        synthesise(varied(scene, quantity="force", sampling_rate="200 kHz", keep_frame=True), n_impacts, SEED)
    )
    specimen, own = (np.concatenate([batch.specimen for batch in batches]) for batches in (vibrations, forces))
    if not np.array_equal(specimen, own):
        raise ValueError("both scenes must draw the same impacts; a setting that differs changes what is drawn")
    hits, others = _hits(model, vibrations), _hits(force_model, forces)
    difference, error = paired_difference(others, hits, specimen)
    return {
        "name": f"{force_model.family} of force ({shipped.DEFAULT_MODEL}), on the contact force at 200 kHz",
        "n": len(hits),
        "accuracy": float(hits.mean()),
        "force_accuracy": float(others.mean()),
        "difference": difference,
        "standard_error": error,
    }


def _hits(model: Model, batches: list[Any]) -> Any:
    """Return for which impacts the most probable label is the right one, (n_impacts,)."""
    answers = chain.from_iterable(
        identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger) for batch in batches
    )
    truth = chain.from_iterable(batch.labels.tolist() for batch in batches)
    return np.array([_most_probable(answer) == label for answer, label in zip(answers, truth, strict=True)])


def _most_probable(answer: Answer) -> str | None:
    return max(answer.probabilities, key=answer.probabilities.__getitem__) if answer.probabilities else None


def main() -> None:
    """Print the table of one model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default=None)
    parser.add_argument("-n", "--signals", type=int, default=5120)
    arguments = parser.parse_args()
    model = Model.load(arguments.model or shipped.path_of("models", shipped.ACCELERATION_MODEL))
    print("\n".join(force_table(beside_force(model, load_scene(shipped.scene_path(SCENE)), arguments.signals))))


if __name__ == "__main__":
    main()
