"""The finite-element reference: accuracy, time, memory, damping and sizes.

    python benchmarks/finite_element.py                              # all tables, and benchmarks/finite_element.png
    python benchmarks/finite_element.py --parts convergence --elements 7 14 28 56
    python benchmarks/finite_element.py --quick                      # fewer impacts, coarser meshes, no picture

Spheres of Table 2 of Yang, Zeng & Wan (2018), radius 25 mm, on the steel plate of 8 mm with a fixed lower face; 14
elements over the contact radius unless a table says otherwise. Parts:

* convergence: peaks, seconds and memory against elements;
* methods: explicit and implicit steps on one mesh, time against error, undamped and damped;
* peers: assembly against scikit-fem (if installed), steps against a loop with scipy's product and another contact;
* damping: Kelvin-Voigt spheres against Kuwabara-Kono and Hunt-Crossley;
* low-pass: the force from the acceleration of the sphere's centre, after an FFT filter; the picture;
* sizes: effect of the sphere's size, the plate's radius and thickness, and its support.

What the theories miss, and what a soft contact does, is in the figures of `python -m studies.paper`.

One thread; seconds are processor time, the first run compiles. Times depend on the machine: compare ratios.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from finite_element_cases import (
    ELEMENTS,
    PLATE_RADIUS,
    RADIUS,
    SPEEDS,
    THICKNESS,
    impact,
    peaks,
    percent,
    row,
    solved,
    table,
    theory,
)
from finite_element_cost import against_elements, methods, peers, print_alone
from scipy import sparse
from scipy.sparse import linalg
from threadpoolctl import threadpool_limits

from cgid.files import write_whole
from cgid.measure.filters import fft_filter
from cgid.physics import (
    HertzRangeWarning,
    HuntCrossley,
    Impact,
    Viscoelastic,
    damping_number,
    delivered_restitution,
)
from cgid.plots import COLOURS, png, require_matplotlib
from cgid.validation import Floats
from studies.finite_element import History
from studies.finite_element.assembly import Body

Options = argparse.Namespace
PICTURE = Path(__file__).with_name("finite_element.png")
#: Spheres and speeds in the picture.
SHOWN = ((1, 2.0), (1, 6.0), (1, 10.0), (3, 10.0))
#: Edges of the filter times the contact duration.
EDGES = (2, 3, 4, 5, 6, 8)
#: Contact durations of zeros before touch.
BEFORE = 1.0


def _joined(ratios: Floats) -> str:
    return " / ".join(f"{ratio:.3f}" for ratio in ratios)


def damping(options: Options) -> None:
    """Print restitutions and loops of Kelvin-Voigt spheres against two laws of damping.

    Kuwabara-Kono's constant follows from b without a fit. Hunt-Crossley receives the computed restitution; its change
    with speed follows from the damping fitted at the lowest speed.
    """
    columns = (
        "restitution",
        "Kuwabara-Kono",
        "its loop off by",
        "Hunt-Crossley, fitted at 2 m/s",
        "its loop, fitted here",
    )
    table("sphere", "m/s", "b [us]", "method", *columns)
    for sphere in (1,) if options.quick else (1, 3):
        for delay in (2e-6, 10e-6) if options.quick else (0.5e-6, 1e-6, 2e-6, 5e-6, 10e-6, 20e-6):
            rate = None
            for speed in (2.0, 10.0) if options.quick else (2.0, 5.0, 10.0):
                damped, _ = solved(sphere, speed, elements=options.mesh, retardation_time=delay)
                undamped, _ = solved(sphere, speed, elements=options.mesh)
                hertz, restitution = theory(sphere, speed), damped.restitution
                lossy = replace(hertz, dissipation=Viscoelastic(time_constant=delay))
                fitted = replace(hertz, dissipation=HuntCrossley(restitution=restitution))
                rate = float(damping_number(restitution)) / speed if rate is None else rate
                cells = [f"{restitution:.4f}"]
                for said in (float(lossy.restitution), float(delivered_restitution(rate * speed))):
                    cells.append(f"{said:.4f} ({said - restitution:+.4f})")
                off = [f"{100 * loop_error(damped, undamped, law, hertz):.1f} %" for law in (lossy, fitted)]
                way = impact(sphere, speed, elements=options.mesh, retardation_time=delay).chosen_method
                row(sphere, f"{speed:g}", f"{1e6 * delay:g}", way, cells[0], cells[1], off[0], cells[2], off[1])
    print(
        "\nLoops: force over its peak against displacement over its largest, there and back, less the same without "
        "damping (so that what finite size does to both drops out); the largest difference."
    )


def loop_error(damped: History, undamped: History, law: Impact, hertz: Impact) -> float:
    """Return the distance of a law's loop from that of the finite elements, relative to the peak force."""
    found, said = loop(damped) - loop(undamped), loop(law) - loop(hertz)
    return float(np.abs(found - said).max())


