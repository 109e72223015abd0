"""Impacts of rock by five laws, and what a recorder makes of them, by numpy and scipy alone.

Nothing here comes from `cgid`, so that a figure of `rock.py` does not judge the package by its own physics. A rock of
mass m and radius R falls at v on a half space of steel (E 210 GPa, nu .3). Contact is Hertz's, K = 4/3 E* sqrt(R).
In units of the depth (m v^2 / K)^(2/5) and of depth / v, with x the approach:

* Hunt-Crossley `F = x^(3/2) (1 + D x')`, Kuwabara-Kono `F = x^(3/2) + A sqrt(x) x'` until the force is 0: one pulse for
  each restitution, integrated once by DOP853 and interpolated (`viscous`).
* Thornton (1997), J. Appl. Mech. 64, 383: Hertz's loading up to yield, then force linear in the approach, then Hertz's
  unloading with a larger radius. Hertz's pulse is an incomplete beta function, the linear part a sine (`thornton`).
* Walton and Braun (1986), J. Rheol. 30, 949: two springs, the first as deep as Hertz's contact without loss.
* Contacts that are no spheres, and rocks that break (`OTHERS`), integrated by Runge-Kutta's steps of all rocks at once
  (`stepped`): a cone of 60 to 80 degrees half angle and a flat face of .1 to .4 of the radius (Sneddon 1965), a sphere
  that loses .3 to .7 of its force where x^(3/2) is .4 to .9 of its largest without loss (never if damping stops it
  before), a layer of dust (x^3, then Hertz), loss by hysteresis (unloading at e^2 of the force), two points and six
  asperities of different heights. All but hysteresis are damped as Hunt and Crossley's sphere; sizes are assumed.

    from benchmarks.impact.rock_pulses import CASES, record
    impacts = record(CASES["kuwabara-kono"], 4096, seed=7)
    impacts.signals, impacts.labels
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, RectBivariateSpline
from scipy.special import beta, betainc, betaincinv

Floats = NDArray[np.float64]
Law = str
OTHERS = ("cone", "face", "fragmentation", "dust", "hysteresis", "two points", "six asperities")
LAWS: tuple[Law, ...] = ("hunt-crossley", "kuwabara-kono", "thornton", "thornton by strength", "walton-braun")
#: E / (1 - nu^2) of the steel [Pa].
_STEEL = 210e9 / (1 - 0.3**2)
_GRAVITY = 9.80665
#: Contact yield over uniaxial strength, median strengths [Pa] (assumed) and the sigma of their logarithm.
_YIELD_OVER_STRENGTH, _STRENGTHS, _STRENGTH_SIGMA = 1.6, {"coal": 16e6, "gangue": 45e6}, 0.4
RATE, SAMPLES = 200e3, 2048
#: Depth and half duration of Hertz's impact without loss, in units of the scaled equation.
_DEPTH = 1.25**0.4
_HALF = 0.8 * _DEPTH * 0.5 * beta(0.4, 0.5)


# -- pulses: peak, duration and shape in scaled units -----------------------------------------------------


class Viscous(NamedTuple):
    """Pulses of a viscous law by restitution: duration, peak, loss parameter, and force over peak at s."""

    restitution: Floats
    duration: CubicSpline
    peak: CubicSpline
    loss: CubicSpline
    force: RectBivariateSpline


def integrate(law: str, loss: float) -> tuple[float, float, Any]:
    """Return restitution, duration and the force as a function of time, by DOP853 with an event at separation.

    It runs in p, with time = p^2, in which the start of both laws is smooth.
    """
    damped = law == "hunt-crossley"

    def force(x: Any, v: Any) -> Any:
        x = np.maximum(x, 0.0)
        return x**1.5 * (1 + loss * v) if damped else np.sqrt(x) * (x + loss * v)

    def slope(p: float, state: Floats) -> list[float]:
        x, v = state
        return [2 * p * v, -2 * p * float(force(x, v))]

    def separated(p: float, state: Floats) -> float:
        x, v = state
        return 1.0 if v > 0 else float(x if damped else x + loss * v)

    separated.terminal, separated.direction = True, -1  # type: ignore[attr-defined]
    run = solve_ivp(
        slope, (0.0, 20.0), [0.0, 1.0], "DOP853", events=separated, rtol=1e-12, atol=1e-14, dense_output=True
    )
    end = float(run.t_events[0][0])
    return -float(run.y_events[0][0][1]), end**2, lambda t: force(*run.sol(np.sqrt(t)))


@cache
def viscous(law: Law) -> Viscous:
    """Return the pulses of a viscous law, tabulated over restitution and s, share of contact = sin^2(pi s / 2)."""
    s = np.linspace(0, 1, 257)
    # Losses such that restitutions are spaced evenly, roughly.
    wanted = np.concatenate([np.linspace(1.0, 0.1, 145), np.geomspace(0.097, 0.02, 40)])
    losses = (1 / wanted - 1) * (1.0 + 0.5 / wanted if law == "kuwabara-kono" else 1.0)
    rows = []
    for loss in losses[::-1]:
        e, duration, force = integrate(law, float(loss))
        curve = np.asarray(force(duration * np.sin(np.pi / 2 * s) ** 2))
        curve[0] = curve[-1] = 0.0
        fine = np.asarray(force(duration * np.linspace(0, 1, 4001)))
        rows.append((e, duration, _top(fine), loss, curve))
    e, duration, peak, loss = (np.array(column) for column in list(zip(*rows, strict=True))[:4])
    table = np.array([row[-1] for row in rows]) / peak[:, None]
    return Viscous(
        e,
        CubicSpline(e, duration),
        CubicSpline(e, peak),
        CubicSpline(e, loss),
        RectBivariateSpline(e, s, table, kx=3, ky=3, s=0),
    )


def _top(values: Floats) -> float:
    k = int(np.clip(np.argmax(values), 1, len(values) - 2))
    low, top, high = values[k - 1 : k + 2]
    return float(top - 0.125 * (high - low) ** 2 / (low - 2 * top + high))


@cache
def _hertz_loading() -> CubicSpline:
    root = np.linspace(0, 1, 2049)
    return CubicSpline(root, betaincinv(0.4, 0.5, root**2) ** 0.6)


def hertz_loading(share: Floats) -> Floats:
    return np.asarray(_hertz_loading()(np.sqrt(np.clip(share, 0, 1))))


def thornton_restitution(ratio: Any) -> Any:
    """Return the restitution at yield speed over speed r, 1 from r = 1 on. Thornton (1997)."""
    r = np.minimum(ratio, 1.0)
    left = np.sqrt(1.2 * np.sqrt(3.0) * (1 - r**2 / 6))
    return left * (r / (r + 2 * np.sqrt(1.2 - 0.2 * r**2))) ** 0.25


@cache
def _log_ratio() -> CubicSpline:
    log_ratio = np.linspace(np.log(1e-9), 0.0, 8001)
    return CubicSpline(np.log(thornton_restitution(np.exp(log_ratio))), log_ratio)


def yield_ratio(restitution: Floats) -> Floats:
    return np.exp(np.minimum(_log_ratio()(np.log(restitution)), 0.0))


class Thornton(NamedTuple):
    """The three branches: when each ends, peak force, phase and pace of the sine, and the restitution."""

    first: Floats
    second: Floats
    third: Floats
    peak: Floats
    phase: Floats
    pace: Floats
    restitution: Floats

    def force(self, t: Floats, row: NDArray[np.intp]) -> Floats:
        """Return force over peak at times t of these rows."""
        first, second, third = self.first[row], self.second[row], self.third[row]
        rising = hertz_loading(t / _HALF) * _DEPTH**1.5 / self.peak[row]
        yielding = np.sin(self.phase[row] + self.pace[row] * (t - first))
        falling = hertz_loading((third - t) / (third - second))
        return np.where(t < first, rising, np.where(t < second, yielding, falling))


def thornton(ratio: Floats) -> Thornton:
    """Return Thornton's impact for yield speed over speed, in scaled units; elastic from 1 on."""
    r = np.minimum(ratio, 1.0)
    depth = _DEPTH * r**0.8  # at yield: (4/5) depth^(5/2) = r^2
    first = _HALF * betainc(0.4, 0.5, r**2)
    stiffness = 1.5 * np.sqrt(depth)
    pace = np.sqrt(stiffness)
    offset, speed = depth / 1.5, np.sqrt(1 - r**2)  # force over stiffness, and speed, at yield
    farthest = np.hypot(offset, speed / pace)
    phase = np.arctan2(offset * pace, speed)
    peak, yield_force = stiffness * farthest, depth**1.5
    flattened = ((2 * peak + yield_force) / (3 * np.sqrt(depth))) ** 1.5 / peak  # its radius over that of the sphere
    back = (peak / np.sqrt(flattened)) ** (2 / 3)
    e = np.sqrt(0.8 * peak * back)
    second = first + (np.pi / 2 - phase) / pace
    return Thornton(first, second, second + _HALF * back / _DEPTH / e, peak, phase, pace, e)


