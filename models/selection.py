"""Compare the families of classifiers on a scene; print Markdown.

    python models/selection.py                          # the reference scene, 20000 impacts, 5 folds
    python models/selection.py yang2018 -n 5000 --drop-height

Standardising, fitting and calibrating happen inside the folds, which are the same for all and keep specimens together.
"""

import argparse
import sys

from cgid import shipped
from cgid.identification.card import selection_table
from cgid.identification.rows import measure
from cgid.identification.selection import MARGIN, SUPPORT_VECTOR_IMPACTS, select
from cgid.scene import load_scene, synthesise
from cgid.workers import workers


def main() -> None:
    """Synthesise, measure, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="reference", help="a .toml file, or the name of a shipped scene")
    parser.add_argument("-n", "--signals", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--features", help="only these, with commas between them")
    parser.add_argument("--drop-height", action="store_true", help="the classifiers also get the drop height")
    parser.add_argument("--jobs", type=int, default=1, help="worker processes; fits then take longer each")
    arguments = parser.parse_args()
    scene = load_scene(shipped.scene_path(arguments.scene))
    features = None if arguments.features is None else arguments.features.split(",")
    known = ("drop_height",) if arguments.drop_height else ()
    measured = measure(synthesise(scene, arguments.signals, arguments.seed), features, known=known)
    with workers(arguments.jobs) as crew:
        rows = select(
            measured,
            n_folds=arguments.folds,
            seed=arguments.seed,
            progress=lambda name: print(name, "...", file=sys.stderr, flush=True),
            crew=crew,
        )
    print(f"Scene `{scene.name}`, {len(measured.labels)} impacts, {arguments.folds} folds by specimen.\n")
    print("\n".join(selection_table(rows)))
    print(
        f"\nDifferences are from the first line on the same impacts, ± one standard error. Bold is the choice: the "
        f"first, or a later\none that is better by more than {MARGIN:g}. Support vectors learn from at most "
        f"{SUPPORT_VECTOR_IMPACTS} impacts of a fold. Fit: one fold,\none thread, calibration included. One impact: "
        "by the exported model in numpy where there is one, else by scikit-learn."
    )


if __name__ == "__main__":
    main()
