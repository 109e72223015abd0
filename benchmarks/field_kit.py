"""The field kit on a beam that no training saw: accuracy after taps, drops, unlabelled and labelled impacts.

    python benchmarks/field_kit.py [--beam thin] [--seed 0] [--impacts 300] [--lumps 30] [--test 1024]

The beam is one of finite elements (`independent_beam`), made without `cgid`, with another build than its drawing, which
is the scene `tail_beam`; its recorder has a gain of its own. Each row is the model so far on the same further impacts.
The last row also has the accuracy that the kit itself expects.
"""

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import independent_beam as other
import numpy as np
import through_beam
from numpy.typing import NDArray
from scipy.signal import butter, fftconvolve, sosfilt

from cgid.errors import CgidError
from cgid.identification.contact import ThroughBeam
from cgid.identification.correction import correct
from cgid.identification.model import Model
from cgid.identification.prediction import load_model
from cgid.identification.rows import measure
from cgid.identification.training import train
from cgid.physics import HuntCrossley, Impact, Sphere
from cgid.physics.materials import STEEL
from cgid.physics.modes import LEARNED_COLUMNS, LearnedModes
from cgid.scene import Blow, Scene, calibrated, load_scene, parse_scene, synthesise
from cgid.scene.impacts import beam_modes
from cgid.scene.sections import rows_of
from cgid.scene.through_beam import beam_of
from cgid.signals import Signal
from cgid.site import calibrate, tap_test
from cgid.site.matching import matched

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Built:
    """A beam as it was built: what differs from its drawing, as factors; its losses, and the gain of its recorder."""

    factors: Mapping[str, float]
    gain: float
    mindlin: str = "0.01 mindlin"
    damping: str = "constant"

    @property
    def beam(self) -> other.Beam:
        """The beam of finite elements."""
        own = other.Beam()
        return replace(own, **{name: factor * getattr(own, name) for name, factor in self.factors.items()})

    @property
    def variant(self) -> other.Variant:
        """Its ribs and losses."""
        return replace(other.VARIANTS[self.mindlin], damping=self.damping)


#: Another plate; another steel, thicker, with less loss at low frequencies; other ribs, more shear, Rayleigh's losses.
BEAMS = {
    "thin": Built(factors={"length": 1.008, "width": 0.995, "thickness": 0.99, "depth": 1.01}, gain=0.85),
    "steel": Built(
        factors={"length": 0.994, "width": 1.006, "thickness": 1.012, "depth": 0.99, "youngs_modulus": 0.985},
        gain=1.2,
        damping="rising",
    ),
    "ribs": Built(
        factors={"width": 1.008, "depth": 0.985, "rib_thickness": 1.03, "density": 0.99},
        gain=0.95,
        mindlin="0.03 mindlin",
        damping="rayleigh",
    ),
}
#: Place of the taps [m], their number, the band in which modes are asked [Hz], and what the drawing may be off by.
TAP, TAPS, BAND, OFF = (1.1, 0.9), 6, (60.0, 1500.0), 0.02
#: Radius [m], heights [m] and place of the steel balls that are dropped.
BALL, HEIGHTS, PLACE = 0.02, (0.3, 0.4, 0.5, 0.6, 0.7), (1.2, 0.8)
_FINER = 4


