"""`estimate` on one dull impact, beside the global optimum that a slow search finds.

    python benchmarks/rock_fit.py [--draws 300] [--restitution .15 .20] [--contact 30 60 100] [--noise .01 .02 .03]

The pulses are Hunt-Crossley's from `rock_pulses.py`, in white noise, with touch anywhere between two samples. The slow
search takes all shapes s = ln e from ln .05 to -ln .05 (beyond 0 the pulse is reversed in time), 121 of them. At each,
peak, duration and onset are fitted from three starts: the true pulse's width and place, and the solutions of the next
shape to either side. Around the two deepest valleys it looks again at a tenth of the spacing. It knows the noise and
the true pulse, so it says where the optimum is, not what an estimator may reach.

There are two optima: of the likelihood, and of the likelihood with a weight of .6 of Firth's penalty on the shape,
which moves where it is barely determined. The penalty is computed here from the information of the table's pulses.

Columns: medians of the restitution; the median of `estimate` minus that of either optimum, in standard errors of the
optimum's median (bootstrap); the standard deviation of (estimate - truth) over the stated deviation; the share of
draws in which the likelihood of `estimate` is worse than the optimum's by more than 2 in chi-square.
"""

from __future__ import annotations

import argparse
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rock_pulses import RATE, Pulses, sampled, viscous

from cgid.identification.estimation import estimate

Floats = NDArray[np.float64]
#: Step of the shapes and their number up to s = 0; every tenth is searched first.
_STEP, _SHAPES, _COARSE = 0.005, 600, 10
#: Intervals of a curve along s, share of contact = sin^2(pi s / 2).
_PLACES = 512
#: Weight of Firth's penalty.
FIRTH = 0.6
QUIET, SAMPLES = 200, 1024
RESTITUTIONS, CONTACTS, NOISES = (0.15, 0.20), (30, 60, 100), (0.01, 0.02, 0.03)


class Family(NamedTuple):
    """Curves (n_shapes, n_places) up to s = 0; contact and time of the peak over the width; penalty, all shapes."""

    curves: Floats
    duration: Floats
    lead: Floats
    penalty: Floats


@cache
def family() -> Family:
    """Return the pulses of all shapes; number k has s = (k - 600) * .005, above 600 they are reversed."""
    table = viscous("hunt-crossley")
    e = np.exp(_STEP * (np.arange(_SHAPES + 1) - _SHAPES))
    curves = table.force(e, np.arange(_PLACES + 1) / _PLACES)
    fine = np.linspace(0, 1, 20_001)
    top = np.argmax(table.force(e, fine), axis=1)
    duration = table.duration(e) * table.peak(e) / (1 + e)  # the impulse in scaled units is 1 + e
    lead = duration * np.sin(np.pi / 2 * fine[top]) ** 2
    duration = np.concatenate([duration, duration[-2::-1]])
    lead = np.concatenate([lead, (duration[: _SHAPES + 1] - lead)[-2::-1]])
    found = Family(curves, duration, lead, np.zeros(2 * _SHAPES + 1))
    return found._replace(penalty=_penalty(found))


def _penalty(held: Family) -> Floats:
    """Return minus the ln of the standard deviation of s of densely sampled pulses of one width, at all shapes."""
    shapes = np.arange(10, 2 * _SHAPES - 9, 10)
    out = []
    for k in shapes:
        duration, lead = held.duration[k], held.lead[k]
        t = -lead + duration * (np.arange(1000) + 0.5) / 1000

        def pulse(number: int, t: Floats = t, width: float = 1.0, place: float = 0.0) -> Floats:
            share = ((t - place) / width + held.lead[number]) / held.duration[number]
            return curve(held.curves, number, share)

        slopes = np.stack(
            [
                pulse(k),
                (pulse(k, width=1.001) - pulse(k, width=0.999)) / 0.002,
                (pulse(k, place=0.001) - pulse(k, place=-0.001)) / 0.002,
                (pulse(k + 2) - pulse(k - 2)) / (4 * _STEP),
            ]
        )
        information = slopes @ slopes.T * duration / 1000
        out.append(-0.5 * np.log(np.linalg.inv(information)[3, 3]))
    return np.interp(np.arange(2 * _SHAPES + 1), shapes, out)


def curve(curves: Floats, number: int, share: Floats) -> Floats:
    """Return the pulse over its peak at shares of the contact."""
    return np.array([_value(curves, number, float(u))[0] for u in share])