# -- rocks ------------------------------------------------------------------------------------------------

Bounds = tuple[Literal["uniform", "log-uniform"], float, float]
_BOUNDS = ("distribution", "lowest", "highest")
Spec = Mapping[str, Any]
_UNITS = {"kg/m^3": 1.0, "GPa": 1e9, "mm": 1e-3, "m": 1.0, "m/s": 1.0}
_SCENES = Path(__file__).parents[2] / "datasets"


def _number(value: float | str) -> float:
    if isinstance(value, str):
        number, unit = value.split()
        return float(number) * _UNITS[unit]
    return float(value)


@cache
def population(name: str) -> Mapping[str, Spec]:
    """Return the distributions of each label in `reference` or `peers`; `dull`: `reference` with wet, broken rock."""
    scene = tomllib.loads((_SCENES / f"{name.replace('dull', 'reference')}.toml").read_text())
    found = {kind["label"]: kind for kind in scene["populations"]}
    if name == "dull":
        for label, (low, high) in {"coal": (0.15, 0.40), "gangue": (0.30, 0.60)}.items():
            found[label]["restitution"] = {"distribution": "uniform", "lowest": low, "highest": high}
    return found


def draw(spec: Spec, rng: np.random.Generator, n: int) -> Floats:
    number = {name: _number(value) for name, value in spec.items() if name != "distribution"}
    match spec["distribution"]:
        case "uniform":
            return rng.uniform(number["lowest"], number["highest"], n)
        case "log-uniform":
            return np.exp(rng.uniform(np.log(number["lowest"]), np.log(number["highest"]), n))
        case "lognormal":
            return number["median"] * np.exp(rng.normal(0, number["sigma"], n))
        case "normal":
            return rng.normal(number["mean"], number["deviation"], n)
        case "truncated-normal":
            mean, deviation = number["mean"], number["deviation"]
            low, high = ((number[bound] - mean) / deviation for bound in ("lowest", "highest"))
            return np.asarray(stats.truncnorm.rvs(low, high, mean, deviation, n, random_state=rng))
    raise ValueError(f"no distribution {spec['distribution']}")


