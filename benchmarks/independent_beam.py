"""Impacts of rock on a stiffened tail beam, and what its accelerometer records, made without `cgid`.

Rocks of the scene `tail_beam` fall on a beam of the same nominal size whose modes come from finite elements
(`independent_modes`): the ribs stand where they are, skin and webs shear, stretch and have rotary inertia. Rock and
modes are coupled: Hertz's contact with Hunt and Crossley's loss, each mode stepped exactly under a force that is linear
over a step, so the force feels the beam's give and its echoes. The recorder's samples are an inverse Laplace transform
on a line right of the poles: every mode, damper and filter enters by its exact transfer function.

    from independent_beam import generate
    impacts = generate(1000, seed=7, variant="lump")
    impacts["acceleration"], impacts["labels"], impacts["impact_x"], impacts["peak_force"]

    python benchmarks/independent_beam.py                              # its modes beside those of cgid
    python benchmarks/independent_beam.py --out FILE.npz --n 1000 --variant dampers

The first run for a kind of ribs takes minutes; its modes are kept in the system's temporary folder.
Dampings, dampers, the lump and the machine's noise are assumed.
"""

from __future__ import annotations

import argparse
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numba
import numpy as np
from independent_modes import Beam, Floats, Modes, Ribs, modes_of
from numpy.typing import NDArray
from rock_pulses import draw, pink_noise
from scipy import fft, linalg

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
_SCENE = Path(__file__).parents[1] / "datasets" / "tail_beam.toml"

#: Steps per sample for long contacts, fewest steps in a contact, and how many contacts the window lasts.
_FINE, _STEPS, _WINDOW = 32, 150, 4.0
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

    `ribs` and `mindlin` are those of `independent_modes.Beam`. `damping`: "constant", 2 % in every mode; "rayleigh", 2 % at 100 Hz and 5 kHz, .6 % between, 4 % at 10 kHz;
    "rising", 1 % plus 2 % times the frequency over 10 kHz. `white` and `pink` are the standard deviations of the noise
    over `NOISE`, `hum` the amplitudes at 50, 100, 150, ... Hz over `NOISE`.
    """

    ribs: Ribs = "beams"
    mindlin: float = 1.0
    damping: Literal["constant", "rayleigh", "rising"] = "constant"
    attached: tuple[Attached, ...] = ()
    white: float = 1.0
    pink: float = 0.0
    hum: tuple[float, ...] = ()


_DAMPERS = (Attached(1.35, 0.25, 4e3), Attached(0.6, 1.15, 8e3), Attached(1.1, 0.75, 2e3))
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
    return 0.01 + 0.02 * frequency / 10e3 if kind == "rising" else np.full(frequency.shape, 0.02)


@cache
def modes_for(variant: Variant, beam: Beam | None = None) -> Modes:
    """Return the modes of a variant, of unit modal mass, with `shape(x, y)`; without what is attached to it."""
    return modes_of(replace(beam or Beam(), ribs=variant.ribs, mindlin=variant.mindlin), HIGHEST)


def residual(omega: Floats, shapes: Floats) -> Floats:
    """Return the static compliance of all higher modes at each point [m/N].

    In a plate the squared shapes are spread evenly over frequency, so it is their density below the last mode over its
    frequency.
    """
    upper = omega > 0.7 * omega[-1]
    return (shapes[:, upper] ** 2).sum(axis=1) / (0.3 * omega[-1]) / omega[-1]


# -- rock and modes together ------------------------------------------------------------------------------


def stepping(omega: Floats, damping: Floats, step: float) -> Floats:
    """Return q and q' after a step from q, q' and a force that goes linearly from f to g, (n_modes, 2, 4).

    It is the exponential of the matrix of q, q', f and g - f.
    """
    generator = np.zeros((len(omega), 4, 4))
    generator[:, 0, 1] = step
    generator[:, 1, 0], generator[:, 1, 1], generator[:, 1, 2] = -(omega**2) * step, -2 * damping * omega * step, step
    generator[:, 2, 3] = 1.0
    grown = linalg.expm(generator)[:, :2]
    grown[:, :, 2] -= grown[:, :, 3]
    return np.ascontiguousarray(grown)


@numba.njit(cache=True, fastmath={"contract", "reassoc"}, error_model="numpy")
def _strike(stepped, shape, held, linked, mass, stiffness, loss, speed, step, window, force, state):
    """Step one rock through its contacts; return the number of steps and the rock's last velocity into the beam.

    `held` (n_attached, n_modes) are the shapes at what is attached, `linked` (n_attached, 3) its damper, mass and
    spring. The force of a step's end is found by Newton's method; attached forces lag by a step. `state` (2, n_modes)
    ends as the modes' q and q'.
    """
    n_modes, n_held = len(shape), len(linked)
    give = quick = 0.0  # displacement and velocity of the beam per force at the end of the step
    for r in range(n_modes):
        give += stepped[r, 0, 3] * shape[r] ** 2
        quick += stepped[r, 1, 3] * shape[r] ** 2
    give += step**2 / (6 * mass)
    quick += step / (2 * mass)
    depth, velocity, now = 0.0, speed, 0.0
    lump, lump_speed = np.zeros(n_held), np.zeros(n_held)
    pull = np.zeros(n_held)
    for k in range(1, len(force)):
        moved = moving = 0.0
        for r in range(n_modes):
            drive = now * shape[r]
            other = 0.0
            for d in range(n_held):
                other += pull[d] * held[d, r]
            q, u = state[0, r], state[1, r]
            both = drive * stepped[r, 0, 2] + other * (stepped[r, 0, 2] + stepped[r, 0, 3])
            state[0, r] = stepped[r, 0, 0] * q + stepped[r, 0, 1] * u + both
            both = drive * stepped[r, 1, 2] + other * (stepped[r, 1, 2] + stepped[r, 1, 3])
            state[1, r] = stepped[r, 1, 0] * q + stepped[r, 1, 1] * u + both
            moved += shape[r] * state[0, r]
            moving += shape[r] * state[1, r]
        depth += velocity * step - now * step**2 / (3 * mass)
        velocity -= now * step / (2 * mass)
        free, free_speed = depth - moved, velocity - moving
        new = now if now > 0 else 0.0
        for _ in range(30):
            overlap, rate = free - give * new, free_speed - quick * new
            if overlap <= 0:
                # The force that just keeps them in touch is above the root.
                trial = free / give if free > 0 else 0.0
                if new == 0.0 or trial == 0.0:
                    new = 0.0
                    break
                new = 0.5 * trial if new >= trial else new
                continue
            root = np.sqrt(overlap)
            lossy = 1 + loss * rate
            value = new - stiffness * root**3 * lossy
            slope = 1 + stiffness * (1.5 * root * give * lossy + root**3 * loss * quick)
            change = value / slope
            new -= change
            if abs(change) <= 1e-13 * abs(new) + 1e-12:
                break
        new = max(new, 0.0)
        depth -= new * step**2 / (6 * mass)
        velocity -= new * step / (2 * mass)
        for r in range(n_modes):
            state[0, r] += stepped[r, 0, 3] * new * shape[r]
            state[1, r] += stepped[r, 1, 3] * new * shape[r]
        for d in range(n_held):
            w = u = 0.0
            for r in range(n_modes):
                w += held[d, r] * state[0, r]
                u += held[d, r] * state[1, r]
            lump[d] += step * lump_speed[d]
            pull[d] = linked[d, 2] * (lump[d] - w) + linked[d, 0] * (lump_speed[d] - u)
            lump_speed[d] -= step * pull[d] / linked[d, 1]
        force[k] = now = new
        if k * step > window and new == 0.0:
            return k + 1, velocity
    return len(force), velocity


class Contact(NamedTuple):
    """A rock's force [N] at multiples of a step [s], its last velocity into the beam, and the modes' q and q'."""

    force: Floats
    step: float
    velocity: float
    state: Floats


