"""How far a model of acceleration sees through its beam: places, forces, labels; other recorders, ringing, other beams.

    python benchmarks/beam/through_beam.py                                  # the shipped model, 4096 impacts a case
    python benchmarks/beam/through_beam.py MODEL -n 8192 --cases tail_beam quarters
    python benchmarks/beam/through_beam.py --cases sensors                  # one, two and three accelerometers
    python benchmarks/beam/through_beam.py --cases changed -n 512           # how often a changed beam is noticed
    python benchmarks/beam/through_beam.py --cases independent              # beams of finite elements
    python benchmarks/beam/through_beam.py --cases contacts -n 1024         # corners, faces, breaking rock, large lumps

The impacts are from a seed that no training uses. An impact that cannot be measured counts as wrong, and as unknown.
Accuracy is that of the most probable label, whether the answer is unknown or not; "answered" is that of the others.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cgid import shipped
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.model import Model
from cgid.identification.prediction import PredictionSettings, load_model
from cgid.identification.prediction.answers import UNKNOWN
from cgid.identification.prediction.stream import identify_blocks
from cgid.measure.features.extraction import extract_array
from cgid.measure.features.vibration import VibrationBatch
from cgid.measure.modal.beam import Beam, corrected
from cgid.measure.modal.modes import Modes, NodeShapes, nodes
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.synthesis.through_beam import beam_of, moved
from cgid.signals import Batch

SEED = 777_000_003
#: Sampling rates [kHz] with the edge of the anti-alias filter [kHz].
RATES = ((12.8, 5.0), (48.0, 18.75), (51.2, 20.0), (102.4, 40.0))
#: Places of accelerometers [m]: that of the scene and others; the middle line of the beam is y = .7 m.
SENSORS = {
    "off the middle line": ((0.5, 0.45),),
    "another": ((1.1, 1.0),),
    "both": ((0.5, 0.45), (1.1, 1.0)),
    "both and a third": ((0.5, 0.45), (1.1, 1.0), (0.9, 0.2)),
    "on the middle line": ((0.5, 0.7),),
    "two on the middle line": ((0.5, 0.7), (1.1, 0.7)),
    "one on, one off the middle line": ((0.5, 0.7), (1.1, 1.0)),
}
#: How long before an impact another one strikes [s].
GAPS = (10e-3, 30e-3)
#: Shares by which modes change, and numbers of impacts after which it may be noticed.
CHANGES = (0.0, 0.003, 0.01, 0.03)
#: A place that is wrong by more is far off [m].
FAR = 0.05
#: Law of `independent_beam` and seam of `anchor` of each contact: large lumps have 10 to 30 cm. They fall on a beam of
#: finite elements that is nearly the package's own. Radii of large lumps [m], log-uniform; noise over the peak.
CONTACTS = {
    "sphere": ("sphere", "shipped"),
    "cone": ("cone", "shipped"),
    "face": ("face", "shipped"),
    "fragmentation": ("fragmentation", "shipped"),
    "large lumps": ("sphere", "large"),
}
HOME, LARGE, NOISES = "0.001 mindlin", (0.05, 0.15), (0.01, 0.05)
#: An answer is for an impact that touched less than this before or after it [s].
NEAR = 4e-3
#: Columns of the table of contacts.
TOLD = {
    "known": "answered", "answered": "of the answered", "said": "said", "coal": "recall of coal",
    "gangue": "recall of gangue",
}  # fmt: skip
_CHUNK = 256


def changed(**changes: Any) -> Scene:
    """Return the scene tail_beam with other keys, `section.key` or `section.sub.key`; None removes one."""
    content = json.loads(load_scene(shipped.scene_path("tail_beam")).text)
    for path, value in changes.items():
        *sections, key = path.split("__")
        inner = content
        for section in sections:
            inner = inner.setdefault(section, {})
        inner.pop(key, None)
        if value is not None:
            inner[key] = value
    return parse_scene(content | {"name": "tail_beam, changed"})


def at_rate(rate: float, edge: float) -> Scene:
    samples = round(80 * rate)
    return changed(
        sampling__sampling_rate=f"{rate} kHz",
        sampling__samples=samples,
        sampling__pre_trigger=samples // 16,
        sensor__anti_alias__frequency=f"{edge} kHz",
    )


def cases(n: int) -> Iterator[tuple[str, str, Callable[[], Iterator[Batch]]]]:
    """Yield the kind and name of each case, and what makes its impacts."""
    own = changed()
    yield "tail_beam", "tail_beam", lambda: synthesise(own, n, SEED)
    for rate, edge in RATES:
        scene = at_rate(rate, edge)
        yield "rates", f"at {rate:g} kHz", lambda scene=scene: synthesise(scene, n, SEED)
    quiet = {"sensor__noise_density": None, "sensor__range": None, "sensor__bits": None, "sensor__relative_noise": 0.03}
    for name, more in (
        ("white noise, 3 % of the peak", {}),
        ("pink noise, 3 %", {"sensor__noise_exponent": 1.0}),
        ("white noise, 3 %, clipped at .7 of the peak", {"sensor__relative_range": 0.7}),
    ):
        scene = changed(**quiet, **more)
        yield "noise", name, lambda scene=scene: synthesise(scene, n, SEED)
    for gap in GAPS:
        yield "ringing", f"{1e3 * gap:g} ms after another", lambda gap=gap: after_another(synthesise(own, n, SEED), gap)


def after_another(batches: Iterator[Batch], gap: float) -> Iterator[Batch]:
    before = None
    for batch in batches:
        if before is not None and len(before.signals) == len(batch.signals):
            tail = before.signals[:, round(gap * batch.sampling_rate) :]
            signals = batch.signals.copy()
            signals[:, : tail.shape[1]] += tail
            yield replace(batch, signals=signals)
        before = batch


def together(points: Sequence[tuple[float, float]], n: int) -> Iterator[Batch]:
    """Yield the same impacts as several accelerometers record them, signals (n, n_sensors, n_samples).

    Each has white noise of its own, as loud as that of the scene.
    """
    own = changed()
    quiet = changed(sensor__noise_density=None, sensor__bits=None)
    noise = float(own.sensor.noise_level(np.zeros(1), own.sampling.sampling_rate)[0])
    random, scenes = np.random.default_rng(SEED), [moved(quiet, point) for point in points]
    for batches in zip(*(synthesise(scene, n, SEED) for scene in scenes), strict=True):
        first = batches[0]
        assert all((one.parameters["peak_force"] == first.parameters["peak_force"]).all() for one in batches)
        signals = np.stack([one.signals for one in batches], axis=1)
        signals = signals + random.normal(0, noise, signals.shape)
        yield replace(first, signals=signals if len(points) > 1 else signals[:, 0])


def several(model: Model, n: int) -> Iterator[tuple[str, dict[str, Any]]]:
    scene = changed()
    for name, points in SENSORS.items():
        through = replace(model)
        through.__dict__["beam"] = ThroughBeam(beam_of(scene, sensors=points))
        yield f"{len(points)}, {name}", judged(through, together(points, n))


def changes(model: Model, n: int) -> Iterator[str]:
    """Yield rows of accuracy and unexplained share by the change of the beam.

    Frequencies are off by that share, dampings by ten times as much, each mode by its own draw; three beams each.
    """
    assert model.beam is not None
    own, random = model.beam.beam, np.random.default_rng(SEED)
    beams = [(share, off(own, share, random)) for share in CHANGES for _ in range(3 if share else 1)]
    quiet = {"sensor__noise_density": None, "sensor__range": None, "sensor__bits": None}
    scenes = {"tail_beam": changed()}
    for share in (0.003, 0.03, 0.1, 0.3):
        scenes[f"white noise, {100 * share:g} % of the peak"] = changed(**quiet, sensor__relative_noise=share)
    scenes["pink noise, 3 %"] = changed(**quiet, sensor__relative_noise=0.03, sensor__noise_exponent=1.0)
    scenes["clipped at .7 of the peak"] = changed(**quiet, sensor__relative_noise=0.003, sensor__relative_range=0.7)
    for rate, edge in (RATES[0], RATES[2]):
        scenes[f"at {rate:g} kHz"] = at_rate(rate, edge)
    scenes["rocks of 8 to 20 cm from .2 to 1 m"] = slow_rocks()
    for name, scene in scenes.items():
        batches = list(synthesise(scene, n, SEED))
        cells = []
        for share in CHANGES:
            left, hits = [], []
            for beam in (ThroughBeam(beam) for other, beam in beams if other == share):
                for batch in batches:
                    seen = beam.measured(VibrationBatch(batch.signals, batch.sampling_rate, batch.pre_trigger))
                    left.append(seen["beam_unexplained"])
                    likely = model.probabilities(np.column_stack([seen[name] for name in model.features]))
                    hits.append(np.array(model.labels)[likely.argmax(axis=1)] == batch.labels)
            parts = np.split(np.concatenate(left), len(left) // len(batches))
            cells.append(f"{np.mean(np.concatenate(hits)):.3f}, {np.median(parts):.2f} %")
        yield f"| {name} | " + " | ".join(cells) + " |"


def off(beam: Beam, share: float, random: np.random.Generator) -> Beam:
    normal = random.normal(size=(2, len(beam.poles)))
    return corrected(beam, np.stack([share * normal[0], 10 * share * normal[1], np.zeros(len(beam.poles))]))


def slow_rocks() -> Scene:
    content = json.loads(changed().text)
    for population in content["populations"]:
        population["radius"] = {"distribution": "uniform", "lowest": 0.08, "highest": 0.2}
        population["drop_height"] = {"distribution": "uniform", "lowest": 0.2, "highest": 1.0}
    return parse_scene(content)


def judged(model: Model, batches: Iterator[Batch]) -> dict[str, Any]:
    assert model.beam is not None
    found: list[Any] = []
    spent = 0.0
    for batch in batches:
        start = time.process_time()
        values = extract_array(
            batch.signals, batch.sampling_rate, model.measured, pre_trigger=batch.pre_trigger, invalid="nan",
            beam=model.beam,
        )  # fmt: skip
        spent += time.process_time() - start
        sound = np.isfinite(values).all(axis=1)
        inputs, guards = np.split(values[sound], [len(model.features)], axis=1)
        likely = np.full((len(batch), 2), 0.5)
        likely[sound] = model.probabilities(inputs)
        novelty = np.full(len(batch), np.inf)
        novelty[sound] = model.novelty(inputs, guards)
        rows = batch.signals.reshape(-1, batch.signals.shape[-1])
        looked, contact = model.beam.look(VibrationBatch(rows, batch.sampling_rate, batch.pre_trigger))
        truth = batch.parameters
        apart = np.hypot(looked.x - truth["impact_x"], looked.y - truth["impact_y"])
        force = np.abs(np.log(contact.peak / truth["peak_force"]))
        energy = np.square(batch.signals).reshape(len(batch), -1).sum(axis=1)
        hit = np.array(model.labels)[likely.argmax(axis=1)] == batch.labels
        gangue = batch.labels == "gangue"
        found.append(np.column_stack([hit & sound, novelty > 1, likely.max(axis=1), apart, force, energy, gangue]))
    hit, unknown, sure, apart, force, energy, gangue = np.concatenate(found).T
    return answered(hit, unknown == 0, sure, gangue == 1) | {
        "calibration": calibration(sure, hit),
        "place": np.median(apart),
        "far": np.mean(apart > FAR),
        "peak": np.median(force),
        "us": 1e6 * spent / len(hit),
        "quarters": [hit[part].mean() for part in np.array_split(np.argsort(energy), 4)],
    }


def answered(hit: Any, told: Any, sure: Any, gangue: Any) -> dict[str, float]:
    """Return the figures of answers that are right, not unknown, as sure, and of gangue."""
    return {
        "n": len(hit),
        "accuracy": mean(hit),
        "answered": mean(hit[told]),
        "unknown": mean(~told),
        "known": mean(told),
        "said": mean(sure[told]),
        "coal": mean(hit[told & ~gangue]),
        "gangue": mean(hit[told & gangue]),
    }


def mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def calibration(sure: Any, hit: Any) -> float:
    number = np.clip(((sure - 0.5) * 20).astype(int), 0, 9)
    bins = [number == k for k in range(10) if (number == k).any()]
    return float(sum(abs(hit[own].mean() - sure[own].mean()) * own.mean() for own in bins))


def independent(model: Model, n: int, variants: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the answers on beams of finite elements: through the model's beam, and through the beam's own modes."""
    from benchmarks.beam import independent_beam as other

    assert model.beam is not None
    for name in variants:
        made = other.generate(n, SEED, name)
        for told, looked in (("the model's beam", model.beam), ("its own modes", own_modes(model.beam.beam, name))):
            through = replace(model)
            through.__dict__["beam"] = looked
            yield f"{name}, through {told}", judged(through, batches_of(made))


