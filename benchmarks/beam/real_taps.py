"""Forces recovered from real hammer taps beside the forces measured by the hammer, one tap left out at a time.

    cgid fetch taps-pyfrf && cgid fetch taps-dagnn
    python benchmarks/beam/real_taps.py --pyfrf taps-pyfrf --dagnn taps-dagnn

1. Five taps at one place with one accelerometer (github.com/ladisk/pyFRF). Four of them give the modes by `tap_test`,
   and the force of the fifth follows from its acceleration by `recover_force`. Beside it: the frequency response
   measured at the four taps without any model (H1), and the modes of another program, least squares in the frequency
   domain (LSCF of sdypy-EMA) with its residuals, if it is installed. The forces through these are plain least squares
   at the samples about the known contact: what is unexplained and how large the errors are with nothing else assumed.
2. Two taps on a plate with four sensors (github.com/Mulllky/DAGNN-impact-force-identification): the force of the second
   through the modes of the first. They hit different points.

The hammer's force is compared where it fits best, since its delay is another one than the sensor's.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from cgid.calibration import tap_test
from cgid.errors import BadData
from cgid.identification.inversion.recovered import errors_of, recover_force, time_above

Floats = NDArray[np.float64]
BANDS = ((60.0, 5900.0), (30.0, 10_000.0))
#: Samples before the contact and of the sought force, for plain least squares.
BEFORE, SOUGHT = 8, 30
#: A row of errors: unexplained, then as `errors_of`, then the fraction of samples within 1.96 deviations.
NAMES = ("unexplained", "force", "peak", "width", "impulse", "covered")


def taps_of(folder: Path) -> tuple[Floats, Floats, float]:
    """Return acceleration and force of the taps, each (n_taps, n), and the sampling rate [Hz]."""
    every = [np.load(path) for path in sorted(folder.rglob("measurements_*.npy"))]
    if not every:
        raise SystemExit(f"{folder}: must contain measurements_1.npy and others; cgid fetch taps-pyfrf")
    rate = 1 / float(np.diff(every[0][0]).mean())
    return np.stack([one[2] for one in every]), np.stack([one[1] for one in every]), rate


def contact_of(force: Floats) -> slice:
    """Return the samples of the force about its contact; elsewhere the hammer's channel vibrates."""
    at = int(np.argmax(force))
    return slice(max(at - 14, 0), at + 14)


def by_cgid(response: Floats, force: Floats, rate: float, left_out: int, band: tuple[float, float]) -> Floats:
    """Return the errors of one tap through the modes of the others."""
    others = [k for k in range(len(response)) if k != left_out]
    test = tap_test(
        np.concatenate(response[others])[None], rate, hammer=np.concatenate(force[others]), band=band, source="taps"
    )
    modes = test.response
    onset = contact_of(force[left_out]).start / rate
    found = recover_force(response[left_out][None], rate, modes, [onset], band=band)[0]
    true = np.zeros_like(force[left_out])
    part = contact_of(force[left_out])
    true[part] = force[left_out][part]
    errors = errors_of(found, true, rate)
    own = np.round((found.time + errors["delay"]) * rate)
    width = time_above(found.time, found.force, 0.5) / time_above(np.arange(true.size) / rate, true, 0.5) - 1
    measured = np.interp(found.time + errors["delay"], np.arange(true.size) / rate, true)
    within = np.abs(found.force - measured) <= 1.96 * found.deviation + 1e-9
    assert own.size == within.size
    print(
        f"    tap {left_out + 1}: {test.modes.frequency.size} modes of {len(test.used)} taps, delay "
        f"{1e6 * test.delay:.1f} us, held-out taps of the fit {np.round(test.unexplained, 3)}, "
        f"left out: {[tap.reason for tap in test.taps if tap.flaw]}"
    )
    left = unexplained_by(response[left_out], true, rate, band, test)
    return np.array([left, errors["force"], errors["peak"], width, errors["impulse"], within.mean()])


