"""Impacts of rock on a stiffened tail beam, and what its accelerometer records, made without `cgid`.

Rocks of the scene `tail_beam` fall on a beam of the same nominal size whose modes come from finite elements
(`independent_modes`): the ribs stand where they are, skin and webs shear, stretch and have rotary inertia. Rock and
modes are coupled: Hertz's contact with Hunt and Crossley's loss, each mode stepped exactly under a force that is linear
over a step, so the force feels the beam's give and its echoes. The recorder's samples are an inverse Laplace transform
on a line right of the poles: every mode, damper and filter enters by its exact transfer function.

    from benchmarks.beam.independent_beam import generate
    impacts = generate(1000, seed=7, variant="lump")
    impacts["acceleration"], impacts["labels"], impacts["impact_x"], impacts["peak_force"]

    python benchmarks/beam/independent_beam.py                              # its modes beside those of cgid
    python benchmarks/beam/independent_beam.py --out FILE.npz --n 1000 --variant dampers

A variant of your own: `replace(VARIANTS["lump"], ribs="shells", white=0.1)`. What `generate` reads is `modes_for`. The
first run for a kind of ribs takes a minute, five for shells; its modes are kept in the system's temporary folder.
Dampings, dampers, the lump and the machine's noise are assumed.
"""

from __future__ import annotations

import argparse
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from benchmarks.beam.independent_contact import Contact, Stepped, hunt_crossley_loss, residual, summary
from benchmarks.beam.independent_modes import Beam, Floats, Modes, Ribs, modes_of
from benchmarks.impact.rock_pulses import breaking, contact_of, draw, pink_noise

Complex = NDArray[np.complex128]
RATE, SAMPLES, PRE_TRIGGER = 25_600.0, 2048, 128
#: Modes are found up to here [Hz]: the anti-alias filter passes 2 % of what lies above.
HIGHEST = 17e3
SENSOR = (0.5, 0.45)
#: Frequency [Hz] and damping ratio of the mounting; edge [Hz] and order of the anti-alias filter.
_MOUNTING, _EDGE, _ORDER = (25e3, 0.05), 10e3, 8
#: Standard deviation of the white noise: 2 mg/sqrt(Hz) over half the sampling rate [m/s^2]; range [m/s^2] and bits.
NOISE = 2e-3 * 9.80665 * np.sqrt(RATE / 2)
_RANGE, _BITS = 500 * 9.80665, 16
_STEEL = 210e9 / (1 - 0.3**2)
_SCENE = Path(__file__).parents[2] / "datasets" / "tail_beam.toml"

#: Samples of a period of the inverse transform, its decay over a period, and its bandwidth in sampling rates.
_PERIOD, _DECAY, _BAND = 2560, 14.0, 1.5
#: Impacts transformed at once.
_AT_ONCE = 128


# -- the beam and what hangs on it ------------------------------------------------------------------------