def own_modes(beam: Beam, name: str) -> ThroughBeam:
    """Return a beam to look through with the modes of a variant of finite elements."""
    from benchmarks.beam import independent_beam as other

    modes = other.modes_for(other.VARIANTS[name])
    damping = other.damping_ratios(modes.frequency, other.VARIANTS[name].damping)
    shape = beam.participation.shape[1:]
    x, y = (
        side.ravel()
        for side in np.meshgrid(nodes(shape[0], *beam.region[:2]), nodes(shape[1], *beam.region[2:]), indexing="ij")
    )
    at = modes.shape(x, y) * modes.shape(*(np.array([place]) for place in other.SENSOR))
    own = Modes(
        frequency=modes.frequency,
        damping_ratio=np.broadcast_to(damping, modes.frequency.shape),
        at_impact=NodeShapes(np.ascontiguousarray(at.T.reshape(-1, *shape)), beam.region),
        at_sensor=np.ones((1, modes.frequency.size)),
    )
    return ThroughBeam(replace(beam, modes=own))


def contacts(model: Model, n: int) -> Iterator[str]:
    """Yield rows of what the model says of contacts and sizes that are not those of its scene, by other code."""
    from benchmarks.beam import independent_beam as other

    assert model.beam is not None
    through = replace(model)
    through.__dict__["beam"] = own_modes(model.beam.beam, HOME)
    for name, (law, seam) in CONTACTS.items():
        rock = other.rocks(n, np.random.default_rng(SEED))
        if seam == "large":
            rock = larger(rock, np.random.default_rng([SEED, 1]))
        made = other.generate(n, SEED, HOME, noise=0.0, given=rock, law=law)
        noise = np.random.default_rng([SEED, 2]).standard_normal(made["acceleration"].shape)
        for level in NOISES:
            peak = np.abs(made["acceleration"]).max(axis=1, keepdims=True)
            noisy = made | {"acceleration": (made["acceleration"] + level * peak * noise).astype(np.float32)}
            yield row_of(f"{name}, {level:.0%}", judged(through, batches_of(noisy)))
    for name, (law, seam) in CONTACTS.items():
        yield row_of(f"{name}, in a stream", in_stream(through, n, law, seam))