class Rocks(NamedTuple):
    """Drawn rocks, one array each: label, mass [kg], radius [m], effective modulus [Pa], speed [m/s], restitution, law.

    `yield_pressure` [Pa] is nan for laws without. Radius and mass are those of the contact: curvature and eccentricity
    are in them.
    """

    labels: NDArray[np.str_]
    mass: Floats
    radius: Floats
    modulus: Floats
    speed: Floats
    restitution: Floats
    law: NDArray[np.intp]
    yield_pressure: Floats
    #: Uniform numbers of what a law of `OTHERS` has beside, (n, 7).
    other: Floats


def rocks(case: Case, n: int, rng: np.random.Generator) -> Rocks:
    """Draw n rocks, half of each label in random order."""
    kinds = population(case.population)
    label = rng.permutation(np.arange(n) % len(kinds))
    own: dict[str, Floats] = {}
    for k, kind in enumerate(kinds.values()):
        here = np.flatnonzero(label == k)
        for name, spec in kind.items():
            if name != "label":
                own.setdefault(name, np.empty(n))[here] = draw(spec, rng, len(here))
    radius, speed = own["radius"], own["velocity"] if "velocity" in own else np.sqrt(2 * _GRAVITY * own["drop_height"])
    modulus = 1 / ((1 - own["poisson_ratio"] ** 2) / own["youngs_modulus"] + 1 / _STEEL)
    law = np.array([(*LAWS, *OTHERS).index(name) for name in case.laws])[rng.integers(len(case.laws), size=n)]
    curvature, share = (
        np.ones(n) if bounds is None else draw(dict(zip(_BOUNDS, bounds, strict=True)), rng, n)
        for bounds in (case.curvature, case.mass_share)
    )
    labels = np.array(list(kinds))[label]
    strength = np.array([_STRENGTHS[name] for name in kinds])[label] * np.exp(rng.normal(0, _STRENGTH_SIGMA, n))
    pressure = np.where(law == LAWS.index("thornton by strength"), _YIELD_OVER_STRENGTH * strength, np.nan)
    mass = 4 / 3 * np.pi * own["density"] * radius**3 * share
    return Rocks(
        labels, mass, radius * curvature, modulus, speed, own["restitution"], law, pressure, rng.random((n, 7))
    )