def hunt_crossley_loss(restitution: Floats) -> Floats:
    """Return D of `F = K x^1.5 (1 + D x' / v)` by `D (1 + e) = ln((1 + D) / (1 - D e))`, by bisection."""
    low, high = np.zeros_like(restitution), (1 - 1e-15) / restitution
    for _ in range(200):
        middle = (low + high) / 2
        above = np.log1p(middle) - np.log1p(-middle * restitution) > middle * (1 + restitution)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.where(restitution < 1, middle, 0.0)


class Stepped:
    """A beam ready to be struck: its modes, their losses and what is attached; steps are kept by their number."""

    def __init__(self, omega: Floats, damping: Floats, held: Floats, linked: Floats) -> None:
        self.omega, self.damping, self.held, self.linked = omega, damping, held, linked
        self._kept: dict[float, tuple[Floats, Floats]] = {}

    def strike(
        self, shape: Floats, give: float, mass: float, stiffness: float, damping_number: float, speed: float, steps: int
    ) -> Contact:
        """Return the contact of one rock at a point with these shapes and static compliance of higher modes."""
        contact = 2.9432 * (1.25 * mass / stiffness) ** 0.4 * speed**-0.2  # Hertz's contact on a rigid wall
        finer = max(int(np.ceil(np.log2(steps / (contact * RATE * _FINE)))), 0)
        step = 1 / (RATE * _FINE * 2**finer)
        if step not in self._kept:
            # What higher modes give is one mode more, where an even spread of modes has its centre.
            omega = np.append(self.omega, np.sqrt(3) * self.omega[-1])
            self._kept[step] = stepping(omega, np.append(self.damping, self.damping[-1]), step), omega
        stepped, omega = self._kept[step]
        shape = np.append(shape, np.sqrt(give) * omega[-1])
        held = np.hstack([self.held, np.zeros((len(self.held), 1))])
        state, window = np.zeros((2, len(shape))), _WINDOW * contact
        force = np.zeros(int(6 * window / step))
        count, velocity = _strike(
            stepped,
            shape,
            held,
            self.linked,
            mass,
            stiffness,
            damping_number / speed,
            speed,
            step,
            window,
            force,
            state,
        )
        last = np.flatnonzero(force[:count] > 0)[-1]
        return Contact(force[: last + 2], step, velocity, state)


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


