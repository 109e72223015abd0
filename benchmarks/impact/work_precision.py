"""Run time against error of damped Hertz pulses: cgid and the usual alternatives in one run.

    python benchmarks/impact/work_precision.py                 # table, benchmarks/impact/work_precision.csv and .png
    python benchmarks/impact/work_precision.py --quick         # two minutes: fewer settings of the peers, no files
    python benchmarks/impact/work_precision.py --laws          # one minute: every contact law
    python benchmarks/impact/work_precision.py --modes         # two minutes: rocks on the modes of a beam

The population is that of the shipped scene "peers": 2048 samples at 200 kHz, float64, one thread. All fill fresh frames
with the same pulses on the same grid; the error is the largest force error over the peak of a pulse, against
quadrature (1e-13) of the first 500. Peers receive mass, stiffness, damping and velocity, cgid
mass, stiffness, restitution and velocity; "from materials" also builds the impacts from radius, moduli and density.
Times are processor times, the least of several runs, and depend on the machine: compare ratios. `--laws` has a table of
every contact law on a half space, on a plate of 20 mm and with weight, at three tolerances: these rocks with the same
restitution by other laws; "and viscous" has a viscous restitution of .7 besides. Errors are against scipy's DOP853
(rtol 1e-12 and less), of the first 20. `--modes` has the rocks of `tail_beam` on its modes, at 200 times of the
contact; peers have every mode as two states, and the error is that of the force against DOP853 (rtol 1e-12), of the
first 5.

Peers solve `x'' = -x^(3/2) (1 + D x')`, x(0) = 0, x'(0) = 1, in units of L and T0; atol is a hundredth of rtol, for x
starts at 0. solve_ivp and the fixed steps find the separation themselves; odeint stops at given times only, so it
receives the contact duration. At touch the force grows as the power 3/2 of the displacement, so equal steps converge
at order 2.5, not 4; graded steps are equal in sqrt(time) at first, which restores order 4.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import odeint, solve_ivp

from cgid import shipped
from cgid._lib.files import write_whole
from cgid.physics import (
    STEEL,
    HalfSpace,
    HuntCrossley,
    Impact,
    Law,
    Material,
    ModalImpact,
    Sphere,
    ThinPlate,
    Thornton,
    Viscoelastic,
    WaltonBraun,
)
from cgid.physics.contact.curves import TOLERANCE, HuntCrossleyCurves
from cgid.plots.figure import png, require_matplotlib
from cgid.scene import load_scene
from cgid.scene.synthesis.impacts import draw
from studies.paper.sensitivity import yield_pressure

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests import naive
from tests.references.make_family import reference_pulse

Floats = NDArray[np.float64]
HERE = Path(__file__).parent
KNOWN, INTEGRATED = 500, 20  # pulses whose error is measured; quadrature is slow, and DOP853 slower
BLOCK = 250  # frames at a time: 4 MB, as in data generation
VISCOUS = 0.7  # restitution that the viscous loss alone leaves, where there are both losses
LEVELS = tuple(10.0**-exponent for exponent in range(3, 10))
_jit = numba.njit(error_model="numpy", fastmath=True)

SAMPLING_RATE = 200e3
SAMPLES = 2048
ONSET = 100


@dataclass(frozen=True)
class Population:
    """Impacts `m x'' = -K x^(3/2) (1 + chi x')`, x(0) = 0, x'(0) = v; arrays of shape (n,), SI units.

    mass, stiffness, damping, velocity : m [kg], K [N/m^(3/2)], chi [s/m], v [m/s]
    restitution, contact_duration : results: rebound speed / v, and time in contact [s]
    """

    mass: Floats
    stiffness: Floats
    damping: Floats
    velocity: Floats
    restitution: Floats
    contact_duration: Floats

    def __len__(self) -> int:
        """Return the number of impacts."""
        return self.mass.size

    def part(self, start: int, stop: int) -> Population:
        """Return the impacts from start to stop."""
        return Population(*(getattr(self, field.name)[start:stop] for field in fields(self)))

    @property
    def time_scale(self) -> Floats:
        """T0 = L / v [s]."""
        return (self.mass * self.velocity**2 / self.stiffness) ** 0.4 / self.velocity

    @property
    def force_scale(self) -> Floats:
        """K L^(3/2) [N]."""
        return self.stiffness * (self.mass * self.velocity**2 / self.stiffness) ** 0.6

    @property
    def damping_number(self) -> Floats:
        """D = chi v."""
        return self.damping * self.velocity

    @property
    def spacing(self) -> Floats:
        """One sample in units of T0."""
        return 1 / (SAMPLING_RATE * self.time_scale)

    @property
    def samples_in_contact(self) -> NDArray[np.int64]:
        """Number of samples in contact, including that of touch."""
        return np.ceil(self.contact_duration * SAMPLING_RATE).astype(np.int64)


def population(n: int, seed: int = 0) -> Population:
    scene = load_scene(shipped.scene_path("peers"))
    impacts = [draw(scene, seed, block).impact for block in range(math.ceil(n / 256))]
    columns = (
        [impact.reduced_mass for impact in impacts],
        [impact.contact_stiffness for impact in impacts],
        [impact.dissipation.damping_number / impact.velocity for impact in impacts],
        [impact.velocity for impact in impacts],
        [impact.restitution for impact in impacts],
        [impact.contact_duration for impact in impacts],
    )
    return Population(*(np.concatenate(column)[:n] for column in columns))


def reference_frames(population: Population) -> Floats:
    """Return the exact frames, by quadrature (1e-13 of the peak)."""
    frames = np.zeros((len(population), SAMPLES))
    times = np.arange(SAMPLES - ONSET)
    for i, restitution in enumerate(population.restitution):
        _, force = reference_pulse(float(restitution)).evaluate(times * population.spacing[i])
        frames[i, ONSET:] = force * population.force_scale[i]
    return frames


def frame_errors(frames: Floats, reference: Floats) -> Floats:
    return np.abs(frames - reference).max(axis=1) / reference.max(axis=1)


@_jit
def _force(x: float, u: float, damping: float) -> float:
    return max(x * math.sqrt(x) * (1 + damping * u), 0.0) if x > 0 else 0.0


@_jit
def _rk4(frames, spacing, damping, scale, steps, graded):
    for i in range(frames.shape[0]):
        h, d = spacing[i], damping[i]
        x, u, force = 0.0, 1.0, 0.0
        for k in range(frames.shape[1] - ONSET - 1):
            n, root, width = steps, math.sqrt(k * h), 0.0
            if graded:
                # Equal steps in sqrt(time), in which the pulse is smooth at touch, until they exceed the others.
                stretch = math.sqrt((k + 1) * h) - root
                n = max(n, math.ceil(stretch * 2 * steps / h))
                width = stretch / n
            step = h / n
            for j in range(n):
                if graded:
                    step = width * (2 * root + (2 * j + 1) * width)
                u2 = u - 0.5 * step * force
                a2 = _force(x + 0.5 * step * u, u2, d)
                u3 = u - 0.5 * step * a2
                a3 = _force(x + 0.5 * step * u2, u3, d)
                u4 = u - step * a3
                a4 = _force(x + step * u3, u4, d)
                x += step / 6 * (u + 2 * u2 + 2 * u3 + u4)
                u -= step / 6 * (force + 2 * a2 + 2 * a3 + a4)
                force = _force(x, u, d)
                if x <= 0:
                    break
            if x <= 0:
                break
            frames[i, ONSET + k + 1] = scale[i] * force


def numba_rk4(population: Population, steps: int, graded: bool = False) -> Floats:
    """Runge-Kutta of order 4 in numba, with equal steps per sample; graded: early steps equal in sqrt(time)."""
    frames = np.zeros((len(population), SAMPLES))
    _rk4(frames, population.spacing, population.damping_number, population.force_scale, steps, graded)
    return frames


@_jit
def _right_side(t, y, damping):
    return y[1], -_force(y[0], y[1], damping)


@_jit
def _jacobian(t, y, damping):
    root = math.sqrt(max(y[0], 0.0))
    return np.array([[0.0, 1.0], [-1.5 * root * (1 + damping * y[1]), -max(y[0], 0.0) * root * damping]])


def _separation(t: float, y: Floats, damping: float) -> float:
    return y[0]


_separation.terminal, _separation.direction = True, -1


def _pulse(states: Floats, damping: float) -> Floats:
    x = np.maximum(states[0], 0)
    return np.maximum(x * np.sqrt(x) * (1 + damping * states[1]), 0)


def scipy_solve_ivp(population: Population, method: str, tolerance: float) -> Floats:
    """SciPy's solve_ivp, stopped by an event at separation; it does not receive the duration."""
    frames = np.zeros((len(population), SAMPLES))
    times = np.arange(SAMPLES - ONSET)
    spacings, scales = population.spacing, population.force_scale
    options = {"rtol": tolerance, "atol": tolerance / 100, **({"jac": _jacobian} if method == "Radau" else {})}
    for i, damping in enumerate(population.damping_number.tolist()):
        grid = times * spacings[i]
        span, start = (0.0, grid[-1]), (0.0, 1.0)
        solution = solve_ivp(_right_side, span, start, method, grid, events=_separation, args=(damping,), **options)
        frames[i, ONSET : ONSET + solution.t.size] = scales[i] * _pulse(solution.y, damping)
    return frames


