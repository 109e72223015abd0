"""A beam without a drawing: modes of a roving hammer on finite elements that are no ribbed plate.

    python benchmarks/beam/roving.py

The structure is made without `cgid`: a thin plate held along one side and at a corner, three times thicker on one side
than on the other, with a thick bar across and a hole. Elements are rectangles with cubic Hermite polynomials; response
and contacts are those of `independent_beam`. A hammer taps grids of places where rocks fall, and `cgid.calibration`
makes a scene of each recording. A model trained on it, and one trained on the true modes, answer for the same rocks.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse
from scipy.sparse.linalg import eigsh

from benchmarks.beam import independent_beam as other
from benchmarks.beam.through_beam import batches_of, judged
from cgid.calibration import roving_test
from cgid.identification.model.model import StoredModel
from cgid.identification.training.training import train_on_specimens
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.file.sections import with_table
from cgid.scene.synthesis.through_beam import beam_of

Floats = NDArray[np.float64]
#: Size of the plate [m], elements along its sides, modes, and steel.
SIZE, ELEMENTS, N_MODES = (1.2, 1.0), (30, 25), 200
YOUNG, POISSON, DENSITY = 210e9, 0.3, 7850.0
#: Where rocks fall and the sensor is [m]; each hammer tap has this long a place in the recording [s].
REGION, SENSOR, SPACING = (0.55, 1.15, 0.2, 0.8), (0.45, 0.4), 0.9
#: Band of the taps [Hz]: what the recorder passes.
BAND = (40.0, 11_500.0)
VARIANT = replace(other.VARIANTS["plain"], damping="light")
RECORDER = partial(other.chain, mounting=(1e9, 0.5))


def thickness(x: Floats, y: Floats) -> Floats:
    """Return the thickness of the plate [m], 0 in its hole."""
    out = 0.03 + 0.02 * y + 0.02 * x
    out = np.where((x > 0.84) & (x < 0.92), 0.065, out)
    return np.where((x > 0.16) & (x < 0.36) & (y > 0.56) & (y < 0.76), 0.0, out)


def hermite(u: Floats, length: float) -> Floats:
    """Return the four cubic polynomials of an element at u from 0 to 1, (n, 4): value and slope at either end."""
    return np.stack(
        [1 - 3 * u**2 + 2 * u**3, length * (u - 2 * u**2 + u**3), 3 * u**2 - 2 * u**3, length * (u**3 - u**2)], axis=1
    )


@dataclass(frozen=True, eq=False)
class Structure:
    """Modes of unit modal mass: frequency [Hz] and the four unknowns at each corner of the elements."""

    frequency: Floats
    unknowns: Floats  # (n_x, n_y, 4, n_modes): w, w_x, w_y, w_xy

    def shape(self, x: Floats, y: Floats) -> Floats:
        """Return w of each mode at points [m], (n, n_modes) [kg^-1/2]."""
        x, y = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
        steps = [size / n for size, n in zip(SIZE, ELEMENTS, strict=True)]
        i, k = (np.minimum(p // s, n - 1).astype(int) for p, s, n in zip((x, y), steps, ELEMENTS, strict=True))
        along, across = hermite(x / steps[0] - i, steps[0]), hermite(y / steps[1] - k, steps[1])
        out = np.zeros((x.size, self.frequency.size))
        for a in range(4):
            for b in range(4):
                corner = self.unknowns[i + a // 2, k + b // 2, a % 2 + 2 * (b % 2)]
                out += (along[:, a] * across[:, b])[:, None] * corner
        return out


@cache
def structure() -> Structure:
    """Return the modes of the plate."""
    points, weights = np.polynomial.legendre.leggauss(4)
    u, lines = (points + 1) / 2, []
    for size, n in zip(SIZE, ELEMENTS, strict=True):
        step = size / n
        value = hermite(u, step)
        slope = np.stack(
            [-6 * u + 6 * u**2, step * (1 - 4 * u + 3 * u**2), 6 * u - 6 * u**2, step * (3 * u**2 - 2 * u)]
        )
        bend = np.stack([-6 + 12 * u, step * (-4 + 6 * u), 6 - 12 * u, step * (6 * u - 2)])
        value, slope, bend = value.T, slope / step, bend / step**2
        pairs = ((value, value), (slope, slope), (bend, bend), (bend, value))
        lines.append([(one * (weights * step / 2)) @ two.T for one, two in pairs])
    (m_x, s_x, b_x, c_x), (m_y, s_y, b_y, c_y) = lines
    bending = np.kron(b_x, m_y) + np.kron(m_x, b_y) + POISSON * (np.kron(c_x, c_y.T) + np.kron(c_x.T, c_y))
    bending = bending + 2 * (1 - POISSON) * np.kron(s_x, s_y)
    inertia = np.kron(m_x, m_y)
    n_x, n_y = (n + 1 for n in ELEMENTS)
    number = np.arange(n_x * n_y * 4).reshape(n_x, n_y, 4)
    rows, columns, stiff, heavy = [], [], [], []
    for i in range(ELEMENTS[0]):
        for k in range(ELEMENTS[1]):
            h = float(thickness((i + 0.5) * SIZE[0] / ELEMENTS[0], (k + 0.5) * SIZE[1] / ELEMENTS[1]))
            if not h:
                continue
            own = np.array([number[i + a // 2, k + b // 2, a % 2 + 2 * (b % 2)] for a in range(4) for b in range(4)])
            rows.append(np.repeat(own, 16))
            columns.append(np.tile(own, 16))
            stiff.append((YOUNG * h**3 / 12 / (1 - POISSON**2) * bending).ravel())
            heavy.append((DENSITY * h * inertia).ravel())
    index, total = (np.concatenate(rows), np.concatenate(columns)), number.size
    stiffness = sparse.csc_array((np.concatenate(stiff), index), shape=(total, total))
    mass = sparse.csc_array((np.concatenate(heavy), index), shape=(total, total))
    held = np.zeros((n_x, n_y, 4), bool)
    held[0] = True  # clamped at x = 0
    held[-1, -1, 0] = True  # and supported at a corner
    free = np.flatnonzero((mass.diagonal() > 0) & ~held.ravel())
    squares, vectors = eigsh(stiffness[free][:, free], N_MODES, mass[free][:, free], sigma=0.0)
    order = np.argsort(squares)
    unknowns = np.zeros((total, N_MODES))
    unknowns[free] = vectors[:, order]
    return Structure(np.sqrt(squares[order]) / (2 * np.pi), unknowns.reshape(n_x, n_y, 4, N_MODES))


def grid(spacing: float) -> Floats:
    """Return places of a grid in the region, and the sensor's, (n, 2) [m]."""
    x, y = (np.linspace(a, b, round((b - a) / spacing) + 1) for a, b in (REGION[:2], REGION[2:]))
    return np.append(np.stack([part.ravel() for part in np.meshgrid(x, y, indexing="ij")], axis=1), [SENSOR], axis=0)