def unexplained_by(response: Floats, force: Floats, rate: float, band: tuple[float, float], test: object) -> float:
    """Return the fraction of a response that modes under the measured force leave, stepped as recursions."""
    from scipy.signal import lfilter

    modes = test.response  # type: ignore[attr-defined]
    fine = 16
    n = force.size * fine
    dense = np.fft.irfft(np.fft.rfft(force), n) * fine
    step, total = 1 / (rate * fine), np.zeros(n)
    for frequency, ratio, part in zip(modes.frequency, modes.damping_ratio, modes.participation(), strict=True):
        own = 2 * np.pi * frequency
        free = own * np.sqrt(1 - ratio**2)
        pole = -ratio * own + 1j * free
        grown = pole * step
        # The force is straight from step to step: exact for poles of any size.
        now, before = (np.expm1(grown) - grown) / grown**2, (np.exp(grown) * (grown - 1) + 1) / grown**2
        state = lfilter([step * now, step * before], [1, -np.exp(grown)], dense.astype(complex))
        total += (part * pole**2 / (1j * free) * state).real + part.real * dense
    late = test.delay * rate  # type: ignore[attr-defined]
    frequency = np.fft.rfftfreq(force.size, 1 / rate)
    spectrum = np.fft.rfft(total[::fine]) * np.exp(2j * np.pi * frequency / rate * late)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    measured = np.fft.rfft(response)[inside]
    return float(np.linalg.norm(measured - spectrum[inside]) / np.linalg.norm(measured))


