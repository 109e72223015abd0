"""Make the shipped default model again, through the public API.

    python models/train.py                        # models/default.npz, default.md and its pictures
    python models/train.py -o mine.npz -n 20000   # elsewhere, smaller

It trains on impacts of the reference scene that are synthesised on the fly and never touch the disk.
"""

import argparse
from pathlib import Path

from cgid.identification.output import check_model_output, write_model
from cgid.identification.training import train
from cgid.scene import load_scene, synthesise

HERE = Path(__file__).parent
SCENE = HERE.parent / "datasets" / "reference.toml"


def main() -> None:
    """Train, judge, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=HERE / "default.npz")
    parser.add_argument("-n", "--signals", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scene", type=Path, default=SCENE)
    parser.add_argument("--family", default="logistic")
    arguments = parser.parse_args()
    output = check_model_output(arguments.output, plots=True, overwrite=True)
    scene = load_scene(arguments.scene)
    training = train(synthesise(scene, arguments.signals, arguments.seed), family=arguments.family, seed=arguments.seed)
    for path in write_model(training, output, plots=True):
        print(path)
    low, high = training.metrics["accuracy_interval_95"]
    print(f"accuracy {training.metrics['accuracy']:.4f} (95 % interval {low:.4f} to {high:.4f})")


if __name__ == "__main__":
    main()