def scipy_odeint(population: Population, tolerance: float) -> Floats:
    """SciPy's odeint (LSODA), the grid cut at separation."""
    frames = np.zeros((len(population), SAMPLES))
    spacings, scales, counts = population.spacing, population.force_scale, population.samples_in_contact
    options = {"rtol": tolerance, "atol": tolerance / 100, "mxstep": 10_000}
    for i, damping in enumerate(population.damping_number.tolist()):
        grid = np.arange(counts[i]) * spacings[i]
        states = odeint(_right_side, (0.0, 1.0), grid, args=(damping,), tfirst=True, **options)
        frames[i, ONSET : ONSET + counts[i]] = scales[i] * _pulse(states.T, damping)
    return frames


class Peer(NamedTuple):
    """A function from population and setting to frames, its settings, and the number of pulses to time."""

    run: Callable[..., Floats]
    settings: list[dict[str, Any]]
    pulses: int


def _tolerances(*exponents: int, **fixed: Any) -> list[dict[str, Any]]:
    return [{**fixed, "tolerance": 10.0**exponent} for exponent in exponents]


_EXPONENTS = (-3, -5, -7, -9, -11)
_STEPS = (1, 4, 16, 64)

#: By name, cheap ones first.
PEERS: dict[str, Peer] = {
    "numba RK4": Peer(numba_rk4, [{"steps": n} for n in _STEPS], 2000),
    "numba RK4, graded": Peer(numba_rk4, [{"steps": n, "graded": True} for n in _STEPS], 2000),
    "odeint": Peer(scipy_odeint, _tolerances(*_EXPONENTS), 200),
    "solve_ivp RK45": Peer(scipy_solve_ivp, _tolerances(*_EXPONENTS, method="RK45"), 20),
    "solve_ivp DOP853": Peer(scipy_solve_ivp, _tolerances(*_EXPONENTS, method="DOP853"), 20),
    "solve_ivp LSODA": Peer(scipy_solve_ivp, _tolerances(*_EXPONENTS, method="LSODA"), 20),
    "solve_ivp Radau": Peer(scipy_solve_ivp, _tolerances(*_EXPONENTS[:-1], method="Radau"), 20),
}


