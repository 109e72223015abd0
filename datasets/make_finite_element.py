"""Make finite_element.npz again: impacts of the reference scene, solved by finite elements in place of a law of impact.

    python datasets/make_finite_element.py [--set impacts=256] [--jobs N] [--output FILE]

Every impact is a rock that the scene draws (a seed that no shipped model was trained with): its material, its fall, its
restitution. It is a sphere of a viscoelastic material (Kelvin and Voigt) on a block of steel; its retardation time is
sought, on a coarse mesh, until the sphere rebounds as was asked. Kuwabara and Kono's law gives the first guess of it;
Hertz's contact radius gives the size of the mesh, his duration the time step (MADE says the shares). The force is that
of the elements alone. Without gravity an impact has no size, so each is solved once, for 1 m.

A progress bar runs. The file is written now and then, whole, and a run goes on where the file ends: after an
interruption, or with more --impacts. A file that was made in another way, of other rocks, or of more than are asked for
is left as it is, and nothing is made. To make it anew, take it away first.
"""

import argparse
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from tqdm import tqdm

from cgid._lib import validation
from cgid._lib.files import write_whole
from cgid._lib.workers import workers
from cgid.errors import BadData, CgidError
from cgid.physics import STEEL, Elastic, HalfSpace, HertzRangeWarning, Impact, Material, Sphere
from cgid.physics.contact.bodies import sphere_share
from cgid.physics.contact.sampled import SampledPulses, shares_of_contact
from cgid.scene import load_scene
from cgid.scene.synthesis.impacts import draw
from studies.finite_element import ElasticPlate, FiniteElementImpact, History
from studies.finite_element.solved import MAKING, PARAMETERS, SolvedImpacts, smoothed
from studies.paper.sensitivity import dissipative_constant

HERE = Path(__file__).parent
RADIUS = 1.0
#: How each is solved; sizes of the block are in contact radii, steps in Hertz's duration.
MADE = {
    "scene": "reference",
    "seed": 20180927,
    "elements": 12,
    "steps_per_duration": 250,
    "target_thickness": 60,
    "target_radius": 60,
    "lower_face": "fixed",
    "points": 128,
    "knots": 8,
    "coarse_elements": 7,
    "coarse_steps_per_duration": 200,
    "restitution_within": 0.002,
}
_MAX_TRIALS = 8
_AT_ONCE = 16
#: Two machines may draw a number apart by so much of it.
_ROUNDING = 1e-9


