"""Slow, obvious twins of the fast routines: plain loops, one signal at a time, independent of the package.

The exception is the table of pulses, which `tests/test_family.py` compares with an integration of the equation.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, least_squares

from cgid.measure.fit import family


def peak(samples: Sequence[float]) -> tuple[int, float]:
    place = 0
    for k in range(len(samples)):
        if samples[k] > samples[place]:
            place = k
    return place, samples[place]


def crossings(samples: Sequence[float], level: float) -> tuple[float, float]:
    """Go outwards from the peak to the first sample below a fraction of it; linear interpolation [samples]."""
    place, highest = peak(samples)
    height = level * highest
    left = place
    while samples[left] >= height:
        left -= 1
    right = place
    while samples[right] >= height:
        right += 1
    rising = left + (height - samples[left]) / (samples[left + 1] - samples[left])
    falling = right - (height - samples[right]) / (samples[right - 1] - samples[right])
    return rising, falling


def width(samples: Sequence[float], rate: float, level: float) -> float:
    rising, falling = crossings(samples, level)
    return (falling - rising) / rate


def rise_time(samples: Sequence[float], rate: float) -> float:
    return (crossings(samples, 0.9)[0] - crossings(samples, 0.1)[0]) / rate


def fall_time(samples: Sequence[float], rate: float) -> float:
    return (crossings(samples, 0.1)[1] - crossings(samples, 0.9)[1]) / rate


def impulse(samples: Sequence[float], rate: float) -> float:
    total = 0.0
    for value in samples:
        total += value / rate
    return total


def energy(samples: Sequence[float], rate: float) -> float:
    total = 0.0
    for value in samples:
        total += value * value / rate
    return total


def skewness(samples: Sequence[float]) -> float:
    total = sum(samples)
    mean = sum(k * value for k, value in enumerate(samples)) / total
    second = sum((k - mean) ** 2 * value for k, value in enumerate(samples)) / total
    third = sum((k - mean) ** 3 * value for k, value in enumerate(samples)) / total
    return float(third / second**1.5)


def power_spectrum(samples: Sequence[float], rate: float, duration: float) -> tuple[list[float], list[float]]:
    """Direct Fourier sum up to 4/T, on the grid of a transform padded to a power of two of at least 8 T."""
    length = 64
    while length < 8 * math.ceil(duration * rate + 1):
        length *= 2
    frequencies, power = [], []
    k = 0
    while k * rate / length <= min(4 / duration, rate / 2):
        total = 0j
        for n, value in enumerate(samples):
            total += value * cmath.exp(-2j * math.pi * k * n / length)
        frequencies.append(k * rate / length)
        power.append(abs(total) ** 2)
        k += 1
    return frequencies, power


def spectral_mean(values: Sequence[float], power: Sequence[float]) -> float:
    """Mean over the spectrum; the bin at 0 Hz is half a bin wide."""
    weights = [0.5 * power[0], *power[1:]]
    return sum(v * w for v, w in zip(values, weights, strict=True)) / sum(weights)


def centroid(frequencies: Sequence[float], power: Sequence[float]) -> float:
    return spectral_mean(frequencies, power)


def bandwidth(frequencies: Sequence[float], power: Sequence[float]) -> float:
    middle = centroid(frequencies, power)
    return math.sqrt(spectral_mean([(f - middle) ** 2 for f in frequencies], power))


def energy_below(frequencies: Sequence[float], power: Sequence[float], limit: float) -> float:
    """Share of the spectrum below a limit: trapezoids, the last one cut proportionally."""
    below = total = 0.0
    for k in range(len(power) - 1):
        step = 0.5 * (power[k] + power[k + 1])
        share = (limit - frequencies[k]) / (frequencies[k + 1] - frequencies[k])
        total += step
        below += step * min(max(share, 0.0), 1.0)
    return below / total


def rolloff(frequencies: Sequence[float], power: Sequence[float], share: float = 0.85) -> float:
    low, high = 0.0, frequencies[-1]
    for _ in range(60):
        middle = 0.5 * (low + high)
        if energy_below(frequencies, power, middle) < share:
            low = middle
        else:
            high = middle
    return low


def cutoff_10db(frequencies: Sequence[float], power: Sequence[float]) -> float:
    decibel = [10 * math.log10(p / power[0]) for p in power]
    k = 0
    while decibel[k] > -10:
        k += 1
    share = (-10 - decibel[k - 1]) / (decibel[k] - decibel[k - 1])
    return frequencies[k - 1] + share * (frequencies[k] - frequencies[k - 1])


def low_pass_gain(frequency: float, edge: float, taper: float) -> float:
    """One below the edge, zero above it, half a cosine wave of width `taper * edge` between."""
    start, stop = edge * (1 - taper / 2), edge * (1 + taper / 2)
    if frequency <= start:
        return 1.0
    if frequency >= stop:
        return 0.0
    return 0.5 * (1 + math.cos(math.pi * (frequency - start) / (stop - start)))


def fft_filter(
    samples: Sequence[float], rate: float, low: float | None = None, high: float | None = None, taper: float = 0.0
) -> np.ndarray:
    """Filter by a direct Fourier sum and its inverse."""
    n = len(samples)
    result = np.zeros(n, complex)
    for k in range(n):
        frequency = min(k, n - k) * rate / n
        gain = 1.0 if high is None else low_pass_gain(frequency, high, taper)
        gain *= 1.0 if low is None else 1 - low_pass_gain(frequency, low, taper)
        coefficient = sum(samples[m] * cmath.exp(-2j * math.pi * k * m / n) for m in range(n))
        for m in range(n):
            result[m] += gain * coefficient * cmath.exp(2j * math.pi * k * m / n) / n
    return result.real


def band_power(frequencies: Sequence[float], power: Sequence[float], low: float, high: float) -> float:
    return energy_below(frequencies, power, high) - energy_below(frequencies, power, low)


def stretches(samples: Sequence[float], threshold: float, gap: int) -> list[int]:
    """First samples of the stretches above a threshold that are more than `gap` samples apart."""
    firsts: list[int] = []
    last = None
    for k, value in enumerate(samples):
        if value > threshold:
            if last is None or k - last > gap:
                firsts.append(k)
            last = k
    return firsts


def impact_rk4(damping: float, end: float, n_steps: int) -> tuple[float, float]:
    """Integrate x'' = -x^(3/2) (1 + D x') from touch to a time, by classical Runge-Kutta with equal steps."""

    def acceleration(x: float, rate: float) -> float:
        return -(max(x, 0.0) ** 1.5) * (1 + damping * rate)

    step = end / n_steps
    x, rate = 0.0, 1.0
    for _ in range(n_steps):
        x1, a1 = rate, acceleration(x, rate)
        x2, a2 = rate + step / 2 * a1, acceleration(x + step / 2 * x1, rate + step / 2 * a1)
        x3, a3 = rate + step / 2 * a2, acceleration(x + step / 2 * x2, rate + step / 2 * a2)
        x4, a4 = rate + step * a3, acceleration(x + step * x3, rate + step * a3)
        x += step / 6 * (x1 + 2 * x2 + 2 * x3 + x4)
        rate += step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return x, rate


class Contact:
    """One dimensionless impact by scipy's DOP853 in plain time: displacement x, velocity y of the sphere, force f.

    `x' = y - lambda f, y' = gamma - f, f = x^(3/2) + (D x^(3/2) + zeta x^(1/2)) x'`, from x = 0, y = 1 until x, or
    the force of a viscoelastic sphere, has fallen to 0. The tolerance is that of a step; the results agree with
    32-digit arithmetic to about 1e-12. `separates` is False if the sphere is still in contact at the time `longest`.
    """

    def __init__(
        self, damping: float = 0, zeta: float = 0, inelasticity: float = 0, weight: float = 0, longest: float = 1e4
    ) -> None:
        def force(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            x = np.maximum(x, 0)
            loss = damping * x**1.5 + zeta * x**0.5
            return np.maximum((x**1.5 + loss * y) / (1 + inelasticity * loss), 0)

        def rates(_time: float, state: np.ndarray) -> list[float]:
            f = float(force(state[0], state[1]))
            return [state[1] - inelasticity * f, weight - f, inelasticity * f * f, f]

        def held(time: float, state: np.ndarray) -> float:
            """Fall through 0 at separation: x, or the force over x^(1/2)."""
            if time == 0:
                return 1.0
            return state[0] + zeta * state[1] if zeta else state[0]

        held.terminal, held.direction = True, -1  # type: ignore[attr-defined]
        self._solved = solve_ivp(
            rates, (0, longest), [0.0, 1.0, 0.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-16, first_step=1e-8,
            dense_output=True, events=held,
        )  # fmt: skip
        self._force = force
        self.separates = self._solved.t_events[0].size > 0
        if self.separates:
            self.contact_time = float(self._solved.t_events[0][0])
            end = self._solved.y_events[0][0]
            self.end_displacement, self.restitution = float(end[0]), -float(end[1])
            self.plate_energy, self.impulse = float(end[2]), float(end[3])

    def evaluate(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, _, _ = self._solved.sol(times)
        return x, self._force(x, y)


def thornton_contact(radius: float, modulus: float, pressure: float) -> tuple[Callable, Callable, float]:
    """Return P(delta) while loading and after a largest delta, and where it yields, as Thornton (1997) writes it."""
    first = (math.pi * pressure / (2 * modulus)) ** 2 * radius
    at_yield = 4 / 3 * modulus * math.sqrt(radius) * first**1.5

    def loading(delta: float) -> float:
        hertz = 4 / 3 * modulus * math.sqrt(radius) * max(delta, 0.0) ** 1.5
        return hertz if delta <= first else at_yield + math.pi * radius * pressure * (delta - first)

    def unloading(largest: float) -> Callable[[float], float]:
        force = loading(largest)
        if largest <= first:
            return loading
        flattened = 4 * modulus / (3 * force) * ((2 * force + at_yield) / (2 * math.pi * pressure)) ** 1.5
        stiffness = 4 / 3 * modulus * math.sqrt(flattened)
        rest = largest - (force / stiffness) ** (2 / 3)
        return lambda delta: stiffness * max(delta - rest, 0.0) ** 1.5

    return loading, unloading, first


def walton_braun_contact(restitution: float, stiffness: float) -> tuple[Callable, Callable, float]:
    """Return the same of a bilinear contact, which never changes its loading path."""

    def unloading(largest: float) -> Callable[[float], float]:
        return lambda delta: max(stiffness / restitution**2 * (delta - largest * (1 - restitution**2)), 0.0)

    return lambda delta: stiffness * delta, unloading, math.inf


def two_path_impact(
    mass: float,
    velocity: float,
    unit: float,
    loading: Callable,
    unloading: Callable,
    corner: float,
    damping: float = 0.0,
) -> tuple[Callable[[np.ndarray], np.ndarray], float, float]:
    """Return the force over time of a contact that loads on one path and unloads on another, by DOP853.

    Also where it ends (the force falls to 1e-13 of its peak) and the rebound speed. unit is a time to scale the steps.
    With damping [s/m] the force of either path is multiplied by `1 + damping delta'`.
    """
    settings = {"method": "DOP853", "rtol": 1e-13, "atol": [1e-14 * velocity * unit, 1e-14 * velocity]}
    parts, state, start = [], (0.0, velocity), 0.0

    def run(force: Callable, *events: Callable) -> None:
        nonlocal state, start
        for event in events:
            event.terminal, event.direction = True, -1
        found = solve_ivp(
            lambda _, y: (y[1], -force(y[0]) * (1 + damping * y[1]) / mass), (start, 20 * unit), state,
            events=events, dense_output=True, max_step=unit / 50, **settings,
        )  # fmt: skip
        parts.append((start, found.t[-1], found.sol, force))
        state, start = found.y[:, -1], found.t[-1]

    run(loading, lambda _, y: y[1], lambda _, y: corner - y[0] if corner < math.inf else 1.0)
    if state[1] > 1e-9 * velocity:
        run(loading, lambda _, y: y[1])
    after, largest = unloading(state[0]), state[0]
    rest = 0.0
    if after(0.0) == 0:  # contact ends while the body is still flattened
        rest = brentq(lambda delta: after(delta) - 1e-13 * after(largest), 0, largest, xtol=1e-20)
    run(after, lambda _, y: y[0] - rest)

    def force(times: np.ndarray) -> np.ndarray:
        out = np.zeros(times.shape)
        for begin, end, solution, law in parts:
            inside = (times >= begin) & (times < end)
            if inside.any():
                out[inside] = [law(delta) * (1 + damping * speed) for delta, speed in solution(times[inside]).T]
        return out

    return force, start, -state[1]


def thornton_paths(corner: float) -> tuple[Callable, Callable, float]:
    """Return the paths of `thornton_contact` in units of the impact, for a contact that yields at this depth."""
    # K = 1 with R = 1, E = 3/4; the pressure of this depth follows.
    return thornton_contact(1.0, 0.75, math.sqrt(corner) * 1.5 / math.pi)


def walton_braun_paths(stiffness: float, restitution: float) -> tuple[Callable, Callable, float]:
    """Return the paths of `walton_braun_contact` in units of the impact."""
    return walton_braun_contact(restitution, stiffness)


def plastic_contact(
    loading: Callable, unloading: Callable, corner: float, damping: float, inelasticity: float, weight: float
) -> tuple[Callable[[np.ndarray], np.ndarray], float, float, float]:
    """Return force, end, rebound and plate energy of a contact on two paths that also gives way, by DOP853.

    In units of the impact: `x' = y - lambda f, y' = gamma - f, f = path (1 + D x')`.
    """
    parts, state, start = [], (0.0, 1.0, 0.0), 0.0

    def force_of(path: Callable, x: float, y: float) -> float:
        g = path(x)
        return g * (1 + damping * y) / (1 + inelasticity * damping * g)

    def run(path: Callable, *events: Callable) -> None:
        nonlocal state, start

        def rates(_time: float, now: np.ndarray) -> list[float]:
            f = force_of(path, now[0], now[1])
            return [now[1] - inelasticity * f, weight - f, inelasticity * f * f]

        for event in events:
            event.terminal, event.direction = True, -1
        found = solve_ivp(
            rates, (start, 1e3), state, method="DOP853", rtol=1e-12, atol=1e-14, events=events, dense_output=True,
            max_step=0.1,
        )  # fmt: skip
        parts.append((start, found.t[-1], found.sol, path))
        state, start = found.y[:, -1], found.t[-1]

    def turns(_time: float, now: np.ndarray) -> float:
        return now[1] - inelasticity * force_of(loading, now[0], now[1])

    run(loading, turns, lambda _, now: corner - now[0] if corner < math.inf else 1.0)
    if state[1] - inelasticity * force_of(loading, state[0], state[1]) > 1e-9:
        run(loading, turns)
    after, largest = unloading(state[0]), state[0]
    rest = 0.0
    if after(0.0) == 0:
        rest = brentq(lambda x: after(x) - 1e-13 * after(largest), 0, largest, xtol=1e-20)
    run(after, lambda _, now: now[0] - rest)

    def force(times: np.ndarray) -> np.ndarray:
        out = np.zeros(times.shape)
        for begin, end, solution, path in parts:
            inside = (times >= begin) & (times < end)
            if inside.any():
                out[inside] = [force_of(path, *now[:2]) for now in solution(times[inside]).T]
        return out

    return force, start, -state[1], state[2]


def damped_pulse(times: np.ndarray, peak: float, duration: float, onset: float, restitution: float) -> np.ndarray:
    """Sample the damped-Hertz pulse of a peak, contact duration and touch time; a restitution above 1 reverses time."""
    lossy = min(restitution, 1 / restitution)
    contact, top, _ = (float(time) for time in family.times(lossy))
    share = (np.asarray(times) - onset) / duration
    if restitution > 1:
        share = 1 - share
    return peak * family.force(contact * share, lossy) / family.force(np.array([top]), lossy)


def fitted_pulse(
    samples: np.ndarray, start: Sequence[float], *, clip_level: float = math.inf
) -> tuple[np.ndarray, float]:
    """Fit (peak, duration, onset, restitution) by scipy to all samples; also return the squared residual.

    A clipped sample costs nothing where the curve is above it.
    """
    times = np.arange(len(samples), dtype=float)

    def residual(values: np.ndarray) -> np.ndarray:
        left = np.asarray(samples - damped_pulse(times, *values[:3], math.exp(values[3])), float)
        return np.where((samples >= clip_level) & (left < 0), 0.0, left)

    first = np.array([*start[:3], math.log(start[3])])
    scale = np.array([first[0], first[1], first[1], 1.0])
    widest = np.array([[0, 1, -np.inf, math.log(0.05)], [np.inf, np.inf, np.inf, math.log(20)]])
    found = least_squares(residual, first, x_scale=scale, bounds=widest, xtol=1e-11, ftol=1e-13, gtol=1e-13)
    return np.array([*found.x[:3], math.exp(found.x[3])]), 2 * found.cost


def pulse_covariance(times: np.ndarray, duration: float, onset: float, restitution: float) -> np.ndarray:
    """Invert the Fisher information of (ln peak, ln duration, onset, ln restitution), peak and noise 1."""

    def curve(values: np.ndarray) -> np.ndarray:
        peak, length, shape = np.exp(values[[0, 1, 3]])
        return damped_pulse(times, peak, length, values[2], shape)

    at = np.array([0.0, math.log(duration), onset, math.log(restitution)])
    slopes = np.array([(curve(at + step) - curve(at - step)) / 2e-5 for step in 1e-5 * np.eye(4)])
    return np.linalg.inv(slopes @ slopes.T)


def log_evidence(samples: np.ndarray, noise: float, draws: np.ndarray) -> tuple[float, float]:
    """Average the likelihood of a signal over drawn pulses; return its logarithm and the standard error of that."""
    terms = -0.5 * np.sum((draws - samples) ** 2, axis=1, dtype=float) / noise**2
    shares = np.exp(terms - terms.max())
    return float(terms.max() + np.log(shares.mean())), float(shares.std() / shares.mean() / math.sqrt(len(draws)))
