"""Shapes of the impacts of `datasets/finite_element.npz`, compared with the fitted family, the laws and finer meshes.

A part of `finite_element_identification.py`.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from finite_element_rocks import FAMILY, FINITE_ELEMENTS, VISCOELASTIC, extreme_rocks, solved_again

from cgid.identification.estimation import Estimates, estimate
from cgid.measure.template import curve
from cgid.physics.sampled import SampledPulses, smoothed
from cgid.scene.given_pulses import SolvedImpacts

#: Classes of restitution in the tables of shape.
EDGES = (0.1, 0.25, 0.35, 0.45, 0.55, 0.65, 1.0)
#: Samples of a contact in the fit without noise, and the noise that the fit assumes, relative to the peak.
SAMPLES, NO_NOISE = 400, 1e-3
#: Elements over the contact radius and steps over Hertz's duration; the stored impacts have 12 and 250.
FINER_ELEMENTS, FINER_STEPS = 28, 1000


def without_noise(pulses: SampledPulses) -> tuple[np.ndarray, float]:
    """Return frames of pulses of equal duration (it has no effect) and peak 1, and their sampling rate."""
    alike = pulses.stretched(1 / pulses.peak_force, 1 / pulses.contact_duration)
    frames = np.zeros((len(pulses), 4 * SAMPLES))
    alike.add_to_frames(frames, float(SAMPLES), np.full(len(pulses), 1.0))
    return frames, float(SAMPLES)


def family_curve(found: Estimates, shape: tuple[int, ...], rate: float) -> np.ndarray:
    """Return the fitted pulses on the samples of the frames."""
    times = np.arange(shape[1]) / rate
    share = (times - found.onset[:, None]) / found.contact_duration[:, None]
    return found.peak[:, None] * curve(share, np.log(found.restitution))[0]


@dataclass(frozen=True)
class Fits:
    """The family's best pulse for each noiseless pulse; errors are relative, except for `restitution`."""

    explained: np.ndarray
    rms: np.ndarray
    largest: np.ndarray
    peak: np.ndarray
    duration: np.ndarray
    restitution: np.ndarray


def fits(impacts: SolvedImpacts) -> Fits:
    """Return how well the family's best pulses fit the impacts during contact."""
    frames, rate = without_noise(impacts.pulses)
    found = estimate(frames, rate, pre_trigger=SAMPLES // 2, noise=NO_NOISE)
    inside = slice(SAMPLES, 2 * SAMPLES + 1)
    truth = frames[:, inside]
    error = family_curve(found, frames.shape, rate)[:, inside] - truth
    spread = truth - truth.mean(axis=1, keepdims=True)
    return Fits(
        explained=1 - np.sum(error**2, axis=1) / np.sum(spread**2, axis=1),
        rms=np.sqrt(np.mean(error**2, axis=1)),
        largest=np.abs(error).max(axis=1),
        peak=found.peak - 1,
        duration=found.contact_duration - 1,
        restitution=found.restitution - impacts.columns["restitution"],
    )


def shape_table(kinds: dict[str, SolvedImpacts]) -> None:
    """Print the explained share of the shape, and the errors of numbers read off the fit, by restitution."""
    print("| pulses | restitution | impacts | explained, mean | least | rms / peak | largest / peak | ", end="")
    print("read off: restitution | peak | duration |\n|---|---|---|---|---|---|---|---|---|---|")
    for name, impacts in kinds.items():
        found, truth = fits(impacts), impacts.columns["restitution"]
        for low, high in [(EDGES[0], EDGES[-1]), *pairwise(EDGES)]:
            rows = (truth >= low) & (truth < high)
            if not rows.any():
                continue
            off, explained = found.restitution[rows], found.explained[rows]
            print(
                f"| {name} | {low:g} to {high:g} | {rows.sum()} | {explained.mean():.5f} | {explained.min():.5f} | "
                f"{found.rms[rows].mean():.4f} | {found.largest[rows].mean():.4f} | "
                f"{off.mean():+.4f} ({off.std():.4f}) | {found.peak[rows].mean():+.4f} | "
                f"{found.duration[rows].mean():+.4f} |"
            )


def physics_table(kinds: dict[str, SolvedImpacts]) -> None:
    """Print the solved impacts against the laws at equal restitution, with nothing fitted: mean (deviation)."""
    print("| finite elements over | peak force | contact duration | impulse over peak | impulse | explained |")
    print("|---|---|---|---|---|---|")
    solved = kinds[FINITE_ELEMENTS].pulses
    times = np.linspace(0, 1, SAMPLES) * solved.contact_duration[:, None]
    truth = solved.force(times)
    spread = truth - truth.mean(axis=1, keepdims=True)
    for name in (VISCOELASTIC, FAMILY):
        law = kinds[name].pulses
        columns = [
            solved.peak_force / law.peak_force,
            solved.contact_duration / law.contact_duration,
            solved.impulse / solved.peak_force / (law.impulse / law.peak_force),
            solved.impulse / law.impulse,
            1 - np.sum((law.force(times) - truth) ** 2, axis=1) / np.sum(spread**2, axis=1),
        ]
        print(f"| {name} | " + " | ".join(f"{column.mean():.4f} ({column.std():.4f})" for column in columns) + " |")


def finer_table(solved: SolvedImpacts, n: int) -> None:
    """Print the differences of n stored time series from those of a finer mesh with shorter steps."""
    print("| row | modulus [GPa] | restitution | rms / peak | largest / peak | restitution, stored minus finer |")
    print("|---|---|---|---|---|---|")
    for row in extreme_rocks(solved, n):
        finer = solved_again(solved, row, FINER_ELEMENTS, FINER_STEPS)
        times = np.linspace(0, 1.02, SAMPLES) * finer.contact_duration
        shares = np.clip(times / finer.contact_duration, 0, 1)
        truth = smoothed(finer.times, finer.contact_force.samples, finer.contact_duration, shares, solved.made["knots"])
        error = (solved.pulses.taken(slice(row, row + 1)).force(times)[0] - truth) / truth.max()
        restitution = solved.columns["restitution"][row]
        print(
            f"| {row} | {solved.columns['youngs_modulus'][row] / 1e9:.2f} | {restitution:.3f} | "
            f"{np.sqrt(np.mean(error**2)):.5f} | {np.abs(error).max():.5f} | {restitution - finer.restitution:+.5f} |",
            flush=True,
        )