class Attached(NamedTuple):
    """A damper at a point of the skin [N s/m]; with a mass [kg] and a spring [N/m], a lump of rock that lies there."""

    x: float
    y: float
    damper: float
    mass: float = np.inf
    spring: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A beam, its losses, and its noise.

    `ribs` and `mindlin` are those of `independent_modes.Beam`. `damping`: "constant", 2 % in every mode; "light", 1 %;
    "rayleigh", 2 % at 100 Hz and 5 kHz, .6 % between, 4 % at 10 kHz; "rising", 1 % plus 2 % times the frequency over
    10 kHz. `white` and `pink` are the standard deviations of the noise, `hum` the amplitudes at 50, 100, 150, ... Hz,
    all over `NOISE`.
    """

    ribs: Ribs = "beams"
    mindlin: float = 1.0
    damping: Literal["constant", "light", "rayleigh", "rising"] = "constant"
    attached: tuple[Attached, ...] = ()
    white: float = 1.0
    pink: float = 0.0
    hum: tuple[float, ...] = ()


_DAMPERS = (Attached(1.35, 0.25, 2e4), Attached(0.6, 1.15, 4e4), Attached(1.1, 0.75, 1e4))
#: A lump of 60 kg, about a twentieth of the beam, that rocks on its bed at 290 Hz with a tenth of critical damping.
_LUMP = (Attached(1.25, 0.95, 2.2e4, 60.0, 2e8),)
VARIANTS = {
    "plain": Variant(),
    "rayleigh": Variant(damping="rayleigh"),
    "rising": Variant(damping="rising"),
    "dampers": Variant(attached=_DAMPERS),
    "lump": Variant(attached=_LUMP),
    "machine": Variant(white=0.1, pink=1.0, hum=(1.0, 0.3, 0.5)),
}
VARIANTS |= {
    f"{name}, {ribs}": replace(VARIANTS[name], ribs=ribs) for name in VARIANTS for ribs in ("shells", "smeared", "none")
}
#: Thin and smeared as the package's own beam, but for a share of shear and rotary inertia.
VARIANTS |= {f"{share:g} mindlin": Variant(ribs="smeared", mindlin=share) for share in (0.001, 0.01, 0.03, 0.1)}


def damping_ratios(frequency: Floats, kind: str) -> Floats:
    """Return the damping ratio at frequencies [Hz]."""
    if kind == "rayleigh":
        low, high = 100.0, 5000.0
        return 0.02 * (low * high / frequency + frequency) / (low + high)
    if kind == "rising":
        return 0.01 + 0.02 * frequency / 10e3
    return np.full(frequency.shape, 0.01 if kind == "light" else 0.02)


@cache
def modes_for(variant: Variant, beam: Beam | None = None) -> Modes:
    return modes_of(replace(beam or Beam(), ribs=variant.ribs, mindlin=variant.mindlin), HIGHEST)


# -- rocks ------------------------------------------------------------------------------------------------


class Rocks(NamedTuple):
    """Drawn rocks, one array each."""

    labels: NDArray[np.str_]
    mass: Floats
    radius: Floats
    stiffness: Floats
    speed: Floats
    restitution: Floats
    x: Floats
    y: Floats


@cache
def _scene() -> dict[str, Any]:
    return tomllib.loads(_SCENE.read_text(encoding="utf-8"))


def rocks(n: int, rng: np.random.Generator) -> Rocks:
    """Draw n rocks and places of the scene; each label is as likely."""
    kinds = _scene()["populations"]
    label = rng.integers(len(kinds), size=n)
    drawn = [{key: draw(spec, rng, n) for key, spec in kind.items() if key != "label"} for kind in kinds]
    own = {name: np.choose(label, [kind[name] for kind in drawn]) for name in drawn[0]}
    place = {name: draw(spec, rng, n) for name, spec in _scene()["tail_beam"]["impact_point"].items()}
    modulus = 1 / ((1 - own["poisson_ratio"] ** 2) / own["youngs_modulus"] + 1 / _STEEL)
    return Rocks(
        np.array([kind["label"] for kind in kinds])[label],
        4 / 3 * np.pi * own["density"] * own["radius"] ** 3,
        own["radius"],
        4 / 3 * modulus * np.sqrt(own["radius"]),
        np.sqrt(2 * 9.80665 * own["drop_height"]),
        own["restitution"],
        place["x"],
        place["y"],
    )


class Contacts(NamedTuple):
    """What rocks have that touch as no spheres: stiffness [N/m^exponent], and depth [m] and force when they break."""

    stiffness: Floats
    exponent: Floats
    breaks: Floats
    left: Floats


def contacts(law: str, rock: Rocks, rng: np.random.Generator) -> Contacts:
    """Return the contacts of rocks by "sphere", or "cone", "face" or "fragmentation" of `rock_pulses`."""
    ones = np.ones(len(rock.mass))
    if law == "sphere":
        return Contacts(rock.stiffness, 1.5 * ones, np.inf * ones, ones)
    number, depth = rng.random((len(ones), 7)), (rock.mass * rock.speed**2 / rock.stiffness) ** 0.4
    unbroken = contact_of(law, number, rock.restitution, depth / rock.radius)[0](ones, 0 * ones, False)
    exponent = {"cone": 2.0, "face": 1.0}.get(law, 1.5)
    breaks, left = breaking(number) if law == "fragmentation" else (np.inf * ones, ones)
    stiffness = unbroken * rock.mass * rock.speed**2 / depth ** (exponent + 1)
    return Contacts(stiffness, exponent * ones, breaks * depth, left)


# -- recorder ---------------------------------------------------------------------------------------------


def chain(
    s: Complex, *, mounting: tuple[float, float] = _MOUNTING, edge: float = _EDGE, order: int = _ORDER
) -> Complex:
    """Return the gain of a mounting (frequency [Hz] and damping ratio) and of a Butterworth filter."""
    angular, ratio = 2 * np.pi * mounting[0], mounting[1]
    out = angular**2 / (s**2 + 2 * ratio * angular * s + angular**2)
    for k in range(order):
        pole = 2 * np.pi * edge * np.exp(1j * np.pi * (2 * k + order + 1) / (2 * order))
        out = out * -pole / (s - pole)
    return out


def laplace_points() -> Complex:
    lines = np.arange(int(_BAND * _PERIOD)) * RATE / _PERIOD
    return _DECAY * RATE / _PERIOD + 2j * np.pi * lines


def transfer(
    s: Complex,
    omega: Floats,
    damping: Floats,
    sensor: Floats,
    held: Floats,
    attached: Sequence[Attached],
    recorder: Callable[[Complex], Complex] = chain,
) -> Complex:
    """Return what multiplied by the shapes at a point gives recorded acceleration per force there, (n_modes, n_points).

    The receptance of the bare beam is `sum phi phi / (s^2 + 2 zeta omega s + omega^2)`. What is attached pushes by
    `-kappa w` and changes it by a matrix of its own size, exactly, whatever it does to the modes.
    """
    single = 1 / (s**2 + 2 * (damping * omega)[:, None] * s + (omega**2)[:, None])
    out = sensor[:, None] * single
    if attached:
        own = np.einsum("dm,em,mk->kde", held, held, single, optimize=True)
        for d, one in enumerate(attached):
            dynamic = one.damper * s + one.spring
            if np.isfinite(one.mass):
                dynamic = dynamic * one.mass * s**2 / (one.mass * s**2 + dynamic)
            own[:, d, d] += 1 / dynamic
        towards = np.einsum("m,dm,mk->kd", sensor, held, single, optimize=True)
        back = np.linalg.solve(own, towards[..., None])[..., 0]
        out -= (held.T @ back.T) * single
    return out * s**2 * recorder(s)


def spectra(contacts: Sequence[Contact], onset: Floats, s: Complex) -> Complex:
    """Return the Laplace transforms of the forces, linear between their steps, that touch at onset [s]."""
    out = np.empty((len(contacts), len(s)), complex)
    for row, (force, step, *_) in enumerate(contacts):
        length = round(_PERIOD / RATE / step)
        decaying = force * np.exp(-s[0].real * step * np.arange(len(force)))
        half = s * step / 2
        out[row] = fft.rfft(decaying, length)[: len(s)] * step * (np.sinh(half) / half) ** 2
    return out * np.exp(-onset[:, None] * s)


def sampled(spectrum: Complex, s: Complex) -> Floats:
    """Return the samples of the recorder, (n, SAMPLES), of signals with these Laplace transforms."""
    over = 2 * int(np.ceil(_BAND))
    fine = fft.irfft(spectrum, over * _PERIOD, axis=1)[:, ::over] * over * RATE
    return fine[:, :SAMPLES] * np.exp(s[0].real / RATE * np.arange(SAMPLES))


def noise_of(variant: Variant, n: int, rng: np.random.Generator) -> Floats:
    """Return the noise of n frames [m/s^2]."""
    out = variant.white * rng.standard_normal((n, SAMPLES))
    out += variant.pink * pink_noise(rng, n, SAMPLES)
    start = rng.uniform(0, 2 * np.pi, (n, 1))
    for k, amplitude in enumerate(variant.hum):
        out += amplitude * np.sin((k + 1) * (2 * np.pi * 50 / RATE * np.arange(SAMPLES) + start) + 0.7 * k)
    return NOISE * out


def record_at(rate: float) -> Callable[[Complex], Complex]:
    """Sample at another rate [Hz] from now on; return the recorder, whose filter ends at the same share of it."""
    global RATE, SAMPLES, PRE_TRIGGER, HIGHEST, NOISE, _PERIOD
    ratio = rate / RATE
    RATE, HIGHEST, NOISE = rate, HIGHEST * ratio, NOISE * np.sqrt(ratio)
    SAMPLES, PRE_TRIGGER, _PERIOD = round(SAMPLES * ratio), round(PRE_TRIGGER * ratio), round(_PERIOD * ratio)
    modes_for.cache_clear()
    return partial(chain, edge=_EDGE * ratio)


def digitised(signals: Floats) -> Floats:
    step = _RANGE / 2 ** (_BITS - 1)
    return np.clip(np.rint(signals / step) * step, -_RANGE, _RANGE - step)


# -- impacts ----------------------------------------------------------------------------------------------


def generate(
    n: int,
    seed: int,
    variant: str | Variant = "plain",
    *,
    noise: float = 1.0,
    sensors: Sequence[tuple[float, float]] = (SENSOR,),
    beam: Beam | None = None,
    given: Rocks | None = None,
    law: str = "sphere",
    recorder: Callable[[Complex], Complex] = chain,
    modes: Modes | None = None,
) -> dict[str, Any]:
    """Return n recorded impacts; equal seeds give equal rocks, places and touches, whatever the variant.

    The factor `noise` 0 leaves out noise and converter; `sensors` are points (x, y) [m]; `beam` has the ribs of the
    variant, unless its `modes` are given; `given` falls in place of rocks of the scene; `law` is that of `contacts`;
    `recorder` is the gain of mounting and filter. `acceleration` [m/s^2] is (n, 2048) or (n, n_sensors, 2048);
    durations are those to the first and the last separation [s].
    """
    variant = VARIANTS[variant] if isinstance(variant, str) else variant
    modes = modes or modes_for(variant, beam)
    omega = 2 * np.pi * modes.frequency
    damping = damping_ratios(modes.frequency, variant.damping)
    attached = variant.attached
    held = modes.shape(*np.array([one[:2] for one in attached]).T) if attached else np.zeros((0, len(omega)))
    linked = np.array([[one.damper, one.mass, one.spring] for one in attached]).reshape(-1, 3)
    ready = Stepped(omega, damping, held, linked, RATE)
    s = laplace_points()
    tables = [transfer(s, omega, damping, modes.shape(*place)[0], held, attached, recorder) for place in sensors]
    rng_rocks, rng_touch, rng_noise = (np.random.default_rng([seed, stream]) for stream in range(3))
    rock = given or rocks(n, rng_rocks)
    touching = contacts(law, rock, rng_rocks)
    onset = (PRE_TRIGGER + rng_touch.random(n)) / RATE
    loss = hunt_crossley_loss(rock.restitution)
    signals, truth = np.empty((len(sensors), n, SAMPLES)), []
    for first in range(0, n, _AT_ONCE):
        block = slice(first, min(first + _AT_ONCE, n))
        shapes = modes.shape(rock.x[block], rock.y[block])
        struck = [
            ready.strike(*one, exponent=exponent, breaks=breaks, left=left)
            for *one, exponent, breaks, left in zip(
                shapes, residual(omega, shapes), rock.mass[block], touching.stiffness[block], loss[block],
                rock.speed[block], *(part[block] for part in touching[1:]), strict=True,
            )
        ]  # fmt: skip
        truth += [summary(contact) for contact in struck]
        force = spectra(struck, onset[block], s)
        for table, out in zip(tables, signals, strict=True):
            out[block] = sampled(force * (shapes @ table), s)
    if noise:
        for out in signals:
            out[:] = digitised(out + noise * noise_of(variant, n, rng_noise))
    peak, duration, end, velocity = np.array(truth).reshape(-1, 4).T
    out = signals.astype(np.float32)
    return {
        "acceleration": out[0] if len(sensors) == 1 else np.moveaxis(out, 0, 1),
        "sampling_rate": RATE,
        "pre_trigger": PRE_TRIGGER,
        "labels": rock.labels,
        "onset": onset,
        "impact_x": rock.x,
        "impact_y": rock.y,
        "peak_force": peak,
        "contact_duration": duration,
        "end_of_contact": end,
        "restitution": -velocity / rock.speed,
        "material_restitution": rock.restitution,
        "velocity": rock.speed,
        "radius": rock.radius,
        "mass": rock.mass,
    }


# -- command ----------------------------------------------------------------------------------------------

_BANDS = (0.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0, 16_600.0)


def beside(variant: Variant) -> None:
    """Print our modes beside those of the package's beam, in bands."""
    from cgid.physics import STEEL, TailBeam
    from cgid.physics import Ribs as SmearedRibs

    ours = modes_for(variant)
    sizes = ours.beam
    theirs = TailBeam(
        material=STEEL,
        length=sizes.length,
        width=sizes.width,
        thickness=sizes.thickness,
        edges="cantilever",
        damping_ratio=0.02,
        ribs=None
        if variant.ribs == "none"
        else SmearedRibs(number=sizes.number, depth=sizes.depth, thickness=sizes.rib_thickness),
    ).modes(_BANDS[-1])
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(0.01, 1.59, 80), np.linspace(0.01, 1.39, 71)))
    own, other = ours.shape(x, y), theirs.shape(x, y)
    likeness = (own.T @ other) ** 2 / np.outer((own**2).sum(axis=0), (other**2).sum(axis=0))
    ratio = ours.frequency[:, None] / theirs.frequency
    partner = np.where(np.abs(np.log(ratio)) < 0.25, likeness, 0.0).argmax(axis=0)
    columns = np.arange(len(theirs.frequency))
    alike = likeness[partner, columns] * (np.abs(np.log(ratio[partner, columns])) < 0.25)
    frequency, damping = poles(ours, variant, _BANDS[-2])
    print(
        "band [Hz]      modes  cgid  alike  frequency off [%]: median  most  mobility  damping [%]: least median most"
    )
    for low, high in pairwise(_BANDS):
        here, there = ((f >= low) & (f < high) for f in (ours.frequency, theirs.frequency))
        paired = there & (alike > 0.5)
        off = 100 * (ratio[partner, columns] - 1)[paired]
        spread = "".join(f"{value:8.1f}" for value in (np.median(off), off[np.abs(off).argmax()])) if off.size else ""
        give = (own[:, here] ** 2).mean(axis=0).sum() / (other[:, there] ** 2).mean(axis=0).sum()
        lost = 100 * damping[(frequency >= low) & (frequency < high)]
        losses = "".join(f"{value:6.2f}" for value in np.percentile(lost, [0, 50, 100])) if lost.size else ""
        band, counts = f"{low:.0f} to {high:.0f}", f"{here.sum():5} {there.sum():5} {paired.sum():6}"
        print(f"{band:14} {counts} {spread:>33} {give:9.2f} {losses:>32}")