# -- recorder ---------------------------------------------------------------------------------------------


def chain(s: Complex) -> Complex:
    """Return the transfer of mounting and anti-alias filter."""
    angular, ratio = 2 * np.pi * _MOUNTING[0], _MOUNTING[1]
    out = angular**2 / (s**2 + 2 * ratio * angular * s + angular**2)
    for k in range(_ORDER):
        pole = 2 * np.pi * _EDGE * np.exp(1j * np.pi * (2 * k + _ORDER + 1) / (2 * _ORDER))
        out = out * -pole / (s - pole)
    return out


def laplace_points() -> Complex:
    """Return the points s [1/s] at which signals are transformed: lines of a period, moved right of the poles."""
    lines = np.arange(int(_BAND * _PERIOD)) * RATE / _PERIOD
    return _DECAY * RATE / _PERIOD + 2j * np.pi * lines


def transfer(
    s: Complex, omega: Floats, damping: Floats, sensor: Floats, held: Floats, attached: Sequence[Attached]
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
    return out * s**2 * chain(s)


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


def digitised(signals: Floats) -> Floats:
    """Return the signals clipped and rounded by the recorder's converter."""
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
) -> dict[str, Any]:
    """Return n recorded impacts; equal seeds give equal rocks, places and touches, whatever the variant.

    Parameters
    ----------
    n, seed : int
    variant : str or Variant
        A name of `VARIANTS`, or one of your own.
    noise : float
        Factor of the noise; 0 leaves out noise and converter.
    sensors : points (x, y) [m]
    beam : Beam, optional
        Sizes and elements; its ribs are those of the variant.

    Returns
    -------
    dict
        `acceleration` float32 (n, 2048) [m/s^2], or (n, n_sensors, 2048); `sampling_rate` [Hz], `pre_trigger`;
        per impact `labels`, `onset` [s], `impact_x`, `impact_y` [m], `peak_force` [N], `contact_duration` and
        `end_of_contact` [s] of first and last separation, `restitution` (rebound over speed), `material_restitution`,
        `velocity` [m/s], `radius` [m], `mass` [kg].
    """
    variant = VARIANTS[variant] if isinstance(variant, str) else variant
    modes = modes_for(variant, beam)
    omega = 2 * np.pi * modes.frequency
    damping = damping_ratios(modes.frequency, variant.damping)
    attached = variant.attached
    held = modes.shape(*np.array([one[:2] for one in attached]).T) if attached else np.zeros((0, len(omega)))
    linked = np.array([[one.damper, one.mass, one.spring] for one in attached]).reshape(-1, 3)
    ready = Stepped(omega, damping, held, linked)
    s = laplace_points()
    tables = [transfer(s, omega, damping, modes.shape(*place)[0], held, attached) for place in sensors]
    rng_rocks, rng_touch, rng_noise = (np.random.default_rng([seed, stream]) for stream in range(3))
    rock = rocks(n, rng_rocks)
    onset = (PRE_TRIGGER + rng_touch.random(n)) / RATE
    loss = hunt_crossley_loss(rock.restitution)
    signals, truth = np.empty((len(sensors), n, SAMPLES)), []
    for first in range(0, n, _AT_ONCE):
        block = slice(first, min(first + _AT_ONCE, n))
        shapes = modes.shape(rock.x[block], rock.y[block])
        given = zip(
            shapes, residual(omega, shapes), rock.mass[block], rock.stiffness[block], loss[block], rock.speed[block],
            strict=True,
        )  # fmt: skip
        contacts = [ready.strike(*one, _STEPS) for one in given]
        truth += [summary(contact) for contact in contacts]
        force = spectra(contacts, onset[block], s)
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


def summary(contact: Contact) -> tuple[float, float, float, float]:
    """Return peak force [N], duration of the first contact and end of the last [s], and the last velocity [m/s]."""
    force, step = contact.force, contact.step
    k = int(np.argmax(force))
    low, top, high = force[k - 1 : k + 2]
    peak = top - 0.125 * (high - low) ** 2 / (low - 2 * top + high)
    # Force falls to 0 as the depth to the power 3/2: the last two samples tell where.
    ends = np.flatnonzero((force[1:-1] > 0) & (force[2:] == 0)) + 1
    a, b = force[ends - 1] ** (2 / 3), force[ends] ** (2 / 3)
    after = np.where(a > b, np.minimum(b / np.maximum(a - b, 1e-300), 1.0), 1.0)
    last = (ends + after) * step
    return peak, last[0], last[-1], contact.velocity


# -- command ----------------------------------------------------------------------------------------------

_BANDS = (0.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0, 16_600.0)


def beside(variant: Variant) -> None:
    """Print our modes beside those of the package's beam, in bands."""
    from cgid.physics.materials import STEEL
    from cgid.physics.tail_beam import Ribs as SmearedRibs
    from cgid.physics.tail_beam import TailBeam

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
        give = (own[:, here] ** 2).mean(axis=0).sum() / (other[:, there] ** 2).mean(axis=0).sum() * theirs.modal_mass[0]
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
    """Print the modes beside those of cgid, or write impacts to a file."""
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