#: Steps of `stepped` in units of depth over speed, and the most of them.
_STEP, _MAX_STEPS = 0.004, 6000


def breaking(number: Floats) -> tuple[Floats, Floats]:
    """Return the depth where a rock breaks, in Hertz's scaled units, and the part of its force that is left."""
    return (0.4 + 0.5 * number[:, 0]) ** (2 / 3) * _DEPTH, 0.3 + 0.4 * number[:, 1]


def contact_of(law: str, number: Floats, e: Floats, softness: Floats) -> tuple[Any, Floats]:
    """Return the force without damping as a function of approach, deepest approach and whether it returns; its depth.

    Everything is in Hertz's scaled units, in which `softness` is the depth over the radius; numbers are uniform.
    """
    first = number[:, 0]
    if law == "cone":
        slope = np.tan(np.radians(60 + 20 * first))
        k = (2 / np.pi) * slope / (4 / 3) * np.sqrt(softness)
        return (lambda x, top, back: k * x**2), (1.5 / k) ** (1 / 3)
    if law == "face":
        k = 2 * 0.1 * 4**first / (4 / 3) / np.sqrt(softness)
        return (lambda x, top, back: k * x), 1 / np.sqrt(k)
    depth = np.full(len(e), _DEPTH)
    if law == "fragmentation":
        breaks, left = breaking(number)
        return (lambda x, top, back: np.where(top >= breaks, left, 1.0) * x**1.5), depth
    if law == "dust":
        thick = (0.1 + 0.2 * first) * _DEPTH
        return (lambda x, top, back: np.where(x < thick, thick**-1.5 * x**3, x**1.5)), depth
    if law == "hysteresis":
        return (lambda x, top, back: np.where(back, e**2, 1.0) * x**1.5), depth
    if law == "two points":
        gap = (0.2 + 0.4 * first) * _DEPTH
        return (lambda x, top, back: np.sqrt(0.5) * (x**1.5 + np.maximum(x - gap, 0) ** 1.5)), depth
    gaps = 0.3 * _DEPTH * np.column_stack([np.zeros(len(e)), number[:, :5]])
    return (lambda x, top, back: (np.maximum(x[:, None] - gaps, 0) ** 1.5).sum(axis=1) / 3), depth