def taps(built: Built, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return acceleration [m/s^2] and force [N] of taps by a sledge hammer with a force sensor."""
    modes = other.modes_for(built.variant, built.beam)
    damping = other.damping_ratios(modes.frequency, built.damping)
    low = modes.frequency < 6e3
    place, sensor = (modes.shape(*(np.array([side]) for side in at))[0][low] for at in (TAP, other.SENSOR))
    fine = other.RATE * _FINER
    force = np.zeros(round((1.0 + 1.5 * TAPS) * fine))
    for tap in range(TAPS):
        first, count = round((0.5 + 1.5 * tap + 0.02 * rng.random()) * fine), round(1e-3 * fine)
        force[first : first + count] = rng.uniform(5e3, 1e4) * np.sin(np.pi * (np.arange(count) + 0.5) / count)
    times, ring = np.arange(round(1.4 * fine)) / fine, np.zeros(round(1.4 * fine))
    for omega, zeta, part in zip(2 * np.pi * modes.frequency[low], damping[low], place * sensor, strict=True):
        ring += part * np.exp(-zeta * omega * times) * np.sin(omega * np.sqrt(1 - zeta**2) * times) / omega
    moved = fftconvolve(force, ring)[: force.size] / fine
    edge = butter(8, 10e3, fs=fine, output="sos")
    motion, push = (sosfilt(edge, one)[::_FINER] for one in (np.gradient(np.gradient(moved)) * fine**2, force))
    return built.gain * motion + rng.normal(0, other.NOISE, motion.size), push + rng.normal(0, 5.0, push.size)


def with_learned(scene: Scene, learned: LearnedModes) -> Scene:
    """Return the scene with learned modes."""
    content = json.loads(scene.text)
    content["tail_beam"]["learned"] = rows_of(learned, LEARNED_COLUMNS)
    return parse_scene(content)


def gain_of(scene: Scene, built: Built, seed: int) -> float:
    """Return the gain of the recorder that drops of a steel ball on a known place tell."""
    n = len(HEIGHTS)
    speed = np.sqrt(2 * 9.80665 * np.array(HEIGHTS))
    modulus = 210e9 / (1 - 0.3**2) / 2
    balls = other.Rocks(
        np.array(["ball"] * n),
        np.full(n, 4 / 3 * np.pi * 7850 * BALL**3),
        np.full(n, BALL),
        np.full(n, 4 / 3 * modulus * np.sqrt(BALL)),
        speed,
        np.full(n, 0.9),
        *(np.full(n, side) for side in PLACE),
    )
    made = other.generate(n, seed, built.variant, beam=built.beam, given=balls)
    blows = []
    for samples, v in zip(built.gain * made["acceleration"], speed, strict=True):
        motion = Signal(samples=samples, sampling_rate=other.RATE, unit="m/s^2", pre_trigger=other.PRE_TRIGGER)
        impact = dropped(scene, float(v))
        blows.append(Blow(motion=motion, impact=impact, impact_point=PLACE))
    found = calibrated(scene, blows)
    assert found.scene.sensor is not None
    return float(found.scene.sensor.gain)


def dropped(scene: Scene, speed: float) -> Impact:
    """Return the impact of the ball on the rigid body of the scene."""
    return Impact(
        sphere=Sphere(material=STEEL, radius=BALL),
        target=scene.body,
        velocity=speed,
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=0.9),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beam", choices=BEAMS, default="thin")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--impacts", type=int, default=300, help="unlabelled")
    parser.add_argument("--lumps", type=int, default=30, help="labelled impacts")
    parser.add_argument("--test", type=int, default=1024)
    parser.add_argument("--signals", type=int, default=8000, help="simulated, to train on")
    asked = parser.parse_args()
    built, rng, scene = BEAMS[asked.beam], np.random.default_rng(asked.seed), load_scene("tail_beam")
    n = asked.impacts + asked.lumps + asked.test
    made = other.generate(n, 777_000_001 + asked.seed, built.variant, beam=built.beam)
    made["acceleration"] = built.gain * made["acceleration"]

    def part(first: int, last: int, gain: float = 1.0) -> dict[str, Any]:
        own = {key: value[first:last] if np.ndim(value) else value for key, value in made.items()}
        return own | {"acceleration": own["acceleration"] / gain}

    def row(name: str, model: Model, gain: float = 1.0, more: str = "") -> None:
        found = through_beam.judged(model, through_beam.batches_of(part(asked.impacts + asked.lumps, n, gain)))
        shares = " | ".join(f"{found[key]:.3f}" for key in ("accuracy", "answered", "unknown", "calibration"))
        spent = f"{time.process_time() - begun:.0f} s"
        print(f"| {name} | {shares} | {1e3 * found['place']:.0f} mm | {spent} | {more} |", flush=True)

    begun = time.process_time()
    print("| after | accuracy | of the answered | unknown | calibration error | place, median | so far | told |")
    print("|---|---|---|---|---|---|---|---|")
    shipped = load_model("default-acceleration")
    row("nothing: the default model", shipped)
    response, force = taps(built, rng)
    test = tap_test(response[None], other.RATE, hammer=force, band=BAND)
    own = beam_modes(scene)
    learned, known = matched(test, own.frequency, own.damping_ratio, OFF)
    tapped = with_learned(scene, learned)
    row("taps", through(shipped, tapped), more=f"{test.frequency.size} modes found, {int(known.sum())} matched")
    found = calibrate(
        tapped,
        part(0, asked.impacts)["acceleration"],
        other.RATE,
        other.PRE_TRIGGER,
        start_error=OFF,
        participation_error=0.2,
        most_blows=asked.impacts,
    )
    told = f"evidence {found.before:.3g} to {found.after:.3g}, {found.expected:.3g} expected"
    row(f"{asked.impacts} unlabelled impacts", through(shipped, found.scene), more=told)
    try:
        gain = gain_of(found.scene, built, asked.seed)
        row(f"{len(HEIGHTS)} drops of a steel ball", through(shipped, found.scene), gain, f"gain {gain:.3f}")
    except CgidError as error:
        gain = 1.0
        print(f"| drops | refused: {error} |")
    training = train(synthesise(found.scene, asked.signals, 4242 + asked.seed), beam=beam_of(found.scene))
    row("training on the site's simulation", training.model, gain)
    lumps = part(asked.impacts, asked.impacts + asked.lumps, gain)
    assert training.model.beam is not None
    rows = measure(through_beam.batches_of(lumps), training.model.measured, beam=training.model.beam.beam)
    correction = correct(training.model, rows)
    low, high = correction.after["accuracy_interval_95"]
    expects = f"expects {correction.after['accuracy']:.2f} ({low:.2f} to {high:.2f})"
    row(f"{asked.lumps} labelled lumps", correction.model, gain, expects)


def through(model: Model, site: Scene) -> Model:
    """Return the model that looks through the beam of a site."""
    moved = replace(model)
    moved.__dict__["beam"] = ThroughBeam(beam_of(site))
    return moved


if __name__ == "__main__":
    main()