@njit(cache=True)
def _value(curves: Floats, number: int, u: float) -> tuple[float, float]:
    """Return the pulse and its slope in u, by the cubic through four neighbouring places."""
    if not 0.0 < u < 1.0:
        return 0.0, 0.0
    last = len(curves) - 1  # s = 0
    turned = number > last
    row = 2 * last - number if turned else number
    place = 2 / np.pi * np.arcsin(np.sqrt(1 - u if turned else u)) * _PLACES
    i = min(max(int(place), 1), _PLACES - 2)
    x = place - i
    a, b, c, d = curves[row, i - 1], curves[row, i], curves[row, i + 1], curves[row, i + 2]
    p, q, r = (6 * c - 2 * a - 3 * b - d) / 6, 0.5 * (a - 2 * b + c), (d - 3 * c + 3 * b - a) / 6
    value = b + x * (p + x * (q + x * r))
    slope = (p + x * (2 * q + 3 * x * r)) * _PLACES
    slope /= np.pi * np.sqrt(u * (1 - u))  # du = pi sqrt(u (1 - u)) ds
    return value, -slope if turned else slope


@njit(cache=True)
def _normal(y: Floats, curves: Floats, number: int, at: Floats, a: Floats, g: Floats) -> float:
    """Return the squared residual at (peak, duration, onset), and fill the normal equations."""
    peak, duration, onset = at
    a[:], g[:] = 0.0, 0.0
    first = max(int(np.ceil(onset)), 0)
    last = min(int(np.floor(onset + duration)), len(y) - 1)
    cost = 0.0
    j = np.empty(3)
    for k in range(len(y)):
        if k < first or k > last:
            cost += y[k] ** 2
            continue
        u = (k - onset) / duration
        value, slope = _value(curves, number, u)
        j[0], j[1], j[2] = value, -peak * slope * u / duration, -peak * slope / duration
        miss = y[k] - peak * value
        cost += miss * miss
        for m in range(3):
            g[m] += j[m] * miss
            for n in range(3):
                a[m, n] += j[m] * j[n]
    return cost


@njit(cache=True)
def _fitted(y: Floats, curves: Floats, number: int, at: Floats) -> float:
    """Fit peak, duration and onset from a start, in place; return the squared residual."""
    a, g = np.empty((3, 3)), np.empty(3)
    a_new, g_new = np.empty((3, 3)), np.empty(3)
    cost, damping = _normal(y, curves, number, at, a, g), 1e-4
    for _ in range(60):
        if min(a[0, 0], a[1, 1], a[2, 2]) <= 0.0:  # the pulse has left the samples
            break
        bent = a.copy()
        for m in range(3):
            bent[m, m] += damping * a[m, m]
        step = np.linalg.solve(bent, g)
        if np.sum(step * g) < 1e-7 * cost / len(y) or damping > 1e10:
            break
        tried = at + step
        tried[1] = min(max(tried[1], 0.5 * at[1]), 2 * at[1])
        new = _normal(y, curves, number, tried, a_new, g_new)
        if new < cost:
            at[:] = tried
            cost = new
            a[:], g[:] = a_new, g_new
            damping *= 0.1
        else:
            damping = max(10 * damping, 1e-3)
    return cost


@njit(cache=True)
def _profile(
    y: Floats, curves: Floats, shapes: NDArray[np.intp], starts: Floats, costs: Floats, places: Floats
) -> None:
    """Fill the least squared residual at each shape, and where it is; from given starts and from the neighbours."""
    for k in range(len(shapes)):
        places[k] = starts[k]
        costs[k] = _fitted(y, curves, shapes[k], places[k])
    for sweep in range(2):
        for i in range(1, len(shapes)):
            k = i if sweep == 0 else len(shapes) - 1 - i
            at = places[k - 1 if sweep == 0 else k + 1].copy()
            cost = _fitted(y, curves, shapes[k], at)
            if cost < costs[k]:
                costs[k], places[k] = cost, at


class Optimum(NamedTuple):
    """Restitution at the best shape, and the chi-square there without the penalty."""

    restitution: float
    chi_square: float