def row_of(name: str, told: dict[str, Any]) -> str:
    cells = [f"{told[key]:.3f}" for key in TOLD]
    return f"| {name} | {' | '.join(cells)} |"


def in_stream(model: Model, n: int, law: str, seam: str) -> dict[str, Any]:
    """Return the answers for about n rocks, half of them gangue, that fall and bounce as in `anchor`."""
    from benchmarks.beam.anchor import ARRIVALS, SEAMS, stream
    from benchmarks.beam.independent_beam import RATE

    samples, onset, rock, is_gangue = stream(SEAMS[seam], n / ARRIVALS, 0.5, SEED, law)
    steps = identify_blocks([samples[None]], RATE, model, ("1",), PredictionSettings())
    answers = [answer for step in steps for answer in step.answers]
    near = np.array([np.abs(onset - answer.time).argmin() for answer in answers])
    gangue = is_gangue[rock[near]]
    true = np.abs(onset[near] - [answer.time for answer in answers]) < NEAR
    told = np.array([answer.label != UNKNOWN for answer in answers])
    likely = np.array([answer.probabilities.get("gangue", 0.5) for answer in answers])
    sure = np.maximum(likely, 1 - likely)
    return answered(*(part[true] for part in ((likely > 0.5) == gangue, told, sure, gangue)))