def drawn_impacts(n: int) -> list[dict[str, Any]]:
    """Return labels and parameters of the first rocks that the scene draws."""
    scene = load_scene(HERE / f"{MADE['scene']}.toml")
    found: list[dict[str, Any]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HertzRangeWarning)
        for block in range(-(-n // 256)):
            of = draw(scene, MADE["seed"], block)
            rows = zip(of.labels.tolist(), *(of.parameters[name].tolist() for name in PARAMETERS), strict=True)
            found += [dict(zip(("label", *PARAMETERS), row, strict=True)) for row in rows]
    return found[:n]


def solve(points: int, rock: dict[str, Any]) -> dict[str, Any]:
    """Return the rock's row of the file."""
    warnings.simplefilter("ignore", HertzRangeWarning)
    asked = rock["restitution"]
    retardation = retardation_time(rock, asked)
    found = run(rock, retardation, MADE["elements"], MADE["steps_per_duration"])
    forces = smoothed(
        found.times, found.contact_force.samples, found.contact_duration, shares_of_contact(points), MADE["knots"]
    )
    return rock | {
        "forces": forces,
        "contact_duration": found.contact_duration,
        "restitution": found.restitution,
        "restitution_asked": asked,
        "retardation_time": retardation,
    }


def retardation_time(rock: dict[str, Any], restitution: float) -> float:
    """Return the retardation time [s] with which the sphere rebounds as asked, on the coarse mesh.

    Kuwabara and Kono's law says it to some hundredths; what it misses is asked of it on top.
    """
    law, sphere = elastic_impact_of(rock), sphere_of(rock)
    share = float(sphere_share(sphere, law.target))
    aim = restitution
    for _ in range(_MAX_TRIALS):
        retardation = float(dissipative_constant(aim, law)) / (1.5 * share)
        found = run(rock, retardation, MADE["coarse_elements"], MADE["coarse_steps_per_duration"])
        if abs(found.restitution - restitution) <= MADE["restitution_within"]:
            return retardation
        aim = float(np.clip(aim + restitution - found.restitution, 0.5 * aim, 0.5 + 0.5 * aim))
    raise ArithmeticError(f"no retardation time gives a restitution of {restitution:g}")


def sphere_of(rock: dict[str, Any]) -> Sphere:
    """Return a rock as a sphere of 1 m."""
    names = ("density", "youngs_modulus", "poisson_ratio")
    return Sphere(material=Material(**{name: rock[name] for name in names}), radius=RADIUS)


def elastic_impact_of(rock: dict[str, Any]) -> Impact:
    """Return the impact of a rock by Hertz's theory, without loss."""
    return Impact(
        sphere=sphere_of(rock),
        target=HalfSpace(material=STEEL),
        velocity=rock["velocity"],
        stiffness="hertz",
        dissipation=Elastic(),
    )


def run(rock: dict[str, Any], retardation: float, elements: int, steps: int) -> History:
    """Return the impact of a rock by finite elements."""
    law = elastic_impact_of(rock)
    contact_radius = float(np.sqrt(RADIUS * law.peak_displacement))
    return FiniteElementImpact(
        sphere=sphere_of(rock),
        plate=ElasticPlate(
            material=STEEL,
            thickness=MADE["target_thickness"] * contact_radius,
            radius=MADE["target_radius"] * contact_radius,
            lower_face=MADE["lower_face"],
        ),
        velocity=rock["velocity"],
        retardation_time=retardation,
        elements=elements,
        method="implicit",
        time_step=float(law.contact_duration) / steps,
    ).run()


def gathered(rows: list[dict[str, Any]]) -> SolvedImpacts:
    """Return rows as what is stored."""
    return SolvedImpacts(
        pulses=SampledPulses(
            shares=shares_of_contact(MADE["points"]),
            forces=np.array([row["forces"] for row in rows]),
            contact_duration=np.array([row["contact_duration"] for row in rows]),
        ),
        labels=np.array([row["label"] for row in rows]),
        columns={name: np.array([row[name] for row in rows]) for name in (*PARAMETERS, *MAKING)},
        made=MADE,
    )


def kept(path: Path, rocks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a file that holds the first of these rocks, none if there is no file.

    Raises
    ------
    BadData
        It was made in another way, or holds more or other rocks.
    """
    if not path.exists():
        return []
    found = SolvedImpacts.load(path)
    cure = "take it away to make it anew, or name another --output"
    if found.made != MADE:
        names = sorted(name for name in MADE | dict(found.made) if MADE.get(name) != found.made.get(name))
        raise BadData(f"{path}: must be made as today, is of another {', '.join(names)}; {cure}")
    if len(found) > len(rocks):
        raise BadData(f"{path}: must hold no more than the {len(rocks)} --impacts, holds {len(found)}; {cure}")
    columns = {"label": found.labels, "forces": found.pulses.forces} | dict(found.columns)
    columns["contact_duration"] = found.pulses.contact_duration
    rows = [{name: values[row] for name, values in columns.items()} for row in range(len(found))]
    for number, (row, rock) in enumerate(zip(rows, rocks, strict=False)):
        if not same_rock(row, rock):
            raise BadData(f"{path}: must hold the rocks that the scene draws today, row {number} is another; {cure}")
    return rows


def same_rock(row: dict[str, Any], rock: dict[str, Any]) -> bool:
    """Return whether a row of the file is of a rock, but for rounding."""
    drawn = {name: rock[name] for name in PARAMETERS} | {"restitution": row["restitution"]}
    drawn["restitution_asked"] = rock["restitution"]
    close = all(np.isclose(row[name], value, rtol=_ROUNDING, atol=0) for name, value in drawn.items())
    return bool(close and row["label"] == rock["label"])


def solved(rocks: list[dict[str, Any]], jobs: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of rocks in turn, solved by so many processes."""
    with workers(jobs) as crew:
        yield from crew.each(solve, MADE["points"], rocks)


def main() -> None:
    """Write the file, and say how near the restitutions came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--impacts", type=int, default=256)
    parser.add_argument("--jobs", type=int, default=joblib.cpu_count())
    parser.add_argument("--output", type=Path, default=HERE / "finite_element.npz")
    arguments = parser.parse_args()
    try:
        rocks = drawn_impacts(validation.count("--set", f"impacts={arguments.impacts}"))
        rows = kept(arguments.output, rocks)
    except CgidError as error:
        parser.exit(error.exit_code, f"{error}\n")
    with tqdm(total=len(rocks), initial=len(rows), unit=" impacts", file=sys.stderr) as bar:
        for row in solved(rocks[len(rows) :], arguments.jobs):
            rows.append(row)
            bar.update()
            if len(rows) % _AT_ONCE == 0:
                write_whole(arguments.output, gathered(rows).to_bytes())
    impacts = gathered(rows)
    write_whole(arguments.output, impacts.to_bytes())
    missed = np.abs(impacts.columns["restitution"] - impacts.columns["restitution_asked"])
    print(f"{len(impacts)} impacts, restitution within {missed.max():.4f} of what was asked for")


if __name__ == "__main__":
    main()