def loop(of: History | Impact) -> Floats:
    """Return force / peak at even steps of displacement / largest displacement, there and back."""
    if isinstance(of, Impact):
        times = np.linspace(0.0, float(of.contact_duration), 4001)
        force, way = of.force(times), of.displacement(times)
    else:
        force, way = of.contact_force.samples, of.centre_displacement.samples
    turn, places = int(way.argmax()), np.linspace(0.0, 1.0, 201)
    force, way = force / force.max(), way / way.max()
    there = np.interp(places, way[: turn + 1], force[: turn + 1])
    back = np.interp(places, way[turn:][::-1], force[turn:][::-1], left=0.0)
    return np.concatenate((there, back))


def sizes(options: Options) -> None:
    """Print the peaks, relative to K1, for other spheres and plates."""
    speed = 2.0
    cases: list[tuple[str, dict[str, Any]]] = [("the paper's plate", {})]
    for radius in (0.01, 0.05) if options.quick else (0.005, 0.01, 0.05):
        scale = radius / RADIUS
        alike = {"radius": radius, "thickness": scale * THICKNESS, "plate_radius": scale * PLATE_RADIUS}
        cases += [(f"R {1e3 * radius:g} mm, plate alike", alike), (f"R {1e3 * radius:g} mm", {"radius": radius})]
    for thickness in (0.004, 0.032) if options.quick else (0.004, 0.016, 0.032, 0.1):
        cases.append((f"plate {1e3 * thickness:g} mm thick", {"thickness": thickness}))
    for radius in (0.05,) if options.quick else (0.02, 0.05, 0.1, 0.458):
        cases.append((f"plate {1e3 * radius:g} mm of radius", {"plate_radius": radius}))
    for thickness in (0.008,) if options.quick else (0.008, 0.016, 0.032, 0.1):
        free = {"thickness": thickness, "lower_face": "free"}
        cases.append((f"plate {1e3 * thickness:g} mm thick, held by nothing", free))
    table("sphere", "what is other", "P / DCS / T over K1", "over the paper's plate", "restitution", "nodes", "s")
    for sphere in (1,) if options.quick else (1, 3):
        usual = None
        for name, change in cases:
            history, seconds = solved(sphere, speed, elements=options.mesh, **change)
            over = peaks(history) / peaks(theory(sphere, speed, radius=change.get("radius", RADIUS)))
            usual = over if usual is None else usual
            beside = " / ".join(percent(e) for e in over / usual - 1)
            nodes = impact(sphere, speed, elements=options.mesh, **change).n_nodes
            row(sphere, name, _joined(over), beside, f"{history.restitution:.4f}", nodes, f"{seconds:.1f}")


def low_pass(options: Options) -> None:
    """Print the peak after low-passes at n / T against that of the contact force; draw some at 4/T and 5/T."""
    spheres, speeds = ((1,), (6.0,)) if options.quick else ((1, 2, 3, 4), SPEEDS)
    mode = {sphere: first_mode(impact(sphere, 2.0, elements=7).pair.sphere) for sphere in spheres}
    table("sphere", "m/s", "first mode x T", "unfiltered", *(f"{edge}/T" for edge in EDGES))
    worst: dict[int, list[float]] = {edge: [] for edge in EDGES}
    for sphere in spheres:
        for speed in speeds:
            history, _ = solved(sphere, speed, elements=options.mesh)
            raw, peak = history.centre_node_force.samples.max(), history.peak_force
            for edge in EDGES:
                worst[edge].append(filtered(history, edge).max() / peak - 1)
            first = mode[sphere] * history.contact_duration
            errors = (percent(worst[edge][-1]) for edge in EDGES)
            row(sphere, f"{speed:g}", f"{first:.2f}", percent(raw / peak - 1, 0), *errors)
    row("worst", "", "", "", *(percent(max(errors, key=abs)) for errors in worst.values()))
    modes = ", ".join(f"{f / 1e3:.1f} kHz (sphere {sphere})" for sphere, f in mode.items())
    print(
        "\nThe largest value behind the filter against the largest contact force. First mode: the lowest of the free "
        f"sphere that moves its centre, {modes}. A filter past it lets its wave stand on the pulse; where in the wave "
        "the peak falls changes with the speed."
    )
    if not options.quick:
        write_whole(PICTURE, picture([(*case, solved(*case, elements=options.mesh)[0]) for case in SHOWN]))