def larger(rock: Any, rng: np.random.Generator) -> Any:
    """Return rocks with radii of `LARGE`."""
    radius = LARGE[0] * (LARGE[1] / LARGE[0]) ** rng.random(len(rock.radius))
    ratio = radius / rock.radius
    return rock._replace(radius=radius, mass=rock.mass * ratio**3, stiffness=rock.stiffness * np.sqrt(ratio))


def batches_of(made: dict[str, Any]) -> Iterator[Batch]:
    names = ("impact_x", "impact_y", "peak_force")
    for first in range(0, len(made["labels"]), _CHUNK):
        part = slice(first, first + _CHUNK)
        yield Batch(
            signals=made["acceleration"][part],
            labels=made["labels"][part],
            specimen=np.arange(first, first + len(made["labels"][part]), dtype=np.uint64),
            parameters={name: made[name][part] for name in names},
            sampling_rate=float(made["sampling_rate"]),
            pre_trigger=int(made["pre_trigger"]),
            unit="m/s^2",
            source="independent beam",
        )


def printed(rows: list[tuple[str, dict[str, Any]]]) -> None:
    print(
        "| impacts | number | accuracy | answered | unknown | calibration error | place, median | far off | "
        "peak, median | us |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, row in rows:
        print(
            f"| {name} | {row['n']} | {row['accuracy']:.3f} | {row['answered']:.3f} | {row['unknown']:.3f} | "
            f"{row['calibration']:.3f} | {1e3 * row['place']:.1f} mm | {row['far']:.3f} | {row['peak']:.1%} | "
            f"{row['us']:.0f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default="default-acceleration")
    parser.add_argument("-n", "--signals", type=int, default=4096)
    kinds = ["tail_beam", "rates", "noise", "ringing", "sensors", "changed", "independent", "contacts"]
    parser.add_argument("--cases", nargs="+", default=kinds[:4], choices=kinds)
    parser.add_argument("--variants", nargs="+", default=["0.001 mindlin", "0.01 mindlin", "0.1 mindlin", "plain"])
    arguments = parser.parse_args()
    model = load_model(arguments.model)
    rows = []
    for kind, name, make in cases(arguments.signals):
        if kind in arguments.cases:
            rows.append((name, judged(model, make())))
            if kind == "tail_beam":
                quarters = ", ".join(f"{share:.3f}" for share in rows[-1][1]["quarters"])
                print(f"accuracy by quarter of the signal's energy, weakest first: {quarters}\n")
    if "sensors" in arguments.cases:
        rows += several(model, arguments.signals)
    if "changed" in arguments.cases:
        print("| impacts | " + " | ".join(f"{share:.1%} off" for share in CHANGES) + " |")
        print("|" + "---|" * (1 + len(CHANGES)))
        for line in changes(model, arguments.signals):
            print(line, flush=True)
    if "independent" in arguments.cases:
        rows += independent(model, arguments.signals, arguments.variants)
    if rows:
        printed(rows)
    if "contacts" in arguments.cases:
        print(f"| contact | {' | '.join(TOLD.values())} |\n|{'---|' * (len(TOLD) + 1)}")
        for line in contacts(model, arguments.signals):
            print(line, flush=True)


if __name__ == "__main__":
    main()
