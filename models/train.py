"""Train the shipped models again, through the public API.

    python models/train.py -n 60000 --selection 2000   # models/default.npz, default.md and its pictures
    python models/train.py --acceleration -n 44000 --selection 2000   # for vibrations: default-acceleration.npz
    python models/train.py --seams                # the same with its simulated seams and recordings anew
    python models/train.py --faults               # only add what explains recordings that are not as in the training
    python models/train.py --finish -n 5000       # that of acceleration with its guards and all its streams anew
    python models/train.py -o mine.npz -n 20000   # elsewhere, smaller

It trains on impacts of the shipped scenes `rock` (five laws of loss, spheres and lumps), `reference` and `corners`
(faces, too, and rock that breaks), on the rig of `reference` and on many others (`RIGS`: rates, noises and their
colours, hum, bits, filters, clipping), which are synthesised on the fly and never touch the disk. Impacts of `anything`
on the same rigs are strangers: from them it learns where its rocks end. It is judged, and its prediction sets are
calibrated, on impacts of `reference` that did not train. The card also compares the families (`models/selection.py`),
and says how the model performs on other scenes (`models/domain_shift.py`).

The model of acceleration looks through the beam of `tail_beam` at the contact force. It trains on blows all over that
beam (`EVERYWHERE`), in many noises (`BEAM_RIGS`), and on impacts as found in streams like `caving`, where rocks
bounce, overlap and ring; on rocks of `corners` and lumps of 10 to 30 cm, too (`other_rocks`). It is judged on the blows
of `tail_beam`, and finished on further streams (`cgid.learning.streams`). Its card compares it with a model of force on
the same impacts (`models/beside_force.py`).
"""

import argparse
import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import date
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from beside_force import beside_force, force_model, force_table
from domain_shift import domain_shift, domain_shift_table
from selection import select, selection_section
from single_forces import pool_of_pulses

from cgid import shipped
from cgid._lib.files import write_together
from cgid.identification.model.explanations import Impacts
from cgid.identification.model.families import Neighbourhood
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import UNEXPLAINED
from cgid.identification.training.card import PICTURES, Section, check_model_output, table, write_card, write_model
from cgid.identification.training.rows import (
    BEAM_FEATURES,
    BEAM_GUARDS,
    DEFAULT_FEATURES,
    DEFAULT_GUARDS,
    Rows,
    measure,
)
from cgid.identification.training.training import train_on_specimens
from cgid.learning.faults import N_RECORDINGS, SPOILT, Recording, answers_of, counted, of_seams, spoilt, with_faults
from cgid.learning.seams import N_POOLS, N_STREAMS, Pool, pool_of, wide, with_seams
from cgid.learning.streams import StreamRows, finished, rows_of_streams, variations
from cgid.measure.modal.beam import Beam
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.synthesis.through_beam import beam_of
from cgid.signals import Batch