def tapped(places: Floats, seed: int, noise: float = 1e-3) -> tuple[Floats, Floats, Floats]:
    """Return acceleration [m/s^2] and force [N] of a tap at each place, and their times [s]."""
    modes, rng = structure(), np.random.default_rng(seed)
    omega, damping = 2 * np.pi * modes.frequency, other.damping_ratios(modes.frequency, VARIANT.damping)
    n, over, decay = 1 << 15, 4, 8.0
    step = round(SPACING * other.RATE)
    s = decay * other.RATE / n + 2j * np.pi * np.arange(int(1.5 * n)) * other.RATE / n
    nothing = np.zeros((0, omega.size))
    table = other.transfer(s, omega, damping, modes.shape(*SENSOR)[0], nothing, (), RECORDER)
    total = np.zeros((2, len(places) * step + n))
    starts = np.arange(len(places)) * step + rng.integers(200, 400, len(places))
    grow = np.exp(decay / n * np.arange(n))
    late = rng.random(len(places)) / other.RATE
    for row, shape in enumerate(modes.shape(*places.T)):
        lasts, peak = 1e-4 * rng.uniform(0.9, 1.2), rng.uniform(1e3, 3e3)
        turn = np.pi / lasts
        force = peak * turn * (1 + np.exp(-s * lasts)) / (s**2 + turn**2) * np.exp(-s * late[row])
        both = np.stack([force * (shape @ table), force * RECORDER(s)])
        samples = fft.irfft(both, over * n, axis=1)[:, ::over] * over * other.RATE
        total[:, starts[row] : starts[row] + n] += samples * grow
    level = np.sqrt(np.mean(np.square(total), axis=1, keepdims=True))
    total += rng.normal(0, 1, total.shape) * noise * level
    return total[0], total[1], starts / other.RATE + late


