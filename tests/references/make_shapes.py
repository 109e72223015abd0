"""Make the tables of the pulse fit, cgid/measure/fit/template.npy and cgid/measure/fit/shapes.npz.

    python tests/references/make_shapes.py

The first holds the damped-Hertz pulse with its derivatives, the second its times, a bank of pulses, and how pulses of
other laws of loss differ from it. The pulses of the bank lie in common coordinates, in which they overlap best with the
elastic one.

Pulses of Thornton, Walton and Braun, and Kuwabara and Kono of restitution .1 to .97 are fitted by the damped-Hertz
family without noise. What is left, in the coordinates of `cgid.measure.fit.search` and without what a change of the
fitted parameters would explain, has few principal components (Jolliffe 2002, Principal component analysis).
"""

import numpy as np

from cgid.measure.fit.fit import PulseStart, fit_pulses
from cgid.measure.fit.residual import N_SHAPES as N_COMPONENTS
from cgid.measure.fit.residual import residual_bins
from cgid.measure.fit.search import BIN, MIDDLES, N_BINS, NODES, Samples, bank
from cgid.measure.fit.template import (
    MIN_SHAPE,
    N_CELLS,
    N_SHAPES,
    SHAPES_PATH,
    TEMPLATE_PATH,
    curve,
    dimensionless,
    tables,
)
from cgid.physics import STEEL, YANG2018_SPHERES, HalfSpace, Impact, Sphere, Thornton, Viscoelastic, WaltonBraun

SAMPLES = 400  # of contact, so that sampling does not matter


STEP = 1e-3  # of difference quotients in s, and in the shapes of the bank


def in_shape(function, shapes):
    """Return a function of the shape and its first two derivatives at shapes that are not above 0."""
    # The family ends at the lowest shape: quotients about a point further on.
    middle = np.maximum(shapes, MIN_SHAPE + STEP)
    off = (shapes - middle).reshape(-1, *(1,) * (function(shapes).ndim - 1))
    below, at, above = (function(middle + sign * STEP) for sign in (-1, 0, 1))
    bend = (above - 2 * at + below) / STEP**2
    return function(shapes), (above - below) / (2 * STEP) + off * bend, bend


def template() -> np.ndarray:
    """Return the table of `slopes_and_pulse`, as `cgid.measure.fit.template.tables` describes it."""
    shapes, x = np.linspace(MIN_SHAPE, 0.0, N_SHAPES), np.arange(N_CELLS + 1)

    def along(step):
        """The contact's points moved by a step [cells]; curves there."""
        return lambda s: curve(np.broadcast_to((x + step) / N_CELLS, (s.size, x.size)), s)

    value, slope_s, bend_s = in_shape(along(0.0), shapes)
    small, large = 1e-3, 0.1
    slope = (along(small)(shapes) - along(-small)(shapes)) / (2 * small)
    bend = (along(large)(shapes) - 2 * value + along(-large)(shapes)) / large**2
    twist = (in_shape(along(large), shapes)[1] - in_shape(along(-large), shapes)[1]) / (2 * large)
    # At the ends the curve is as u^(3/2): a parabola that meets it half a cell inside.
    bend[:, [0, -1]] = 8 * curve(np.broadcast_to(np.array([0.5, N_CELLS - 0.5]) / N_CELLS, (shapes.size, 2)), shapes)
    for part in (value, slope, slope_s, twist, bend_s):
        part[:, [0, -1]] = 0.0
    return np.array([value, slope, bend, slope_s, twist, bend_s], np.float32)


def over_width(shapes: np.ndarray) -> np.ndarray:
    """Return contact duration and time to the peak over the width, (n, 2)."""
    restitution, contact, peak_time, peak = dimensionless(-np.abs(shapes))
    # The impulse of m x'' from 1 to -e is 1 + e. Above 0 pulses are reversed.
    rises = np.where(shapes > 0, contact - peak_time, peak_time)
    return np.stack([contact, rises], axis=1) * (peak / (1 + restitution))[:, None]


def times() -> np.ndarray:
    """Return `over_width` with derivatives in s, (N_SHAPES, 2, 3)."""
    return np.stack(in_shape(over_width, np.linspace(MIN_SHAPE, 0.0, N_SHAPES)), axis=-1)


