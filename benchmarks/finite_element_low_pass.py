"""The contact force from the acceleration of the sphere's centre, after an FFT filter: table and picture."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from finite_element_cases import SPEEDS, impact, percent, row, solved, table
from scipy import sparse
from scipy.sparse import linalg

from cgid.files import write_whole
from cgid.finite_element import History
from cgid.finite_element.assembly import Body
from cgid.measure.filters import fft_filter
from cgid.plots import COLOURS, png, require_matplotlib
from cgid.validation import Floats

PICTURE = Path(__file__).with_name("finite_element.png")
#: Spheres and speeds in the picture.
SHOWN = ((1, 2.0), (1, 6.0), (1, 10.0), (3, 10.0))
#: Edges of the filter times the contact duration.
EDGES = (2, 3, 4, 5, 6, 8)
#: Contact durations of zeros before touch.
BEFORE = 1.0


def low_pass(options: argparse.Namespace) -> None:
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
