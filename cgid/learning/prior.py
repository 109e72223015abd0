"""Which seams there are: published ranges of coal and of the rock beside it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cgid._lib.validation import Floats


class SeamNumbers(NamedTuple):
    """Numbers of simulated seams; of each pair the first is of coal, the second of gangue, (n_seams,) each."""

    moduli: tuple[Floats, Floats]  # medians of Young's moduli [Pa]
    spreads: tuple[Floats, Floats]  # standard deviations of their logarithms
    restitutions: tuple[Floats, Floats]  # means
    densities: tuple[Floats, Floats]  # means [kg/m^3]
    largest: tuple[Floats, Floats]  # radii [m]
    ratios: tuple[Floats, Floats]  # largest over smallest radius
    lowest_fall: Floats  # [m]
    highest_fall: Floats


def seam_numbers(n_seams: int, rng: np.random.Generator) -> SeamNumbers:
    """Return seams that are drawn from the prior.

    Moduli, densities and sizes are published ranges of coal, mudstone, shale, sandstone and limestone (`datasets`);
    their spreads within a seam, restitutions and falls are assumed.
    """

    def uniform(low: float, high: float) -> Floats:
        return rng.uniform(low, high, n_seams)

    def log_uniform(low: float, high: float) -> Floats:
        return np.exp(uniform(np.log(low), np.log(high)))

    coal = log_uniform(1.3e9, 5.5e9)
    gangue = np.exp(rng.uniform(np.log(np.maximum(4e9, 1.4 * coal)), np.log(32e9)))
    spreads = uniform(0.25, 0.45), uniform(0.35, 0.65)
    bounce = uniform(0.24, 0.45)
    restitutions = bounce, bounce + uniform(0.05, 0.27)
    densities = uniform(1280, 1500), uniform(2200, 2750)
    largest, ratio = log_uniform(0.028, 0.165), log_uniform(2.5, 9.0)
    other = rng.random(n_seams) < 0.5
    size = np.where(other, log_uniform(0.6, 1.7), 1.0)
    ratios = ratio, np.where(other, log_uniform(2.5, 9.0), ratio)
    low = log_uniform(0.15, 1.2)
    high = low + uniform(0.4, 3.1)
    return SeamNumbers((coal, gangue), spreads, restitutions, densities, (largest, size * largest), ratios, low, high)