def averaged(place: np.ndarray, width: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pulses averaged over the bins, and their slopes in place and ln(width), each (n, n_bins)."""
    duration, lead = over_width(shape).T[:, :, None]
    points = np.add.outer(MIDDLES, BIN * (np.arange(4) - 1.5) / 4).ravel()
    fraction = ((points - place[:, None]) / width[:, None] + lead) / duration
    value, above, below = (curve(fraction + step, shape) for step in (0.0, 1e-6, -1e-6))
    slope = -(above - below) / 2e-6 / duration / width[:, None]
    parts = (value, slope, slope * (points - place[:, None]))
    value, in_place, in_width = (part.reshape(len(shape), N_BINS, 4).mean(axis=2) for part in parts)
    return value, in_place, in_width


def tangents_at(shapes: np.ndarray, place: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return how changes of peak, place, width and shape change pulses, (n, n_bins, 4), the pulses themselves first.

    Place and width (n_nodes,) are those of the bank, and changes of them are of the common coordinates.
    """
    own_place, own_width = np.interp(shapes, NODES, place), np.interp(shapes, NODES, width)
    value, in_place, in_width = averaged(own_place, own_width, shapes)
    near = [np.clip(shapes + k, NODES[0], NODES[-1]) for k in (-STEP, STEP)]
    before, after = (averaged(np.interp(one, NODES, place), np.interp(one, NODES, width), one)[0] for one in near)
    slope = (after - before) / (near[1] - near[0])[:, None]
    # The origin of the common coordinates is not the peak.
    return np.stack([value, in_place, in_width + own_place[:, None] * in_place, slope], axis=2)


def pulses() -> np.ndarray:
    """Return pulses of all laws in frames, (n, n_samples), each with a contact of `SAMPLES`."""
    laws = [
        Thornton(yield_pressure=np.geomspace(2e6, 1.2e9, 60)),
        WaltonBraun(restitution=np.linspace(0.1, 0.97, 60)),
        Viscoelastic(dissipative_constant=np.geomspace(2e-6, 4e-4, 60)),
    ]
    frames = []
    for law in laws:
        impact = Impact(
            sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
            target=HalfSpace(material=STEEL),
            velocity=np.full(60, 4.0),
            stiffness="hertz",
            dissipation=law,
        )
        keep = (impact.restitution > 0.1) & (impact.restitution < 0.98)
        times = (np.arange(3 * SAMPLES) - SAMPLES + 0.37)[None] * (impact.contact_duration / SAMPLES)[:, None]
        force = impact.force(times)
        frames.append((force / impact.peak_force[:, None])[keep])
    return np.concatenate(frames)


def coordinates() -> tuple[np.ndarray, np.ndarray]:
    """Return place and width of the pulses of the bank, each (n_nodes,): they overlap best with the elastic one."""
    reference = averaged(np.zeros(1), np.ones(1), np.zeros(1))[0][0]
    place, width = np.zeros(NODES.size), np.ones(NODES.size)
    for _ in range(8):
        parts = np.stack(averaged(place, width, NODES), axis=2)
        step = np.linalg.solve(np.swapaxes(parts, 1, 2) @ parts, np.swapaxes(parts, 1, 2) @ reference[None, :, None])
        place = place + step[:, 1, 0] / step[:, 0, 0] * 0.7
        width = width * np.exp(np.clip(step[:, 2, 0] / step[:, 0, 0] * 0.7, -0.3, 0.3))
    return place, width


def main() -> None:
    """Make the tables and the bank, fit with them, take what is left, write its principal components."""
    np.save(TEMPLATE_PATH, template())
    tables.cache_clear()
    bank.cache_clear()
    place, width = coordinates()
    of_bank = {"times": times(), "place": place, "width": width, "tangents": tangents_at(NODES, place, width)}
    np.savez(SHAPES_PATH, **of_bank)
    frames = pulses()
    n = len(frames)
    start = PulseStart(np.ones(n), frames.sum(axis=1), frames.argmax(axis=1).astype(float))
    fit = fit_pulses(frames, start, np.full(n, 1e-3))
    samples = Samples(frames, np.zeros(n), np.full(n, np.inf), np.zeros(n, np.intp))
    bins, _, node = residual_bins(samples, fit.peak, fit.width, fit.onset, fit.shape)
    bases = np.linalg.qr(bank().tangents)[0][node]
    left = bins.values - np.einsum("nbk,nck,nc->nb", bases, bases, bins.values)
    _, sizes, components = np.linalg.svd(left, full_matrices=False)
    spreads = sizes[:N_COMPONENTS] / np.sqrt(n)
    print("root mean square of the components over the peak:", spreads.round(4))
    rest = left - (left @ components[:N_COMPONENTS].T) @ components[:N_COMPONENTS]
    print("left without, with them:", *(f"{np.sqrt(np.mean(part**2)):.4f}" for part in (left, rest)))
    signs = np.sign(components[:N_COMPONENTS, :].sum(axis=1, keepdims=True))
    np.savez(SHAPES_PATH, **of_bank, components=signs * components[:N_COMPONENTS], spreads=spreads)


if __name__ == "__main__":
    main()
