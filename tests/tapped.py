"""Recordings of taps on a beam with known modes, made without cgid: by recursions at eight times the sampling rate."""

import numpy as np
from scipy.signal import butter, lfilter, sosfilt

#: Natural frequencies [Hz], damping ratios and participations [1/kg] of a beam; two pairs lie 1.5 to 2 % apart.
FREQUENCY = np.array([118.5, 187.0, 190.5, 260.0, 480.0, 655.0, 1010.0, 1300.0, 1320.0, 1700.0])
DAMPING = np.linspace(0.004, 0.012, FREQUENCY.size)
PARTICIPATION = np.array([0.8, -0.6, 0.7, 0.5, -0.9, 0.3, 0.4, 0.5, 0.4, 0.3]) * 1e-3
_FINER = 8


def acceleration(force, step, frequency, damping, participation):
    """Return the acceleration of modes under a force (n,), each an oscillator that takes it sample by sample."""
    out = participation.real.sum() * force
    for own, ratio, part in zip(2 * np.pi * frequency, damping, participation, strict=True):
        free = own * np.sqrt(1 - ratio**2)
        shrink, cosine, sine = np.exp(-ratio * own * step), np.cos(free * step), np.sin(free * step)
        bottom = [1, -2 * shrink * cosine, shrink**2]
        place = lfilter([0, shrink * sine / free * step], bottom, force)
        speed = lfilter([step, -step * shrink * (cosine + ratio * own / free * sine)], bottom, force)
        # Complex parts, of damping in places, take the state a part of a period later.
        state = place - 1j * (speed + ratio * own * place) / free
        out += (part * (-ratio * own + 1j * free) ** 2 * state).real
    return out


def taps(
    n=6,
    *,
    rate=25_600.0,
    gap=1.2,
    seed=0,
    noise=1e-3,
    width=0.6e-3,
    peak=300.0,
    also=(),
    modes=(FREQUENCY, DAMPING, PARTICIPATION),
    spread=0.0,
):
    """Return acceleration [m/s^2] and force [N] of half-sine blows, and the onsets [s].

    `noise` is a share of the root mean square in the second after a tap; `also` holds (tap, seconds later, share of the
    force) of further blows; `spread` lets the participations differ from tap to tap.
    """
    rng = np.random.default_rng(seed)
    fine = rate * _FINER
    times = 0.4 + gap * np.arange(n) + rng.uniform(0, 0.02, n)
    blows = [(k, time, peak * rng.uniform(0.5, 1.5), width * rng.uniform(0.8, 1.2)) for k, time in enumerate(times)]
    blows += [(k, times[k] + later, share * blows[k][2], width) for k, later, share in also]
    length = int((0.4 + n * gap) * fine)
    total, forces = np.zeros(length), np.zeros(length)
    differ = np.exp(rng.normal(0, spread, (n, len(modes[0])))) if spread else np.ones((n, 1))
    for tap in range(n):
        force = np.zeros(length)
        for _, time, height, lasts in (blow for blow in blows if blow[0] == tap):
            first, count = round(time * fine), round(lasts * fine)
            force[first : first + count] += height * np.sin(np.pi * (np.arange(count) + 0.5) / count)
        forces += force
        if spread or tap == 0:
            own = (modes[0], modes[1], modes[2] * differ[tap])
            total = total + acceleration(force, 1 / fine, *own) if spread else total
    if not spread:
        total = acceleration(forces, 1 / fine, *modes)
    edge = butter(8, 0.4 * rate, fs=fine, output="sos")
    response, hammer = (sosfilt(edge, one)[::_FINER] for one in (total, forces))
    first = round(times[0] * rate)
    level = np.sqrt(np.mean(np.square(response[first : first + round(rate)])))
    response = response + rng.normal(0, noise * level, response.size)
    return response, hammer + rng.normal(0, 1e-3 * peak, hammer.size), times


#: Flaws of a tap that its force does not show, or not alone.
FLAWS = ("spike", "gap", "step", "polarity", "scale", "force")


def flawed(response, force, first, last, kind):
    """Return a recording with a flaw from one tap to the next."""
    response, force, part = response.copy(), force.copy(), slice(first - 20, last)
    match kind:
        case "spike":
            response[first + 3000] += 30 * np.abs(response).max()
        case "gap":
            response[first + 900 : first + 3000] = 0
        case "step":
            response[first + 900 : last] += 0.3 * np.abs(response).max()
        case "polarity":
            response[part] *= -1
        case "scale":
            response[part] *= 3
        case "force":
            force[first - 20 : first + 200] *= 2
    return response, force