HERE = Path(__file__).parent
#: Where blows fall on the tail beam in the training of the model of acceleration: not only where the window opens.
EVERYWHERE = {
    "x": {"distribution": "uniform", "lowest": "0.1 m", "highest": "1.55 m"},
    "y": {"distribution": "uniform", "lowest": "0.1 m", "highest": "1.3 m"},
}
#: From the recorder of a vibration monitor to that of a laboratory, from a good sensor to one that hardly sees a blow.
#: All shares are assumed: half of the noise is white, half without hum, one in three pulses is clipped. One in three
#: rigs has no filter, one a slow one.
RIGS = {
    "sampling_rate": {"distribution": "log-uniform", "lowest": "24.5 kHz", "highest": "1.02 MHz"},
    "relative_noise": {"distribution": "log-uniform", "lowest": 1e-4, "highest": 0.3},
    "noise_exponent": {
        "distribution": "mixed",
        "parts": [0, {"distribution": "uniform", "lowest": 0, "highest": 1.2}],
    },
    "hum": {"distribution": "mixed", "parts": [0, {"distribution": "log-uniform", "lowest": 1e-3, "highest": 0.06}]},
    "hum_frequency": {"distribution": "choice", "values": [50, 60, 150, 180]},
    "relative_range": {
        "distribution": "choice",
        "values": [0.5, 0.6, 0.7, 0.8, 0.9, 1.2],
        "weights": [1, 1, 1, 1, 1, 11],
    },
    "bits": {"distribution": "uniform", "lowest": 10, "highest": 24},
    "anti_alias_frequency": {
        "distribution": "mixed",
        "parts": [
            "1 GHz",
            {"distribution": "log-uniform", "lowest": "4 kHz", "highest": "20 kHz"},
            {"distribution": "log-uniform", "lowest": "20 kHz", "highest": "300 kHz"},
        ],
    },
}
#: Orders of the filters, each on a third of the rigs: of a charge amplifier, of a recorder.
ORDERS = (2, 4, 8)
#: The same for accelerometers: a beam has one recorder, but not one noise.
BEAM_RIGS = {name: RIGS[name] for name in ("noise_exponent", "hum", "hum_frequency", "bits")} | {
    "relative_noise": {"distribution": "log-uniform", "lowest": 1e-3, "highest": 0.3},
    "relative_range": {"distribution": "choice", "values": [0.5, 0.7, 0.9, 1.2], "weights": [1, 1, 1, 12]},
}
#: Samples of a frame on all rigs, of which before touch: 4.1 ms at 1 MHz, where the longest contact lasts 2.1 ms.
RIG_FRAME = {"samples": 4096, "pre_trigger": 300}
#: Simulated recordings of forces, each sound and spoilt in six ways; impacts of one.
N_FORCES_SPOILT = 400
IMPACTS_SPOILT = 128
#: Scenes of successive recordings of forces, of each shipped one (0, 4, 8) and its three rigs after it: half at home.
ORDER_SPOILT = (0, 1, 4, 2, 0, 5, 3, 4, 6, 8, 7, 0, 9, 4, 10, 8, 11)
#: So many recordings of forces have one noise between all impacts, the others that of each (assumed).
_ONE_NOISE = 0.5
#: How often a lump is drawn for each sphere of the same law, and crushing by strength for each by equal restitution.
LUMPS, STRENGTHS = 0.3, 0.7
#: Impacts of `corners` on the rig of `reference` and on others, over those of `rock` on others. More of them cost
#: spheres in noise, whose pulses are like those of faces and corners, more than they give.
CORNERS = (0.1, 0.2)
#: The same on the beam, over the blows all over it, and of lumps, whose radii are these; streams of either over all.
BEAM_CORNERS, BEAM_LUMPS, OTHER_STREAMS = 0.4, 0.2, 0.25
LARGE = {"distribution": "log-uniform", "lowest": "50 mm", "highest": "150 mm"}


