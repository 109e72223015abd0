"""The finite-element reference: accuracy, time and memory against elements, and the force by the sphere's acceleration.

    python benchmarks/impact/finite_element.py                                  # both tables
    python benchmarks/impact/finite_element.py --parts convergence --elements 7 14 28 56

Spheres of Table 2 of Yang, Zeng & Wan (2018), radius 25 mm, on the steel plate of 8 mm with a fixed lower face. What
the theories miss, and what a soft contact does, is in the figures of `python -m studies.paper`. One thread; seconds are
processor time. Times depend on the machine: compare ratios.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse import linalg
from threadpoolctl import threadpool_limits

from cgid.measure.filters import fft_filter
from cgid.physics import STEEL, YANG2018_SPHERES, HertzRangeWarning, Sphere
from studies.finite_element import ElasticPlate, FiniteElementImpact, History
from studies.finite_element.assembly import Body

#: Edges of the filter times the contact duration.
EDGES = (2, 3, 4, 5, 6, 8)


def impact(sphere: int, velocity: float, elements: int) -> FiniteElementImpact:
    return FiniteElementImpact(
        sphere=Sphere(material=YANG2018_SPHERES[sphere], radius=0.025),
        plate=ElasticPlate(material=STEEL, thickness=0.008, radius=0.229, lower_face="fixed"),
        velocity=velocity,
        elements=elements,
    )


def convergence(elements: list[int]) -> None:
    """Print peaks, seconds and memory of impacts, each in a process of its own."""
    columns = (
        "sphere",
        "m/s",
        "elements",
        "peak force [N]",
        "off by",
        "nodes",
        "steps",
        "s",
        "MB",
        "energy",
        "momentum",
    )
    print(f"\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for case in ((1, 2.0), (3, 10.0)):
        runs = []
        for n in elements:
            command = [sys.executable, __file__, "--alone", json.dumps([*case, n])]
            runs.append(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout))
        for n, (force, *cost) in zip(elements, runs, strict=True):
            cells = (*case, n, f"{force:.5g}", f"{100 * (force / runs[-1][0] - 1):+.2f} %", *cost)
            print(f"| {' | '.join(map(str, cells))} |", flush=True)


def alone(sphere: int, velocity: float, elements: int) -> None:
    """Print the cost of one impact as JSON; memory is what the process came to hold more (Linux only)."""
    impact(1, 10.0, 7).run()  # compiles, imports
    process = Path("/proc/self")
    (process / "clear_refs").write_text("5")  # resets the peak

    def memory() -> int:
        return int((process / "status").read_text().partition("VmHWM:")[2].split()[0])

    before, start = memory(), time.process_time()
    request = impact(sphere, velocity, elements)
    history = request.run()
    seconds = round(time.process_time() - start, 2)
    errors = (f"{error:.0e}" for error in (history.energy_error, history.momentum_error))
    megabytes = round((memory() - before) / 1000, 1)
    print(json.dumps([history.peak_force, request.n_nodes, history.n_steps, seconds, megabytes, *errors]))


def low_pass(spheres: tuple[int, ...], speeds: tuple[float, ...]) -> None:
    """Print the peak after low-passes at n / T against that of the contact force."""
    print(f"\n| sphere | m/s | first mode x T | unfiltered | {' | '.join(f'{edge}/T' for edge in EDGES)} |")
    print("|---" * (4 + len(EDGES)) + "|")
    worst = np.zeros(len(EDGES))
    for sphere in spheres:
        mode = first_mode(impact(sphere, 2.0, 7).pair.sphere)
        for speed in speeds:
            history = impact(sphere, speed, 14).run()
            found = np.array([filtered(history, edge) for edge in EDGES]) / history.peak_force - 1
            worst = np.where(np.abs(found) > np.abs(worst), found, worst)
            raw = history.centre_node_force.samples.max() / history.peak_force - 1
            cells = (f"{100 * error:+.2f} %" for error in (raw, *found))
            print(f"| {sphere} | {speed:g} | {mode * history.contact_duration:.2f} | {' | '.join(cells)} |", flush=True)
    print(f"| worst | | | | {' | '.join(f'{100 * error:+.2f} %' for error in worst)} |")


def filtered(history: History, edge: float) -> float:
    """Return the largest mass x acceleration of the centre below edge / contact duration [N]."""
    signal = history.centre_node_force
    lead = round(history.contact_duration * signal.sampling_rate)
    samples = np.concatenate((np.zeros(lead), signal.samples))
    return float(fft_filter(samples, signal.sampling_rate, high=edge / history.contact_duration).max())


def first_mode(sphere: Body) -> float:
    """Return the lowest frequency [Hz] of a free sphere at which its centre moves."""
    free = sphere.free
    stiffness, mass = sphere.stiffness[free][:, free], sphere.mass[free]
    below = -((2 * np.pi * 1e3) ** 2)
    squares, shapes = linalg.eigsh(stiffness.tocsc(), 8, M=sparse.diags_array(mass).tocsc(), sigma=below)
    nodes = sphere.mesh.nodes
    centre = np.searchsorted(free, 2 * sphere.mesh.nearest(0.0, float(nodes[:, 1].max()) / 2) + 1)
    # Shapes have unit mass: a translation of the whole sphere is 1 / sqrt(mass).
    moves = np.abs(shapes[centre]) * np.sqrt(mass[free % 2 == 1].sum())
    frequency = np.sqrt(np.maximum(squares, 0.0)) / (2 * np.pi)
    return float(min(frequency[(moves > 0.1) & (frequency > 100.0)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=("convergence", "low-pass"), default=("convergence", "low-pass"))
    parser.add_argument("--elements", type=int, nargs="+", default=[7, 14, 28], help="over the contact radius")
    parser.add_argument("--spheres", type=int, nargs="+", default=(1, 2, 3, 4), help="of the low-pass")
    parser.add_argument("--speeds", type=float, nargs="+", default=(2.0, 4.0, 6.0, 8.0, 10.0), help="of the low-pass")
    parser.add_argument("--alone", help=argparse.SUPPRESS)
    options = parser.parse_args()
    # The study includes displacements of a tenth of the radius and more.
    warnings.simplefilter("ignore", HertzRangeWarning)
    with threadpool_limits(1):
        if options.alone:
            alone(*json.loads(options.alone))
            return
        if "convergence" in options.parts:
            convergence(options.elements)
        if "low-pass" in options.parts:
            low_pass(options.spheres, options.speeds)


if __name__ == "__main__":
    main()