def stepped(law: str, number: Floats, e: Floats, softness: Floats) -> tuple[Floats, Floats, Floats]:
    """Return peak, duration and force (n, steps) of impacts of a law of `OTHERS`, in Hertz's scaled units."""
    elastic, depth = contact_of(law, number, e, softness)
    loss = np.zeros(len(e)) if law == "hysteresis" else np.asarray(viscous("hunt-crossley").loss(e))
    step, x, v = _STEP * depth, np.zeros(len(e)), np.ones(len(e))
    top, duration, forces = np.zeros(len(e)), np.full(len(e), np.nan), [np.zeros(len(e))]

    def force(x: Floats, v: Floats) -> Floats:
        x = np.maximum(x, 0)
        return np.asarray(np.maximum(elastic(x, np.maximum(top, x), v < 0) * (1 + loss * v), 0))

    for number_of_step in range(1, _MAX_STEPS):
        a1 = -force(x, v)
        a2 = -force(x + 0.5 * step * v, v + 0.5 * step * a1)
        a3 = -force(x + 0.5 * step * (v + 0.5 * step * a1), v + 0.5 * step * a2)
        a4 = -force(x + step * (v + 0.5 * step * a2), v + step * a3)
        after = x + step * (v + step / 6 * (a1 + a2 + a3))
        v = v + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        top, apart = np.maximum(top, after), np.isnan(duration) & (after <= 0)
        duration[apart] = (step * (number_of_step - 1 + x / np.maximum(x - after, 1e-300)))[apart]
        x = after
        forces.append(np.where(np.isnan(duration), force(x, v), 0.0))
        if not np.isnan(duration).any():
            break
    curves = np.array(forces).T
    return curves.max(axis=1), duration, curves


class Pulses(NamedTuple):
    """Peak [N], duration [s] and restitution of each rock's pulse, and its force over peak at times since touch."""

    peak: Floats
    duration: Floats
    restitution: Floats
    force: Any


def pulses(rock: Rocks) -> Pulses:
    stiffness = 4 / 3 * rock.modulus * np.sqrt(rock.radius)
    depth = (rock.mass * rock.speed**2 / stiffness) ** 0.4
    unit_time, unit_force = depth / rock.speed, rock.mass * rock.speed**2 / depth
    crushed = np.isin(rock.law, [LAWS.index("thornton"), LAWS.index("thornton by strength")])
    # Yield: pressure = 2 E* / pi sqrt(depth / radius), and r^2 = (4/5) depth^(5/2) in scaled units.
    yield_depth = rock.radius * (np.pi * rock.yield_pressure / (2 * rock.modulus)) ** 2 / depth
    ratio = np.where(np.isnan(yield_depth), 1.0, np.sqrt(0.8 * yield_depth**2.5))
    given = rock.law == LAWS.index("thornton")
    ratio[given] = yield_ratio(rock.restitution[given])
    plastic = thornton(ratio)
    e = np.where(crushed, plastic.restitution, rock.restitution)
    peak, duration = np.empty_like(e), np.empty_like(e)
    curves: dict[int, Floats] = {}
    for k, law in enumerate((*LAWS, *OTHERS)):
        own = rock.law == k
        if law in OTHERS and own.any():
            softness = (depth / rock.radius)[own]
            peak[own], duration[own], curves[k] = stepped(law, rock.other[own], e[own], softness)
        elif law in ("hunt-crossley", "kuwabara-kono") and own.any():
            table = viscous(law)
            peak[own], duration[own] = table.peak(e[own]), table.duration(e[own])
        elif law == "walton-braun":
            peak[own], duration[own] = 1 / _DEPTH, np.pi / 2 * _DEPTH * (1 + e[own])
        else:
            peak[own], duration[own] = plastic.peak[own], plastic.third[own]

    def force(time: Floats, row: NDArray[np.intp]) -> Floats:
        """Return force over peak at times [s] since touch, of rows of the rocks; 0 outside contact."""
        t = time / unit_time[row]
        share = t / duration[row]
        out = np.zeros(len(t))
        inside = (share > 0) & (share < 1)
        for k, law in enumerate((*LAWS, *OTHERS)):
            here = np.flatnonzero(inside & (rock.law[row] == k))
            who = row[here]
            if not len(here):
                continue
            if law in ("hunt-crossley", "kuwabara-kono"):
                s = 2 / np.pi * np.arcsin(np.sqrt(share[here]))
                out[here] = viscous(law).force.ev(e[who], s)
            elif law in OTHERS:
                own = (np.cumsum(rock.law == k) - 1)[who]
                step = _STEP * contact_of(law, rock.other, e, depth / rock.radius)[1][who]
                left = np.minimum((t[here] / step).astype(np.intp), curves[k].shape[1] - 2)
                low, high = curves[k][own, left], curves[k][own, left + 1]
                out[here] = (low + (high - low) * (t[here] / step - left)) / peak[who]
            elif law == "walton-braun":
                turn = 1 / (1 + e[who])
                angle = np.where(share[here] < turn, share[here] / turn, (1 - share[here]) / (1 - turn))
                out[here] = np.sin(np.pi / 2 * angle)
            else:
                out[here] = plastic.force(t[here], who)
        return out

    return Pulses(peak * unit_force, duration * unit_time, e, force)


