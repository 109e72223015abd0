"""Train the shipped models again, through the public API.

    python models/train.py                        # models/default.npz, default.md and its pictures
    python models/train.py --drop-height          # the same with known drop height: default-drop-height.npz
    python models/train.py --acceleration         # for the vibration of a tail beam: default-acceleration.npz
    python models/train.py -o mine.npz -n 20000   # elsewhere, smaller

It trains on impacts of two shipped scenes, half of them of `reference`, half of `randomised` (the same rocks at all
sampling rates and noises), which are synthesised on the fly and never touch the disk. It is judged, and its prediction
sets are calibrated, on impacts of `reference` that did not train. The card also compares the families
(`models/selection.py`), and says how the model performs on other scenes (`models/domain_shift.py`).

The model of acceleration trains on `tail_beam` alone. Its card compares it with a model of force on the same impacts
(`models/beside_force.py`).
"""

import argparse
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from beside_force import beside_force, force_model, force_table, learner
from domain_shift import domain_shift, domain_shift_table
from selection import select, selection_section

from cgid import shipped
from cgid.identification.card import Section, check_model_output, write_model
from cgid.identification.model import Model
from cgid.identification.rows import measure
from cgid.identification.training import train
from cgid.scene import load_scene, synthesise

HERE = Path(__file__).parent
SCENES = ("reference", "randomised")
ACCELERATION_SCENES = ("tail_beam",)


def sections(model: Model) -> list[Section]:
    """Return the sections of the card about the comparisons in the record of a model."""
    told, found = model.training, []
    if "domain_shift" in told:
        found.append(("Domain shift", domain_shift_table(told["domain_shift"])))
    if "beside_force" in told:
        found.append(("What is lost against the force", force_table(told["beside_force"])))
    if "selection" in told:
        found.append(("Selection", selection_section(told["selection"], model.family)))
    return found


def main() -> None:
    """Compare the families, train the chosen one, judge, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("-n", "--signals", type=int, default=100_000, help="of each scene")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--family", default="network")
    parser.add_argument("--drop-height", action="store_true", help="the model also gets the drop height")
    parser.add_argument("--acceleration", action="store_true", help="the model of a tail beam's vibration")
    parser.add_argument("--selection", type=int, default=10_000, help="of each scene, to compare families on; 0: none")
    arguments = parser.parse_args()
    if arguments.acceleration and arguments.drop_height:
        parser.error("--acceleration and --drop-height make two models; give one of them")
    name = shipped.DROP_HEIGHT_MODEL if arguments.drop_height else shipped.DEFAULT_MODEL
    name = shipped.ACCELERATION_MODEL if arguments.acceleration else name
    output = check_model_output(arguments.output or HERE / name, plots=True, overwrite=True)
    known = ("drop_height",) if arguments.drop_height else ()
    scenes = [
        load_scene(shipped.scene_path(scene)) for scene in (ACCELERATION_SCENES if arguments.acceleration else SCENES)
    ]
    # A seed for each scene: the same seed would draw the same rocks.
    seeded = [(scene, arguments.seed + number) for number, scene in enumerate(scenes)]
    told: dict[str, Any] = {}
    if arguments.selection and not known:
        few = chain.from_iterable(synthesise(scene, arguments.selection, seed) for scene, seed in seeded)
        told["selection"] = select(measure(few, known=known), n_folds=3, seed=arguments.seed)
    batches = chain.from_iterable(synthesise(scene, arguments.signals, seed) for scene, seed in seeded)
    training = train(
        batches,
        known=known,
        family=arguments.family,
        seed=arguments.seed,
        judged_on=scenes[0].sha256,
    )
    told["domain_shift"] = domain_shift(training.model)
    if arguments.acceleration:
        best = learner(scenes[0], arguments.signals, arguments.seed)
        rival = force_model(scenes[0], arguments.signals, arguments.seed)
        told["beside_force"] = beside_force(training.model, scenes[0], rival) | {"learner": best}
    model = replace(training.model, training=training.model.training | told)
    for path in write_model(replace(training, model=model), output, plots=True, further=sections(model)):
        print(path)
    low, high = training.metrics["accuracy_interval_95"]
    print(f"accuracy {training.metrics['accuracy']:.4f} (95 % interval {low:.4f} to {high:.4f})")


if __name__ == "__main__":
    main()