def on_rigs(scene: Scene, n: int) -> list[tuple[Scene, int]]:
    """Return a scene on all of `RIGS`, for each of `ORDERS`, with the number of impacts of each, n in all."""
    content = json.loads(scene.text)
    del content["sensor"]["relative_noise"]
    content["sampling"] |= RIG_FRAME
    made = []
    for order in ORDERS:
        content["sensor"]["anti_alias"] = {"frequency": "20 kHz", "order": order}  # the frequency is drawn
        name = f"{scene.name} on many rigs, filters of order {order}"
        made.append((parse_scene(content | {"name": name, "randomise": RIGS}), n // len(ORDERS)))
    return made


def shipped_scene(name: str) -> Scene:
    """Return a shipped scene, with `LUMPS` and `STRENGTHS` as the weights of its lumps and strengths."""
    content = json.loads(load_scene(shipped.scene_path(name)).text)
    for population in content["populations"]:
        population["weight"] *= (LUMPS if "curvature" in population else 1) * (
            STRENGTHS if "strength" in population else 1
        )
    return parse_scene(content)


def force_scenes(n: int) -> list[tuple[Scene, int]]:
    """Return the scenes of the model of force with the number of impacts of each, the one to be judged on first."""
    reference, rock, corners = map(shipped_scene, ("reference", "rock", "corners"))
    home = [(reference, 3 * n // 10), (rock, 6 * n // 10)]
    rigs = on_rigs(reference, 4 * n // 10) + on_rigs(rock, n)
    return home + rigs + on_rigs(corners, round(CORNERS[1] * n)) + [(corners, round(CORNERS[0] * n))]


def other_rocks(scene: Scene) -> tuple[Scene, Scene]:
    """Return a scene of vibrations with the rocks of `corners` and with lumps of 10 to 30 cm."""
    content, corners = json.loads(scene.text), json.loads(load_scene(shipped.scene_path("corners")).text)
    lumps = [population | {"radius": LARGE} for population in content["populations"]]
    cornered = content | {"name": f"{scene.name}, corners", "populations": corners["populations"]}
    cornered["impact"] = content["impact"] | {"dissipation": "power-law"}
    return parse_scene(cornered), parse_scene(content | {"name": f"{scene.name}, lumps", "populations": lumps})


def acceleration_scenes(n: int) -> list[tuple[Scene, int]]:
    """Return the scenes of the model of acceleration with the number of impacts of each."""
    own = load_scene(shipped.scene_path("tail_beam"))
    content = json.loads(own.text)
    content["tail_beam"]["impact_point"] = EVERYWHERE
    everywhere = parse_scene(content | {"name": "tail_beam, blows everywhere"})
    for name in ("noise_density", "range", "bits"):
        del content["sensor"][name]
    noisy = parse_scene(content | {"name": "tail_beam, many noises", "randomise": BEAM_RIGS})
    corners, lumps = other_rocks(parse_scene(content | {"name": "tail_beam", "randomise": BEAM_RIGS}))
    others = [(corners, round(BEAM_CORNERS * n)), (lumps, round(BEAM_LUMPS * n))]
    return [(own, 2 * n // 5), (noisy, 4 * n // 5), *others, (everywhere, n)]


def streams(n_streams: int, seed: int, beam: Beam, scene: Scene | None = None) -> list[StreamRows]:
    """Return the impacts that are found in streams like `caving`, or another scene."""
    scenes = variations(scene or load_scene(shipped.scene_path("caving")), n_streams, seed)
    return rows_of_streams(scenes, seed, (*BEAM_FEATURES, *BEAM_GUARDS), beam)


def stranger_scenes(n: int) -> list[tuple[Scene, int]]:
    """Return the scenes of anything with the number of impacts of each, on the rig of `reference` and on others."""
    anything = shipped_scene("anything")
    return [(anything, n // 2), *on_rigs(anything, n // 2)]


def strangers(n: int, seed: int) -> Rows:
    """Return rows of anything."""
    made = (synthesise(scene, own, seed + number) for number, (scene, own) in enumerate(stranger_scenes(n)))
    return measure(chain.from_iterable(made), (*DEFAULT_FEATURES, *DEFAULT_GUARDS))


def streams_section(told: dict[str, Any]) -> list[str]:
    """Return the lines about the streams that finished a model."""
    answers = ", ".join(f"{rate:.2f} for {label}" for label, rate in told["answers_a_rock"].items())
    return [
        f"In {told['n_streams']} streams like `caving`, not trained on, {told['n_found']} impacts were found, "
        f"{told['unknown_share']:.1%} of them unknown. Known answers a rock: {answers}. The "
        "share corrects for what the model answers to either. "
        f"Its variance is {told['overdispersion']:.2f} times that of independent answers, and it scatters by "
        f"{told['scatter']:.3f} from stream to stream."
    ]


def pool(model: StoredModel, n: int, seed: int) -> Pool:
    """Return the impacts of the wide world whose errors the simulated seams of a model take."""
    if model.beam is not None:
        return pool_of(load_scene(shipped.scene_path("caving")), n, seed, model.beam.beam)
    reference = wide(load_scene(shipped.scene_path("reference")))
    sizes = [(reference, 400 * n), *on_rigs(reference, 300 * n)]
    batches = (synthesise(scene, own, seed + number) for number, (scene, own) in enumerate(sizes))
    return pool_of_pulses(chain.from_iterable(batches), model.measured)


def seams_section(told: dict[str, Any], *, in_noises: bool) -> list[str]:
    """Return the lines about the fraction of gangue in simulated seams."""
    noises = " in noise of 1, 3, 10 and 30 times that of the scene" if in_noises else ""
    named = {
        "beside the coal of its seam": told["anchored"],
        "beside coal and labelled lumps of gangue": told["sharpened"],
        "the window alone": told["alone"],
    }
    rows = [(name, *(f"{own[key]:.3f}" for key in ("rms", "holds", "width"))) for name, own in named.items()]
    return [
        f"{told['n_seams']} simulated seams taught it the fraction of gangue in a seam that nobody described, by the "
        f"errors of {told['n_impacts']} impacts{noises}. On {told['n_judges']} others, in windows of 40 to 130 "
        "rocks:\n",
        *table(("", "RMS error", "95 % intervals hold", "their width"), rows),
        f"\nThe fraction beside coal is the mean of {len(told['each'])} networks; each by itself errs by "
        f"{min(told['each']):.3f} to {max(told['each']):.3f}.",
        f"\nOf anchors of another seam, or a fifth gangue and more, {told['foreign_told']:.0%} are told by one window, "
        f"of sound ones {1 - told['sound']:.1%}.",
    ]


def sections(model: StoredModel) -> list[Section]:
    """Return the sections of the card about the comparisons in the record of a model."""
    told, found = model.training, []
    if "domain_shift" in told:
        found.append(("Domain shift", domain_shift_table(told["domain_shift"])))
    if "streams" in told:
        found.append(("On streams", streams_section(told["streams"])))
    if "seams" in told:
        found.append(("In other seams", seams_section(told["seams"], in_noises=model.beam is not None)))
    if "faults" in told:
        found.append(("Faults of a recording", faults_section(told["faults"])))
    if "beside_force" in told:
        found.append(("What is lost against the force", force_table(told["beside_force"])))
    if "selection" in told:
        found.append(("Selection", selection_section(told["selection"], model.family)))
        if "streams" in told:
            found[-1][1].append("\nIt compares the families on single blows in frames of their own, without streams.")
    return found


def finish(model: StoredModel, n_impacts: int, n_streams: int, seed: int) -> StoredModel:
    """Return a model of acceleration with the guards of this version, finished on streams anew."""
    sizes = acceleration_scenes(n_impacts)
    beam, names = beam_of(sizes[-1][0]), (*BEAM_FEATURES, *BEAM_GUARDS)
    seeded = [(scene, n, seed + number) for number, (scene, n) in enumerate(sizes)]
    frames = measure(chain.from_iterable(synthesise(*one) for one in seeded), names, beam=beam)
    further = streams(n_streams, seed + 11, beam)
    guards = Rows.joined([frames, *(stream.rows for stream in further)]).columns(BEAM_GUARDS)
    limits = tuple(np.quantile(guards, Neighbourhood.INSIDE, axis=0).tolist())
    model = replace(model, guards=BEAM_GUARDS, guard_limits=limits)
    model = finished(model, further)
    told = {UNEXPLAINED: float(np.median(guards[:, 0])), "domain_shift": domain_shift(model)}
    return replace(model, training={**model.training, **told})


def recordings(model: StoredModel, seed: int) -> Iterator[list[Recording]]:
    """Yield simulated recordings of a model, each sound and spoilt."""
    if model.beam is not None:
        yield from of_seams(load_scene(shipped.scene_path("caving")), model, N_RECORDINGS, seed)
        return
    scenes = []
    for scene in map(shipped_scene, ("reference", "rock", "corners")):
        scenes += [(scene, True), *((rig, False) for rig, _ in on_rigs(scene, 3))]
    for number in range(N_FORCES_SPOILT):
        own, at_home = scenes[ORDER_SPOILT[number % len(ORDER_SPOILT)]]
        drawn = 1000 * seed + number
        yield from of_forces(islice(synthesise(own, IMPACTS_SPOILT, drawn), 1), model, drawn, at_home=at_home)


def of_forces(batches: Iterable[Batch], model: StoredModel, seed: int, *, at_home: bool) -> Iterator[list[Recording]]:
    """Yield the frames of single forces of each batch as a recording, and the same spoilt in each way."""
    for number, batch in enumerate(batches):
        rng = np.random.default_rng([seed, number, 76])
        frames, before = np.asarray(batch.signals, np.float64), max(int(batch.pre_trigger or 0), 2)
        gap = round(10e-3 * batch.sampling_rate)
        # What is before a frame goes on before it, to and fro; or one noise is between all.
        quiet = np.pad(frames[:, :before], ((0, 0), (gap, 0)), mode="symmetric")[:, :gap]
        if rng.random() < _ONE_NOISE:
            quiet = frames[:, :before].std() * rng.standard_normal(quiet.shape)
        samples = np.hstack([quiet, frames]).ravel()
        length = gap + frames.shape[1]
        made = []
        for fault in (None, *SPOILT):
            own, rate, factor = spoilt(samples, batch.sampling_rate, fault, rng, is_force=True)
            answers = answers_of(own, rate, model)
            frame = np.array([answer.time * batch.sampling_rate // length for answer in answers], np.intp)
            gangue = np.asarray(batch.labels)[np.minimum(frame, len(frames) - 1)] == "gangue"
            made.append(Recording(Impacts.of(answers, model), gangue[counted(answers)], fault, factor, at_home))
        yield made


def faults_section(told: dict[str, Any]) -> list[str]:
    """Return the lines about explanations of recordings."""
    return [
        f"{told['n_recordings']} simulated recordings, each sound and spoilt, taught it to explain one that is not as "
        f"in the training. An explanation is told where its odds are above those in {1 - told['false_rate']:.1%} of "
        f"sound windows that did not teach it; at most {told['false_recordings']:.0%} of the sound recordings are told "
        "any."
    ]


def simulated(model: StoredModel, seed: int) -> StoredModel:
    """Return a model with what simulated seams and recordings teach beside its answers."""
    model = with_seams(model, [pool(model, N_STREAMS, seed + 20 + k) for k in range(N_POOLS)], seed)
    return with_faults(model, recordings(model, seed + 8799), seed)


def write_finished(model: StoredModel, output: Path, name: str) -> None:
    """Write a model and its card, beside the pictures that it has."""
    pictures = tuple(f"{Path(name).stem}-{picture}.png" for picture in PICTURES)
    card = write_card(model, output.name, pictures, sections(model))
    write_together({output: model.to_bytes(), output.with_suffix(".md"): card.encode()}, overwrite=True)
    note_version(output)


def note_version(path: Path) -> None:
    """Give a shipped model that has changed its next version."""
    versions, rows = HERE / "versions.csv", shipped.model_versions()
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    for row in rows:
        if path == HERE / f"{row['name']}.npz" and row["sha256"] != digest:
            row |= {"version": str(int(row["version"]) + 1), "date": date.today().isoformat(), "sha256": digest}
    lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
    write_together({versions: ("\n".join(lines) + "\n").encode()}, overwrite=True)


def main() -> None:
    """Compare the families, train the chosen one, judge, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("-n", "--signals", type=int, default=100_000, help="of the largest scene")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--family", default="network")
    parser.add_argument("--acceleration", action="store_true", help="the model of a tail beam's vibration")
    parser.add_argument(
        "--finish", action="store_true", help="give that of acceleration its guards and streams anew, too"
    )
    parser.add_argument("--seams", action="store_true", help="only make its simulated seams and recordings anew")
    parser.add_argument("--faults", action="store_true", help="only add explanations of recordings")
    parser.add_argument("--streams", type=int, default=120, help="for acceleration; half as many finish the model")
    parser.add_argument("--selection", type=int, default=10_000, help="of each scene, to compare families on; 0: none")
    arguments = parser.parse_args()
    name = shipped.ACCELERATION_MODEL if arguments.acceleration else shipped.DEFAULT_MODEL
    output = check_model_output(arguments.output or HERE / name, plots=True, overwrite=True)
    if arguments.faults:
        model = StoredModel.load(HERE / name)
        write_finished(with_faults(model, recordings(model, arguments.seed + 8799), arguments.seed), output, name)
        return
    if arguments.finish or arguments.seams:
        name = shipped.ACCELERATION_MODEL if arguments.finish else name
        model = StoredModel.load(HERE / name)
        if arguments.finish:
            model = finish(model, arguments.signals, arguments.streams // 2, arguments.seed)
        write_finished(simulated(model, arguments.seed), arguments.output or HERE / name, name)
        return
    sizes = force_scenes(arguments.signals)
    if arguments.acceleration:
        sizes = acceleration_scenes(arguments.signals)
    scenes = [scene for scene, _ in sizes]
    beam = beam_of(scenes[-1]) if arguments.acceleration else None
    # A seed for each scene: the same seed would draw the same rocks.
    seeded = [(scene, n, arguments.seed + number) for number, (scene, n) in enumerate(sizes)]
    told: dict[str, Any] = {}
    if arguments.selection:
        share = arguments.selection / arguments.signals
        few = chain.from_iterable(synthesise(scene, round(share * n), seed) for scene, n, seed in seeded)
        told["selection"] = select(measure(few, beam=beam), n_folds=3, seed=arguments.seed)
    batches = chain.from_iterable(synthesise(scene, n, seed) for scene, n, seed in seeded)
    others: Rows | None = None
    data: Any = batches
    if beam is not None:
        frames = measure(batches, (*BEAM_FEATURES, *BEAM_GUARDS), beam=beam)
        found = streams(arguments.streams, arguments.seed + 10, beam)
        for number, scene in enumerate(other_rocks(load_scene(shipped.scene_path("caving")))):
            found += streams(round(OTHER_STREAMS * arguments.streams), arguments.seed + 12 + number, beam, scene)
        data = Rows.joined([frames, *(stream.rows for stream in found)])
    else:
        others = strangers(arguments.signals, arguments.seed + 100)
    training = train_on_specimens(
        data,
        features=None if beam is None else BEAM_FEATURES,
        guards=None if beam is None else BEAM_GUARDS,
        family=arguments.family,
        seed=arguments.seed,
        judged_on=scenes[0].sha256,
        out_of_distribution=others,
    )
    if beam is not None:
        further = streams(arguments.streams // 2, arguments.seed + 11, beam)
        training = replace(training, model=finished(training.model, further))
    told["domain_shift"] = domain_shift(training.model)
    if arguments.acceleration:
        rival = force_model(scenes[0], arguments.signals, arguments.seed)
        told["beside_force"] = beside_force(training.model, scenes[0], rival)
    model = replace(training.model, training=training.model.training | told)
    model = simulated(model, arguments.seed)
    for path in write_model(replace(training, model=model), output, plots=True, further=sections(model)):
        print(path)
    note_version(output)
    low, high = training.metrics["accuracy_interval_95"]
    print(f"accuracy {training.metrics['accuracy']:.4f} (95 % interval {low:.4f} to {high:.4f})")


if __name__ == "__main__":
    main()