# -- recorder ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Case:
    """Rocks and recorder of one line of the table.

    `noise` is the white noise's standard deviation over the peak, `pink` that of noise of power 1 / f, `hum` the
    amplitude of a sine at 50 Hz over the peak. `bits` quantise 1.25 of the rock's own peak, or the largest peak of the
    population (`range`), to either side of 0. `edge` [Hz] is that of a causal Butterworth filter of order 8 ahead of
    the noise. `clipped` is the limit over the peak. `coupled` [Hz] is the edge of an AC coupling of
    first order. The touch is at sample `trigger` plus up to `jitter` samples.
    """

    name: str
    population: str = "reference"
    laws: tuple[Law, ...] = ("hunt-crossley",)
    curvature: Bounds | None = None
    mass_share: Bounds | None = None
    noise: float = 0.01
    pink: float = 0.0
    hum: float = 0.0
    bits: int | None = None
    range: Literal["own", "fixed"] = "own"
    edge: float | None = None
    clipped: float | None = None
    coupled: float | None = None
    trigger: int = 200
    jitter: float = 1.0


class Impacts(NamedTuple):
    """Signals (n, 2048) [N], labels, rocks, and peak [N], duration [s] and touch [samples] of the pulses."""

    signals: NDArray[np.float32]
    labels: NDArray[np.str_]
    rocks: Rocks
    peak: Floats
    duration: Floats
    restitution: Floats
    touch: Floats


#: Ratio of the rate at which a filtered force is computed to that of the recorder; frames filtered at once, and
#: samples after the last of their contacts, at whose end a filter of 5 kHz or more rings below 1e-6 of the peak.
_OVERSAMPLING, _AT_ONCE, _RINGING = 5, 256, 400


def sampled(pulse: Pulses, touch: Floats, rate: float, n_samples: int) -> Floats:
    """Return the forces [N] at sample times k / rate, (n, n_samples), with touch [s]."""
    first = np.ceil(touch * rate).astype(np.intp)
    count = np.minimum(np.floor((touch + pulse.duration) * rate).astype(np.intp) + 1, n_samples) - first
    count = np.maximum(count, 0)
    row = np.repeat(np.arange(len(touch)), count)
    column = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + first[row]
    out = np.zeros((len(touch), n_samples))
    out[row, column] = pulse.peak[row] * pulse.force(column / rate - touch[row], row)
    return out


def _filtered(rock: Rocks, touch: Floats, edge: float) -> Floats:
    filt = signal.butter(8, edge, fs=RATE * _OVERSAMPLING, output="sos")
    out = np.zeros((len(touch), SAMPLES))
    for first in range(0, len(touch), _AT_ONCE):
        block = slice(first, first + _AT_ONCE)
        part = pulses(Rocks(*(column[block] for column in rock)))
        start = int(touch[block].min())
        length = min(int(part.duration.max() * RATE) + _RINGING, SAMPLES - start)
        fine = sampled(part, (touch[block] - start) / RATE, RATE * _OVERSAMPLING, length * _OVERSAMPLING)
        out[block, start : start + length] = signal.sosfilt(filt, fine, axis=1)[:, ::_OVERSAMPLING]
    return out