def scene_with(folder: Path, name: str) -> Scene:
    """Return the scene of tables that `cgid tap` has written."""
    content = json.loads(load_scene("tail_beam").text)
    point = zip("xy", (REGION[:2], REGION[2:]), strict=True)
    content["tail_beam"] = {
        "modes": f"{name}.csv",
        "learned": f"{name}.csv",
        "shapes": f"{name}-shapes.csv",
        "impact_point": {axis: {"distribution": "uniform", "lowest": a, "highest": b} for axis, (a, b) in point},
    }
    del content["sensor"]["mounting"]
    return parse_scene(with_table(content, folder), folder=folder)


def own_scene(highest: float = 12e3) -> Scene:
    """Return the scene of the true modes: their shapes at places 30 mm apart, without errors."""
    modes, places = structure(), grid(0.03)[:-1]
    kept = modes.frequency < highest
    sensor, shapes = modes.shape(*SENSOR)[0, kept], modes.shape(*places.T)[:, kept]
    rows = zip(modes.frequency[kept].tolist(), sensor.tolist(), strict=True)
    damping = float(other.damping_ratios(modes.frequency[:1], VARIANT.damping)[0])
    content = json.loads(load_scene("tail_beam").text)
    point = zip("xy", (REGION[:2], REGION[2:]), strict=True)
    content["tail_beam"] = {
        "modes": [
            {"frequency": f, "damping_ratio": damping, "modal_mass": 1.0, "shape_impact": 1.0, "shape_sensor": w}
            for f, w in rows
        ],
        "shapes": [
            {"x": x, "y": y, "shape": own} for (x, y), own in zip(places.tolist(), shapes.tolist(), strict=True)
        ],
        "impact_point": {axis: {"distribution": "uniform", "lowest": a, "highest": b} for axis, (a, b) in point},
    }
    del content["sensor"]["mounting"]
    return parse_scene(content)


def rocks_of(n: int, seed: int) -> dict[str, Any]:
    """Return recorded impacts of n rocks anywhere in the region."""
    rng = np.random.default_rng([seed, 9])
    fallen = other.rocks(n, rng)
    x, y = rng.uniform(*REGION[:2], n), rng.uniform(*REGION[2:], n)
    return other.generate(
        n, seed, VARIANT, sensors=(SENSOR,), given=fallen._replace(x=x, y=y), recorder=RECORDER, modes=structure()
    )


def row(name: str, scene: Scene, n_train: int, tests: dict[str, Any]) -> str:
    """Return how a model of a scene answers for rocks."""
    clock = time.process_time()
    beam = beam_of(scene)
    model: StoredModel = train_on_specimens(synthesise(scene, n_train, 640_001), beam=beam).model
    found = judged(model, batches_of(tests))
    return f"{found['accuracy']:.3f} | {found['unknown']:.2f} | {time.process_time() - clock:.0f} s |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--grids", type=float, nargs="*", default=[0.05, 0.075, 0.1], help="distances of places [m]")
    parser.add_argument("--train", type=int, default=6000, help="impacts to train on")
    parser.add_argument("--test", type=int, default=1024, help="impacts to answer for")
    options = parser.parse_args()
    tests = rocks_of(options.test, 64_064)
    print("| shapes | places | modes | not predicted from other places | accuracy | unknown | processor time |")
    print(f"|{'---|' * 7}")
    own = own_scene()
    print(f"| true | | {len(own.tail_beam.modes)} | | {row('true', own, options.train, tests)}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for spacing in options.grids:
            places = grid(spacing)
            response, force, times = tapped(places, round(1e6 * spacing))
            name = f"{1e3 * spacing:g} mm"
            found = roving_test(
                response[None], other.RATE, hammer=force, places=places, sensor=SENSOR, times=times, band=BAND
            )
            found.save(Path(folder) / "modes.csv", overwrite=True)
            scene = scene_with(Path(folder), "modes")
            left = f"{np.median(found.unpredicted):.3f}"
            cells = row(name, scene, options.train, tests)
            print(f"| {name} | {len(places)} | {found.modes.frequency.size} | {left} | {cells}", flush=True)


if __name__ == "__main__":
    main()