def optima(y: Floats, sigma: float, pulse: tuple[float, float, float, float], weights: tuple[float, ...]) -> list[Any]:
    """Return the `Optimum` for each weight of the penalty of one signal without baseline.

    `pulse` is the true peak, duration and onset [samples], and restitution, from which the search starts.
    """
    held = family()
    peak, duration, onset, e = pulse
    own = round(np.log(e) / _STEP) + _SHAPES
    width = duration / held.duration[own]
    place = onset + held.lead[own] * width

    def profile(shapes: NDArray[np.intp]) -> Floats:
        starts = np.stack(
            [np.full(len(shapes), peak), width * held.duration[shapes], place - width * held.lead[shapes]], axis=1
        )
        costs = np.empty(len(shapes))
        _profile(y, held.curves, shapes, starts, costs, np.empty_like(starts))
        return costs / sigma**2

    coarse = np.arange(0, 2 * _SHAPES + 1, _COARSE)
    rough = profile(coarse)
    found = []
    for weight in weights:
        whole = rough - 2 * weight * held.penalty[coarse]
        inner = np.concatenate([[np.inf], whole, [np.inf]])
        valleys = np.flatnonzero((whole <= inner[:-2]) & (whole <= inner[2:]))
        best: list[tuple[float, float, float]] = []
        for valley in valleys[np.argsort(whole[valleys])[:2]]:
            shapes = np.arange(max(coarse[valley] - 12, 0), min(coarse[valley] + 12, 2 * _SHAPES) + 1)
            costs = profile(shapes)
            total = costs - 2 * weight * held.penalty[shapes]
            k = int(np.clip(np.argmin(total), 1, len(total) - 2))
            low, middle, high = total[k - 1 : k + 2]
            bend = low - 2 * middle + high
            shift = float(np.clip(0.5 * (low - high) / bend, -1, 1)) if bend > 0 else 0.0
            best.append((float(total.min()), (shapes[k] + shift - _SHAPES) * _STEP, float(costs[k])))
        _, shape, chi_square = min(best)
        found.append(Optimum(float(np.exp(shape)), chi_square))
    return found


def chi_square(y: Floats, sigma: float, restitution: float, start: Floats) -> float:
    """Return the chi-square at a restitution with the best peak, duration and onset [samples] near a start."""
    number = int(np.clip(round(np.log(restitution) / _STEP) + _SHAPES, 0, 2 * _SHAPES))
    return _fitted(y, family().curves, number, start.copy()) / sigma**2


def error_of_median(values: Floats, rng: np.random.Generator) -> float:
    """Return the standard error of a median, by 400 bootstrap samples."""
    return float(np.median(rng.choice(values, (400, len(values))), axis=1).std())


#: Headings of a line.
COLUMNS = (
    *("e", "samples in contact", "noise", "estimate"),
    *("optimum", "from it [s.e.]", "penalised optimum", "from this [s.e.]"),
    *("honesty", "worse by 2 in chi-square"),
)


def judge(e: float, contact: int, noise: float, draws: int, seed: int = 0) -> dict[str, Any]:
    """Return one line of the table."""
    rng = np.random.default_rng([seed, round(1000 * e), contact, round(1e6 * noise)])
    table = viscous("hunt-crossley")
    touch = QUIET + rng.random(draws)

    def force(time: Floats, row: NDArray[np.intp]) -> Floats:
        share = np.clip(time * RATE / contact, 0, 1)
        return np.asarray(table.force.ev(e, 2 / np.pi * np.arcsin(np.sqrt(share))))

    ones = np.ones(draws)
    clean = sampled(Pulses(ones, ones * contact / RATE, ones * e, force), touch / RATE, RATE, SAMPLES)
    signals = clean + noise * rng.standard_normal(clean.shape)
    found = estimate(signals, RATE, pre_trigger=QUIET)
    first, last = QUIET - 60, QUIET + 4 * contact + 60
    slow, penalised, worse = [], [], []
    for row, samples in enumerate(signals):
        y = samples[first:last] - samples[:QUIET].mean()
        free, bound = optima(y, noise, (1.0, contact, touch[row] - first, e), (0.0, FIRTH))
        slow.append(free.restitution)
        penalised.append(bound.restitution)
        start = np.array([found.peak[row], found.contact_duration[row] * RATE, found.onset[row] * RATE - first])
        worse.append(chi_square(y, noise, float(found.restitution[row]), start) > free.chi_square + 2)
    error = (found.restitution - e) / found.restitution_deviation
    middle, optimum, best = (float(np.median(v)) for v in (found.restitution, slow, penalised))
    errors = [(middle - of) / error_of_median(np.array(v), rng) for of, v in ((optimum, slow), (best, penalised))]
    shown = (middle, optimum, errors[0], best, errors[1], float(error.std()), float(np.mean(worse)))
    return dict(zip(COLUMNS, (f"{e:g}", contact, f"{noise:g}", *shown), strict=True))


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--restitution", type=float, nargs="+", default=RESTITUTIONS)
    parser.add_argument("--contact", type=int, nargs="+", default=CONTACTS, help="samples")
    parser.add_argument("--noise", type=float, nargs="+", default=NOISES)
    arguments = parser.parse_args()
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for e in arguments.restitution:
        for contact in arguments.contact:
            for noise in arguments.noise:
                line = judge(e, contact, noise, arguments.draws)
                cells = (f"{value:.3f}" if isinstance(value, float) else str(value) for value in line.values())
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
