"""Print the Bayes limit of a scene: in noise of any colour, between two learners, or as an estimate behind a beam."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from cgid._lib.files import write_whole
from cgid._lib.validation import whole
from cgid.physics import add_laws
from cgid.plots.figure import new_picture
from cgid.scene import load_scene
from studies import run
from studies.ceilings import limit as white
from studies.ceilings.beam import check_estimated
from studies.ceilings.coloured import limits, uncovered
from studies.ceilings.learners import above, behind_beam, through_beam
from studies.ceilings.limit import MAX_SIGNALS, Ceiling, Learner, check_training, learner, require_supported, untrusted
from studies.ceilings.survey import Point, survey, survey_picture


def study(given: argparse.Namespace) -> None:
    """Compute and print what was asked."""
    for module in given.laws:
        add_laws(module)
    scene, n, seed, known = load_scene(given.scene), given.signals, given.seed, given.drop_height
    require_supported(scene)
    whole("signals", n, 2, MAX_SIGNALS)
    if given.learner is not None:
        check_training(given.learner)
    with tqdm(unit=" signals", file=sys.stderr, disable=None) as progress:
        if given.survey is not None:
            picture = new_picture(given.survey, overwrite=given.overwrite)
            found = survey(scene, n, seed, progress=progress.update)
            axes = {axis: found.along(axis) for axis in found.present}
            write_whole(picture, survey_picture(axes, found.present, found.here), overwrite=given.overwrite)
            print(*map(_row, (found.here, *found.points)), sep="\n")
        elif scene.tail_beam is not None:
            check_estimated(scene)
            below = given.learner and through_beam(
                scene, given.learner, n, seed, drop_height_known=known, progress=progress.update
            )
            estimate, apart = behind_beam(scene, n, seed, drop_height_known=known, progress=progress.update)
            print(f"highest accuracy possible about {_shown(estimate[-1])}, an estimate, neither an upper nor a lower")
            print(f"bound; pulses stand for the closest ones of the family, {apart:.2%} apart (median)")
            if below:
                print(f"a learner on {below.n_training} measured signals {_shown(below)}")
        elif rule := uncovered(scene):
            below = learner(scene, given.learner or 10_000, n, seed, drop_height_known=known, progress=progress.update)
            bound = above(scene, n, seed, drop_height_known=known)[-1]
            print(f"highest accuracy possible between {_shown(below)} and {_shown(bound)}")
            print(f"not integrated: that needs {rule}")
        else:
            if problem := untrusted(scene):
                print(f"do not rely on this limit: {problem}", file=sys.stderr)
            in_noise = limits if white.uncovered(scene) else white.ceilings  # of any colour, or white
            (limit,) = in_noise(scene, n, seed, (known,), progress=progress.update)
            print(f"highest accuracy possible {_shown(limit)}")
            print(f"right answers of Bayes' rule {limit.hits.mean():.4f}")
            print(f"Brier score {limit.brier_score:.4f} +- {limit.brier_error:.4f}")
            if given.learner:
                below = learner(scene, given.learner, n, seed, drop_height_known=known, progress=progress.update)
                print(f"a learner on {below.n_training} measured signals {_shown(below)}")


def _shown(found: Ceiling | Learner) -> str:
    return f"{found.accuracy:.4f} +- {found.accuracy_error:.4f}"


def _row(point: Point) -> str:
    values = f"{point.accuracy:.4f} +- {point.accuracy_error:.4f}, drop height known {point.accuracy_known:.4f}"
    return f"{point.axis:<13}  {point.value:>8g}  {(point.left_out and f'left out: {point.left_out}') or values}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m studies.ceilings", description=__doc__)
    parser.add_argument("scene", help="a .toml file or the name of a shipped scene")
    parser.add_argument("--laws", action="append", default=[], metavar="MODULE", help="module of a law of your own")
    parser.add_argument("-n", "--signals", type=int, default=20_000, help="signals to answer")
    parser.add_argument("--seed", type=int, default=1_000_003, help="of these signals")
    parser.add_argument("--drop-height", action="store_true", help="take the drop height of each rock as known")
    parser.add_argument("--learner", type=int, help="signals to train the learner from below on")
    parser.add_argument("--survey", type=Path, metavar="PNG", help="other noises, sampling rates and spreads of sizes")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing picture")
    given = parser.parse_args(arguments)
    return run(lambda: study(given))


if __name__ == "__main__":
    sys.exit(main())
