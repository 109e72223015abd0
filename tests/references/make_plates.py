"""Make plates.csv: Leissa's table of clamped and cantilever plates, by his own method.

A. W. Leissa (1973), The free vibration of rectangular plates, J. Sound Vib. 31, 257-293: Ritz method with 36 products
of beam functions, Poisson's ratio .3, `lambda = omega a^2 sqrt(rho h / D)`, a along x. The results reproduce his
printed digits except for one last place (square, clamped: 35.992 73.413 108.27 131.64 132.24; square, held at x = 0:
3.4917 8.5246 21.429 27.331 31.111 54.443). As Ritz values they are too high: by up to .1 % clamped, .9 % cantilever.

    python tests/references/make_plates.py
"""

from pathlib import Path

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.linalg import eigh
from scipy.optimize import brentq

NODES, WEIGHTS = leggauss(200)
NODES, WEIGHTS = (NODES + 1) / 2, WEIGHTS / 2
POISSON_RATIO, N_FUNCTIONS, N_MODES = 0.3, 6, 6


def beam_function(b, sigma, complement, sign):
    """Return `cosh - sigma sinh + sign (cos - sigma sin)` of b x, its slope and curvature; complement is 1 - sigma."""
    falling, angle = np.exp(-b * NODES), b * NODES
    even, odd = falling + complement * np.sinh(angle), -falling + complement * np.cosh(angle)
    wave, turned = np.cos(angle) - sigma * np.sin(angle), np.sin(angle) + sigma * np.cos(angle)
    return even + sign * wave, b * (odd - sign * turned), b**2 * (even - sign * wave)


def held_at_start(number):
    functions = []
    for k in range(number):
        b = brentq(lambda b: np.cos(b) + 1 / np.cosh(b), max(k * np.pi, 0.5), (k + 1) * np.pi)
        below = np.sinh(b) + np.sin(b)
        complement = (below - np.cosh(b) - np.cos(b)) / below
        functions.append(beam_function(b, 1 - complement, complement, -1))
    return functions


def alike_at_both_ends(number, free):
    rest, still = np.ones_like(NODES), np.zeros_like(NODES)
    functions = [(rest, still, still), (np.sqrt(3) * (1 - 2 * NODES), -2 * np.sqrt(3) * rest, still)] if free else []
    for k in range(1, number + 1 - len(functions)):
        b = brentq(lambda b: np.cos(b) - 1 / np.cosh(b), (k + 0.5) * np.pi - 0.3, (k + 0.5) * np.pi + 0.3)
        below = np.sinh(b) - np.sin(b)
        complement = (below - np.cosh(b) + np.cos(b)) / below
        functions.append(beam_function(b, 1 - complement, complement, 1 if free else -1))
    return functions


def integrals(functions):
    value, slope, bend = (np.array([function[order] for function in functions]) for order in range(3))
    pairs = ((value, value), (slope, slope), (bend, bend), (bend, value))
    return [(first * WEIGHTS) @ second.T for first, second in pairs]


def parameters(edges, ratio):
    """Return lambda of the lowest modes; ratio is a / b, length over width."""
    cantilever = edges == "cantilever"
    x = integrals(held_at_start(N_FUNCTIONS) if cantilever else alike_at_both_ends(N_FUNCTIONS, free=False))
    y = integrals(alike_at_both_ends(N_FUNCTIONS, free=cantilever))
    stiffness = np.kron(x[2], y[0]) + ratio**4 * np.kron(x[0], y[2])
    stiffness += 2 * (1 - POISSON_RATIO) * ratio**2 * np.kron(x[1], y[1])
    coupled = POISSON_RATIO * ratio**2 * np.kron(x[3], y[3].T)
    mass = np.kron(x[0], y[0])
    return np.sqrt(eigh(stiffness + coupled + coupled.T, mass, eigvals_only=True)[:N_MODES])


def main():
    lines = ["edges,length_over_width," + ",".join(f"lambda_{mode}" for mode in range(1, N_MODES + 1))]
    for edges in ("clamped", "cantilever"):
        for ratio in (0.4, 1.0, 1.5, 2.5):
            lines.append(f"{edges},{ratio}," + ",".join(f"{value:.5g}" for value in parameters(edges, ratio)))
    Path(__file__).with_name("plates.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