# -- cgid beside them -------------------------------------------------------------------------------------

Run = Callable[[Population], np.ndarray]


class ContactRow(NamedTuple):
    """One law on one target: times of a pulse and of its results besides, and the largest error over the peak."""

    law: str
    target: str
    tolerance: float
    pulse: float
    results: float
    error: float


class Row(NamedTuple):
    """One method at one setting."""

    method: str
    setting: str
    microseconds: float
    worst: float
    median: float


def curves(impacts: Population) -> HuntCrossleyCurves:
    nothing = np.zeros(len(impacts))
    return HuntCrossleyCurves(HuntCrossley, impacts.restitution[:, None], nothing, nothing, TOLERANCE)


def cgid_frames(impacts: Population, dtype: str = "float64") -> np.ndarray:
    frames = np.zeros((len(impacts), SAMPLES), dtype)
    onset = np.full(len(impacts), float(ONSET))
    curves(impacts).add_to_frames(frames, onset, impacts.spacing, impacts.force_scale, 1)
    return frames


def from_materials(n: int) -> Run:
    def run(_: Population) -> np.ndarray:
        return impacts_of(n).force_frames(SAMPLING_RATE, SAMPLES, ONSET / SAMPLING_RATE)

    return run


@cache
def drawn_numbers(n: int) -> dict[str, np.ndarray]:
    scene = load_scene(shipped.scene_path("peers"))
    blocks = [draw(scene, 0, block).parameters for block in range(-(-n // 256))]
    return {name: np.concatenate([block[name] for block in blocks])[:n] for name in blocks[0]}


def impacts_of(n: int, dissipation: Law | None = None) -> Impact:
    """Return n impacts of the population, from materials, radius and velocity; by default with its own loss."""
    drawn = drawn_numbers(n)
    rock = Material(**{name: drawn[name] for name in ("density", "youngs_modulus", "poisson_ratio")})
    return Impact(
        sphere=Sphere(material=rock, radius=drawn["radius"]),
        target=HalfSpace(material=STEEL),
        velocity=drawn["velocity"],
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=drawn["restitution"]) if dissipation is None else dissipation,
    )


def thornton(impacts: Impact) -> Thornton:
    return Thornton(yield_pressure=yield_pressure(impacts.restitution, impacts))


def walton_braun(impacts: Impact) -> WaltonBraun:
    stiffness = 0.8 * impacts.contact_stiffness * np.sqrt(1.25**0.4 * impacts.length_scale)
    return WaltonBraun(restitution=impacts.restitution, loading_stiffness=stiffness)


def viscous(law: Callable[[Impact], Thornton | WaltonBraun]) -> Callable[[Impact], Law]:
    return lambda impacts: replace(law(impacts), viscous_restitution=VISCOUS)


def contact_rows(n: int) -> list[ContactRow]:
    """Return a row for each law, target and tolerance: pulses of n rocks, errors of the first against DOP853."""
    base = impacts_of(n)
    plate = ThinPlate(material=STEEL, thickness=0.02)
    laws: dict[str, Law] = {
        "Hunt-Crossley": HuntCrossley(restitution=base.restitution),
        "Kuwabara-Kono": Viscoelastic(restitution=base.restitution),
        "Thornton": thornton(base),
        "Walton-Braun": walton_braun(base),
        "Thornton and viscous": viscous(thornton)(base),
        "Walton-Braun and viscous": viscous(walton_braun)(base),
    }
    rows = []
    for name, law in laws.items():
        for where, target, gravity in (
            ("half-space", base.target, 0.0),
            ("plate", plate, 0.0),
            ("weight", base.target, 9.81),
        ):
            for tolerance in (1e-4, 1e-6, 1e-8):
                given = {"target": target, "gravity": gravity, "tolerance": tolerance, "dissipation": law}
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    impact = replace(base, **given)
                    onset = ONSET / SAMPLING_RATE
                    pulses = least_time(lambda i=impact, o=onset: i.force_frames(SAMPLING_RATE, SAMPLES, o), 3)
                    results = least_time(lambda g=given: replace(base, **g).peak_force, 3)
                error = max(contact_error(impact, row) for row in range(INTEGRATED))
                rows.append(ContactRow(name, where, tolerance, pulses / n * 1e6, results / n * 1e6, error))
                print(rows[-1], file=sys.stderr, flush=True)
    return rows


def contact_error(impact: Impact, row: int) -> float:
    """Return the largest error of a pulse over its peak, against scipy's DOP853."""
    law, numbers = impact.dissipation, [float(one.ravel()[row]) for one in impact._numbers.values()]
    more = float(np.ravel(impact.inelasticity)[row]), float(np.ravel(impact.weight)[row])
    if isinstance(law, Thornton | WaltonBraun):
        paths = naive.thornton_paths if isinstance(law, Thornton) else naive.walton_braun_paths
        *own, damping = numbers
        force, end, _, _ = naive.plastic_contact(*paths(*own), damping, *more)
    else:
        damping = float(np.ravel(law.damping_number)[row]) if isinstance(law, HuntCrossley) else 0.0
        contact = naive.Contact(damping, 0.0 if isinstance(law, HuntCrossley) else numbers[0], *more)
        end, force = contact.contact_time, lambda times: contact.evaluate(times)[1]
    times = end * np.sin(np.pi / 2 * np.linspace(0, 1, 202)[1:-1]) ** 2
    exact = force(times)
    found = impact.force(times * np.ravel(impact.time_scale)[row])[row] / np.ravel(impact.force_scale)[row]
    return float(np.abs(found - exact).max() / exact.max())


@_jit
def _on_modes(_time, state, squares, losses, shares, damping):
    n, out = shares.size, np.empty(state.size)
    x, u = state[0], state[1]
    for r in range(n):
        x -= shares[r] * state[2 + r]
        u -= shares[r] * state[2 + n + r]
    force = x * math.sqrt(x) * max(1.0 + damping * u, 0.0) if x > 0.0 else 0.0
    out[0], out[1] = state[1], -force
    for r in range(n):
        out[2 + r] = state[2 + n + r]
        out[2 + n + r] = force - losses[r] * state[2 + n + r] - squares[r] * state[2 + r]
    return out


@_jit
def _rk4_on_modes(grid, steps, squares, losses, shares, damping):
    states, now, t = np.empty((2 + 2 * shares.size, grid.size)), np.zeros(2 + 2 * shares.size), 0.0
    now[1] = 1.0
    for k in range(grid.size):
        h = (grid[k] - t) / steps
        for _ in range(steps):
            a = _on_modes(t, now, squares, losses, shares, damping)
            b = _on_modes(t, now + 0.5 * h * a, squares, losses, shares, damping)
            c = _on_modes(t, now + 0.5 * h * b, squares, losses, shares, damping)
            d = _on_modes(t, now + h * c, squares, losses, shares, damping)
            now = now + h / 6 * (a + 2.0 * b + 2.0 * c + d)
        states[:, k], t = now, grid[k]
    return states


def _modal_peer(how: str, impact: Any, row: int, grid: Floats, setting: float) -> Floats:
    """Return the force of one impact over its scale at times [T0], with every mode as two states."""
    frequency, ratio, compliance = impact._modes(impact.reduced_mass.shape)
    omega = 2 * np.pi * frequency * impact.time_scale[row]
    shares = np.ascontiguousarray(compliance[row]) * impact.reduced_mass[row]
    given = omega**2, 2 * ratio * omega, shares, float(impact.curves.numbers[row, 0])
    start = np.zeros(2 + 2 * omega.size)
    start[1] = 1.0
    if how == "numba RK4":
        states = _rk4_on_modes(grid, int(setting), *given)
    elif how == "odeint":
        states = odeint(
            _on_modes, start, np.append(0.0, grid), given, rtol=setting, atol=setting / 100, tfirst=True, mxstep=10**5
        )[1:].T
    else:
        options = {"rtol": setting, "atol": setting / 100, "t_eval": grid}
        states = solve_ivp(_on_modes, (0, grid[-1]), start, method="DOP853", args=given, **options).y
    n = omega.size
    x, u = states[0] - shares @ states[2 : 2 + n], states[1] - shares @ states[2 + n :]
    return np.where(x > 0, np.abs(x) ** 1.5 * np.maximum(1 + given[-1] * u, 0), 0)


def mode_rows() -> list[Row]:
    """Return a row for each method and setting: rocks of `tail_beam` on the modes of their beam."""
    drawn = draw(load_scene(shipped.scene_path("tail_beam")), 0, 0)
    (base,) = [strike.pulses for strike in drawn.strikes if isinstance(strike.pulses, ModalImpact)]
    n, known = base.reduced_mass.size, range(5)
    grids = [np.linspace(0, 1, 201)[1:] * base.end_of_contact[row] / base.time_scale[row] for row in range(n)]
    times = np.array(grids) * base.time_scale[:, None]
    exact = [_modal_peer("solve_ivp DOP853", base, row, grids[row], 1e-12) for row in known]

    def error(forces: Any) -> list[float]:
        return [float(np.abs(force - one).max() / one.max()) for force, one in zip(forces, exact, strict=True)]

    rows = []
    for tolerance in (1e-4, 1e-6, 1e-8):
        run = lambda t=tolerance: replace(base, tolerance=t).force(times)  # noqa: E731
        errors = error(run()[list(known)] / base.force_scale[list(known), None])
        rows.append(Row("cgid", f"{tolerance:g}", least_time(run, 3) / n * 1e6, max(errors), float(np.median(errors))))
    for how, settings in {
        "solve_ivp DOP853": (1e-4, 1e-6, 1e-8), "odeint": (1e-4, 1e-6, 1e-8), "numba RK4": (1, 4, 16),
    }.items():  # fmt: skip
        for setting in settings:
            run = lambda h=how, s=setting: [_modal_peer(h, base, row, grids[row], s) for row in known]  # noqa: E731
            errors = error(run())
            seconds = least_time(run, 1) / len(known)
            rows.append(Row(how, f"{setting:g}", seconds * 1e6, max(errors), float(np.median(errors))))
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def contact_table(rows: list[ContactRow]) -> str:
    lines = [
        "| law | target | us a pulse at 1e-4 / 1e-6 / 1e-8 | with its results | error at 1e-8 |",
        "|---|---|---|---|---|",
    ]
    for first in range(0, len(rows), 3):
        part = rows[first : first + 3]
        pulses, results = (" / ".join(f"{getattr(one, what):.3g}" for one in part) for what in ("pulse", "results"))
        lines.append(f"| {part[0].law} | {part[0].target} | {pulses} | {results} | {part[-1].error:.0e} |")
    return "\n".join(lines)


def least_time(run: Callable[[], Any], repeats: int) -> float:
    """Return the least processor time of several runs [s]; the first, which compiles, does not count."""
    run()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        result = run()
        times.append(time.process_time() - start)
        del result
    return min(times)


def measured(
    method: str, setting: str, run: Run, few: Population, exact: np.ndarray, repeats: int, block: int = BLOCK
) -> Row:
    """Return time and error of one method at one setting; frames are filled block by block."""
    known = min(len(few), len(exact))
    errors = frame_errors(run(few)[:known].astype(np.float64), exact[:known])
    parts = [few.part(first, first + block) for first in range(0, len(few), block)]
    seconds = least_time(lambda: [run(part) is None for part in parts], repeats)
    return Row(method, setting, seconds / len(few) * 1e6, float(errors.max()), float(np.median(errors)))


def work_precision(impacts: Population, quick: bool) -> list[Row]:
    exact = reference_frames(impacts.part(0, KNOWN))
    whole = len(impacts)
    rows = [
        measured("cgid", "table", cgid_frames, impacts, exact, 25),
        measured("cgid", "table, from materials", from_materials(whole), impacts, exact, 15, block=whole),
        measured("cgid", "table, float32", lambda few: cgid_frames(few, "float32"), impacts, exact, 25),
    ]
    for name, peer in PEERS.items():
        few = impacts.part(0, min(peer.pulses, 10 if quick and peer.pulses < 100 else peer.pulses))
        for setting in peer.settings[::2] if quick else peer.settings:
            text = ", ".join(f"{key} {value:g}" for key, value in setting.items() if isinstance(value, int | float))
            rows.append(measured(name, text, lambda few, s=setting, p=peer: p.run(few, **s), few, exact, 3))
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def work_table(rows: list[Row]) -> str:
    lines = ["| method | setting | us per pulse | worst error / peak | median |", "|---|---|---|---|---|"]
    lines += [f"| {r.method} | {r.setting} | {r.microseconds:.3g} | {r.worst:.1e} | {r.median:.1e} |" for r in rows]
    return "\n".join(lines)


def ratio_table(rows: list[Row]) -> str:
    """Return each peer's time as a multiple of that of cgid's table, at its cheapest setting within each error."""
    ours = next(row for row in rows if row.setting == "table")
    methods = dict.fromkeys(row.method for row in rows if row.method != "cgid")
    lines = ["| within an error of | " + " | ".join(f"{level:.0e}" for level in LEVELS) + " |"]
    lines.append("|---|" + "---|" * len(LEVELS))
    for method in methods:
        cells = []
        for level in LEVELS:
            within = [row.microseconds for row in rows if row.method == method and row.worst <= level]
            cells.append(f"{min(within) / ours.microseconds:.3g}" if within else "-")
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def picture(rows: list[Row]) -> bytes:
    figure = require_matplotlib()(figsize=(7.5, 5), layout="constrained")
    axes = figure.subplots()
    for method in dict.fromkeys(row.method for row in rows if row.method != "cgid"):
        points = [(row.worst, row.microseconds) for row in rows if row.method == method]
        axes.loglog(*zip(*points, strict=True), "o-", markersize=4, linewidth=1, label=method)
    for setting, marker in (("table", "*"), ("table, float32", "P")):
        row = next(row for row in rows if row.setting == setting)
        axes.loglog(row.worst, row.microseconds, marker, color="k", markersize=12 if marker == "*" else 7)
        axes.annotate(
            f"cgid, {setting}",
            (row.worst, row.microseconds),
            (0, 9),
            textcoords="offset points",
            weight="bold",
            ha="center",
        )
    axes.invert_xaxis()
    axes.set(xlabel="largest force error / peak", ylabel="time per pulse [us], one thread", xlim=(1, 1e-17))
    axes.set_title("2048-sample frames at 200 kHz, damped Hertz pulses", fontsize=10)
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(fontsize=8, loc="upper right")
    return png(figure)


def write(rows: list[Row]) -> None:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["method", "setting", "time per pulse [us]", "worst error / peak", "median error / peak"])
    writer.writerows([row.method, row.setting, *(f"{value:.4g}" for value in row[2:])] for row in rows)
    write_whole(HERE / "work_precision.csv", stream.getvalue().encode())
    write_whole(HERE / "work_precision.png", picture(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer settings, no files")
    parser.add_argument("--laws", action="store_true", help="every contact law instead")
    parser.add_argument("--modes", action="store_true", help="rocks on the modes of a beam instead")
    options = parser.parse_args()
    if options.modes:
        print(work_table(mode_rows()))
        return
    if options.laws:
        print(contact_table(contact_rows(2000)))
        return
    quick = options.quick
    impacts = population(2000)
    rows = work_precision(impacts, quick)
    print(f"\n{work_table(rows)}\n\nTimes as long as cgid's table (cheapest setting within the error):\n")
    print(ratio_table(rows))
    if not quick:
        write(rows)


if __name__ == "__main__":
    main()