def pink_noise(rng: np.random.Generator, n: int, n_samples: int = SAMPLES) -> Floats:
    spectrum = np.fft.rfft(rng.standard_normal((n, n_samples)), axis=1)
    shape = np.zeros(spectrum.shape[1])
    shape[1:] = np.arange(1, len(shape)) ** -0.5
    power = 2 * np.sum(shape[1:-1] ** 2) + shape[-1] ** 2
    return np.fft.irfft(spectrum * shape, n_samples, axis=1) / np.sqrt(power / n_samples)


def record(case: Case, n: int, seed: int) -> Impacts:
    """Return n recorded impacts of a case; equal seeds give equal rocks, whatever law, shape and recorder."""
    rng_rocks, rng_touch, rng_noise = (np.random.default_rng([seed, stream]) for stream in range(3))
    rock = rocks(case, n, rng_rocks)
    pulse = pulses(rock)
    touch = case.trigger + case.jitter * rng_touch.random(n)
    clean = sampled(pulse, touch / RATE, RATE, SAMPLES) if case.edge is None else _filtered(rock, touch, case.edge)
    if case.coupled is not None:
        clean = signal.lfilter(*signal.butter(1, case.coupled, "high", fs=RATE), clean, axis=1)
    peak = pulse.peak[:, None]
    out = clean + case.noise * peak * rng_noise.standard_normal(clean.shape)
    if case.pink:
        out += case.pink * peak * pink_noise(rng_noise, n)
    if case.hum:
        phase = rng_noise.uniform(0, 2 * np.pi, (n, 1))
        out += case.hum * peak * np.sin(2 * np.pi * 50 / RATE * np.arange(SAMPLES) + phase)
    if case.clipped is not None:
        out = np.minimum(out, case.clipped * peak)
    if case.bits is not None:
        full = 1.25 * peak if case.range == "own" else largest_peak(case)
        step = 2 * full / 2**case.bits
        out = np.clip(np.rint(out / step) * step, -full, full - step)
    return Impacts(out.astype(np.float32), rock.labels, rock, pulse.peak, pulse.duration, pulse.restitution, touch)


@cache
def largest_peak(case: Case) -> float:
    return float(pulses(rocks(case, 20_000, np.random.default_rng(0))).peak.max())


def _cases() -> dict[str, Case]:
    wide: Bounds = ("log-uniform", 0.1, 1.0)
    peers: Mapping[str, Any] = {"population": "peers", "trigger": 100, "jitter": 0.0}
    cases = [Case(name=law, laws=(law,)) for law in LAWS]
    cases += [
        Case(name="curvature", curvature=wide),
        Case(name="curvature, uniform", curvature=("uniform", 0.1, 1.0)),
        Case(name="eccentric", mass_share=("uniform", 0.4, 1.0)),
        Case(name="all laws and shapes", laws=LAWS, curvature=wide, mass_share=("uniform", 0.4, 1.0)),
        Case(name="pink 1 %", noise=0.0, pink=0.01),
        Case(name="pink 5 %", noise=0.0, pink=0.05),
        Case(name="hum 5 %", hum=0.05),
        Case(name="12 bit, own range", bits=12),
        Case(name="12 bit, fixed range", bits=12, range="fixed"),
        Case(name="anti-alias 20 kHz", edge=20e3),
        Case(name="clipped at .7", clipped=0.7),
        *(Case(name=f"white {level:g}", noise=level) for level in (0.0001, 0.001, 0.05, 0.1, 0.3)),
        Case(name="kuwabara-kono, white 0.05", laws=("kuwabara-kono",), noise=0.05),
        *(Case(name=f"{law}, {level:.0%}", laws=(law,), noise=level) for law in OTHERS for level in (0.01, 0.05)),
        *(Case(name=f"AC coupling, {level:.0%}", coupled=50.0, noise=level) for level in (0.01, 0.05)),
        Case(name="dull", population="dull"),
        Case(name="peers", noise=0.02, **peers),
        Case(name="peers, pink 2 %", noise=0.0, pink=0.02, **peers),
    ]
    return {case.name: case for case in cases}


#: Lines of the table by name.
CASES: dict[str, Case] = _cases()