def through(
    responses_at: Callable[[Floats], NDArray[np.complex128]],
    response: Floats,
    force: Floats,
    rate: float,
    band: tuple[float, float],
) -> Floats:
    """Return the errors of one tap through a frequency response, by least squares at samples about the contact."""
    frequency = np.fft.rfftfreq(force.size, 1 / rate)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    gain, measured = responses_at(frequency[inside]), np.fft.rfft(response)[inside]
    true = np.zeros_like(force)
    part = contact_of(force)
    true[part] = force[part]
    left = np.linalg.norm(measured - gain * np.fft.rfft(true)[inside]) / np.linalg.norm(measured)
    first = max(int(np.argmax(true)) - SOUGHT // 2, 0)
    samples = np.arange(first, first + SOUGHT)
    # Hat functions at twice the end of the band; at every sample where that is more.
    corners = np.arange(first, first + SOUGHT, max(rate / (2 * band[1]), 1.0))
    hats = np.maximum(1 - np.abs(samples[:, None] - corners) / max(rate / (2 * band[1]), 1.0), 0.0)
    matrix = (np.exp(-2j * np.pi * np.outer(frequency[inside], samples / rate)) @ hats) * gain[:, None]
    whole = np.concatenate([matrix.real, matrix.imag]), np.concatenate([measured.real, measured.imag])
    own = np.zeros_like(true)
    own[samples] = hats @ np.linalg.lstsq(*whole, rcond=1e-6)[0]
    times = np.arange(true.size) / rate
    width = time_above(times, own, 0.5) / time_above(times, true, 0.5) - 1
    error = np.linalg.norm(own - true) / np.linalg.norm(true)
    return np.array([left, error, own.max() / true.max() - 1, width, own.sum() / true.sum() - 1, np.nan])


def measured_response(
    response: Floats, force: Floats, rate: float, left_out: int
) -> tuple[Floats, NDArray[np.complex128]]:
    """Return frequencies [Hz] and the response measured at all taps but one (H1), with the forces of contacts alone."""
    others = [k for k in range(len(response)) if k != left_out]
    true = np.zeros_like(force)
    for row, own in zip(true, force, strict=True):
        row[contact_of(own)] = own[contact_of(own)]
    out, into = np.fft.rfft(response[others]), np.fft.rfft(true[others])
    response_at = (out * into.conj()).sum(axis=0) / np.square(np.abs(into)).sum(axis=0)
    return np.fft.rfftfreq(force.shape[1], 1 / rate), response_at


def by_measured(response: Floats, force: Floats, rate: float, left_out: int, band: tuple[float, float]) -> Floats:
    """Return the errors of one tap through the response measured at the others."""
    grid, h1 = measured_response(response, force, rate, left_out)

    def at(frequency: Floats) -> NDArray[np.complex128]:
        return h1[np.searchsorted(grid, frequency)]

    return through(at, response[left_out], force[left_out], rate, band)


def by_lscf(response: Floats, force: Floats, rate: float, left_out: int, band: tuple[float, float]) -> Floats | None:
    """Return the errors of one tap through modes of sdypy-EMA; None if it is not installed."""
    try:
        from sdypy import EMA
    except ImportError:
        return None
    grid, h1 = measured_response(response, force, rate, left_out)
    model = EMA.Model(h1[None, 1:], grid[1:], lower=band[0], upper=band[1], pol_order_high=100)
    model.get_poles(method="lscf", show_progress=False)
    # All poles of the highest order in the band: the residual outside of it is a mass and a stiffness line.
    keep = [k for k, s in enumerate(model.all_poles[-1]) if s.imag > 0 and band[0] < abs(s) / 2 / np.pi < band[1]]
    model.pole_ind = [[len(model.all_poles) - 1, k] for k in keep]
    rebuilt, _ = model.get_constants()

    def at(frequency: Floats) -> NDArray[np.complex128]:
        return np.interp(frequency, model.freq, rebuilt[0].real) + 1j * np.interp(
            frequency, model.freq, rebuilt[0].imag
        )

    return through(at, response[left_out], force[left_out], rate, band)


def leave_one_out(folder: Path) -> None:
    """Print the errors of each band and way."""
    response, force, rate = taps_of(folder)
    rows = []
    for band in BANDS:
        for name, way in (("cgid", by_cgid), ("measured response", by_measured), ("LSCF, sdypy-EMA", by_lscf)):
            start = time.process_time()
            try:
                found = [way(response, force, rate, tap, band) for tap in range(len(response))]
            except BadData as error:
                print(error)
                continue
            if any(one is None for one in found):
                print("    sdypy-EMA is not installed: no row of it")
                continue
            seconds = (time.process_time() - start) / len(found)
            each = np.array(found)
            middle = [*np.median(np.abs(each[:, :5]), axis=0), np.mean(each[:, 5])]
            cells = " | ".join(f"{value:.3f}" if np.isfinite(value) else "" for value in middle)
            signed = ", ".join(f"{value:+.3f}" for value in each[:, 4])
            rows.append(f"| {band[0]:g} to {band[1]:g} | {name} | {cells} | {signed} | {seconds:.1f} |")
            for number, one in enumerate(each, 1):
                print(
                    f"    {name}, tap {number}: " + ", ".join(f"{n} {v:+.3f}" for n, v in zip(NAMES, one, strict=True))
                )
    print("\nmedians of the five taps left out, of absolute values\n")
    print("| band [Hz] | through | " + " | ".join(NAMES) + " | impulse of each | processor time [s] |")
    print(f"|{'---|' * 10}")
    print("\n".join(rows))


def four_sensors(folder: Path) -> None:
    """Print the errors of the force of one tap through the modes of the other at another point."""
    first, second = (loadmat(next(folder.rglob(f"Data_{name}.mat")))["Data"] for name in ("1_3", "2_1"))
    band, rate = (30.0, 900.0), 1e4
    print("\n| sensors | tap | unexplained | force | peak | duration | impulse |")
    print(f"|{'---|' * 7}")
    every = [tap_test(first[:, k][None], rate, hammer=first[:, 0], band=band) for k in range(1, 5)]
    modes = [one.response for one in every]
    for sensors in ((0,), (1,), (2,), (3,), (0, 1), (0, 1, 2, 3)):
        for name, data in (("the same", first), ("the other", second)):
            onset = (np.argmax(data[:, 0] > 0.05 * data[:, 0].max()) - 3) / rate
            response = data[:, [k + 1 for k in sensors]].T
            found = recover_force(response, rate, [modes[k] for k in sensors], [onset], band=band)[0]
            errors = errors_of(found, data[:, 0], rate)
            cells = " | ".join(f"{errors[one]:.3f}" for one in ("force", "peak", "duration", "impulse"))
            print(f"| {', '.join(str(k + 1) for k in sensors)} | {name} | {found.unexplained:.3f} | {cells} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pyfrf", type=Path, help="folder of cgid fetch taps-pyfrf")
    parser.add_argument("--dagnn", type=Path, help="folder of cgid fetch taps-dagnn")
    arguments = parser.parse_args()
    if arguments.dagnn is not None:
        four_sensors(arguments.dagnn)
    if arguments.pyfrf is not None:
        leave_one_out(arguments.pyfrf)