def filtered(history: History, edge: float) -> Floats:
    """Return mass x acceleration of the centre below edge / contact duration, from touch on [N]."""
    signal = history.centre_node_force
    lead = round(BEFORE * history.contact_duration * signal.sampling_rate)
    samples = np.concatenate((np.zeros(lead), signal.samples))
    return np.asarray(fft_filter(samples, signal.sampling_rate, high=edge / history.contact_duration)[lead:])


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


def picture(cases: list[tuple[int, float, History]]) -> bytes:
    """Draw the force of the centre, raw and filtered, with the contact force, and its error."""
    figure = require_matplotlib()(figsize=(13, 6), layout="constrained")
    above, below = figure.subplots(2, len(cases), sharex="col", sharey="row", height_ratios=(3, 2))
    for top, bottom, case in zip(above, below, cases, strict=True):
        _draw(top, bottom, *case)
    above[0].set_ylabel("force over the contact force's peak")
    below[0].set_ylabel("off by [% of the peak]")
    above[0].legend(fontsize=8, loc="upper left")
    return png(figure)


def _draw(top: Any, bottom: Any, sphere: int, speed: float, history: History) -> None:
    peak, force = history.peak_force, history.contact_force.samples
    time = np.arange(force.size) / history.contact_force.sampling_rate / history.contact_duration
    raw = history.centre_node_force.samples / peak
    top.plot(time, raw, color="0.85", linewidth=0.4, zorder=0, label="mass x acceleration of the sphere's centre")
    told = []
    for edge, colour, line in zip((4, 5), COLOURS, ("-", "--"), strict=False):
        samples = filtered(history, edge)
        told.append(f"{edge}/T: {percent(samples.max() / peak - 1, 1)}")
        top.plot(time, samples / peak, line, color=colour, linewidth=1.4, label=f"of that, what is below {edge}/T")
        bottom.plot(time, 100 * (samples - force) / peak, line, color=colour, linewidth=1.4)
    top.plot(time, force / peak, color="k", linewidth=2.5, zorder=1.5, label="contact force")
    top.set(ylim=(-0.3, 1.8), xlim=(0, 1.15))
    top.set_title(f"sphere {sphere}, {speed:g} m/s\npeak at {', at '.join(told)}", fontsize=10)
    bottom.set(xlabel="time over the contact's T", ylim=(-9, 9))
    for axes in (top, bottom):
        axes.axhline(0, color="k", linewidth=0.5)
        axes.grid(alpha=0.3)


#: Name on the command line, heading and function of each part.
PARTS: dict[str, tuple[str, Callable[[Options], None]]] = {
    "convergence": ("Peaks, seconds and memory against elements over the contact radius", against_elements),
    "methods": ("Explicit beside implicit steps", methods),
    "peers": ("Beside scikit-fem's assembly and a loop with scipy's product", peers),
    "damping": ("Kelvin-Voigt spheres", damping),
    "low-pass": ("Force by the acceleration of the centre", low_pass),
    "sizes": ("Spheres and plates of other sizes", sizes),
}


def main() -> None:
    """Run the requested parts and print Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument(
        "--elements", type=int, nargs="+", help="of convergence and peers (default 7 14 28, quick 7 14)"
    )
    parser.add_argument("--mesh", type=int, default=ELEMENTS, help="elements of the other parts (default 14)")
    parser.add_argument("--quick", action="store_true", help="fewer impacts, no picture")
    parser.add_argument("--alone", help=argparse.SUPPRESS)
    options = parser.parse_args()
    # The study includes displacements of a tenth of the radius and more.
    warnings.simplefilter("ignore", HertzRangeWarning)
    if options.alone:
        print_alone(options.alone)
        return
    options.elements = options.elements or ([7, 14] if options.quick else [7, 14, 28])
    solved(1, 10.0, elements=7)  # compiles
    with threadpool_limits(1):
        for part in options.parts:
            heading, work = PARTS[part]
            start = time.perf_counter()
            print(f"\n## {heading}", flush=True)
            work(options)
            print(f"\n({time.perf_counter() - start:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