def poles(modes: Modes, variant: Variant, highest: float) -> tuple[Floats, Floats]:
    """Return frequencies [Hz] and damping ratios of the beam with what is attached, from its modes up to `highest`.

    These are the eigenvalues of q, q' and of the lumps' position and velocity.
    """
    some = modes.frequency < highest
    omega, n = 2 * np.pi * modes.frequency[some], np.count_nonzero(some)
    lumps = [one for one in variant.attached if np.isfinite(one.mass)]
    size = n + len(lumps)
    stiffness, damping = np.zeros((size, size)), np.zeros((size, size))
    stiffness[:n, :n] = np.diag(omega**2)
    damping[:n, :n] = np.diag(2 * damping_ratios(omega / (2 * np.pi), variant.damping) * omega)
    mass = np.ones(size)
    for one in variant.attached:
        row = np.zeros(size)
        row[:n] = modes.shape(one.x, one.y)[0, some]
        if one in lumps:
            row[n + lumps.index(one)], mass[n + lumps.index(one)] = -1.0, one.mass
        stiffness += one.spring * np.outer(row, row)
        damping += one.damper * np.outer(row, row)
    inverse = 1 / mass[:, None]
    found = np.linalg.eigvals(
        np.block([[np.zeros((size, size)), np.eye(size)], [-inverse * stiffness, -inverse * damping]])
    )
    found = found[found.imag > 0]
    return np.abs(found) / (2 * np.pi), -found.real / np.abs(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", default="plain", choices=VARIANTS, metavar="NAME", help=", ".join(VARIANTS))
    parser.add_argument("--n", type=int, default=1000, help="impacts to write")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--out", type=Path, help="npz file for the impacts")
    given = parser.parse_args()
    if given.out is None:
        beside(VARIANTS[given.variant])
        return
    start = time.perf_counter()
    made = generate(given.n, given.seed, given.variant)
    np.savez(given.out, **made)
    print(f"{given.out}: {given.n} impacts in {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()
