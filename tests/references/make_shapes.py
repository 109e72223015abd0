"""Make cgid/measure/shapes.npz: the bank of damped-Hertz pulses, and how pulses of other laws of loss differ from it.

    python tests/references/make_shapes.py

The pulses of the bank lie in common coordinates, in which they overlap best with the elastic one.

Pulses of Thornton, Walton and Braun, and Kuwabara and Kono of restitution .1 to .97 are fitted by the damped-Hertz
family without noise. What is left, in the coordinates of `cgid.measure.search` and without what a change of the fitted
parameters would explain, has few principal components (Jolliffe 2002, Principal component analysis).
"""

import numpy as np

from cgid.measure.fit import Start, fit_pulses
from cgid.measure.remainder import N_SHAPES, residual_bins
from cgid.measure.search import NODES, SHAPES_PATH, Samples, averaged, bank, tangents_at
from cgid.physics import HalfSpace, Impact, Sphere, Thornton, Viscoelastic, WaltonBraun
from cgid.physics.materials import STEEL, YANG2018_SPHERES

SAMPLES = 400  # of contact, so that sampling does not matter


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
    """Make the bank, fit with it, take what is left, write its principal components."""
    place, width = coordinates()
    of_bank = {"place": place, "width": width, "tangents": tangents_at(NODES, place, width)}
    np.savez(SHAPES_PATH, **of_bank)
    frames = pulses()
    n = len(frames)
    start = Start(np.ones(n), frames.sum(axis=1), frames.argmax(axis=1).astype(float))
    fit = fit_pulses(frames, start, np.full(n, 1e-3))
    samples = Samples(frames, np.zeros(n), np.full(n, np.inf), np.zeros(n, np.intp))
    bins, _, node = residual_bins(samples, fit.peak, fit.width, fit.onset, fit.shape)
    bases = np.linalg.qr(bank().tangents)[0][node]
    left = bins.values - np.einsum("nbk,nck,nc->nb", bases, bases, bins.values)
    _, sizes, components = np.linalg.svd(left, full_matrices=False)
    spreads = sizes[:N_SHAPES] / np.sqrt(n)
    print("root mean square of the components over the peak:", spreads.round(4))
    rest = left - (left @ components[:N_SHAPES].T) @ components[:N_SHAPES]
    print("left without, with them:", *(f"{np.sqrt(np.mean(part**2)):.4f}" for part in (left, rest)))
    signs = np.sign(components[:N_SHAPES, :].sum(axis=1, keepdims=True))
    np.savez(SHAPES_PATH, **of_bank, components=signs * components[:N_SHAPES], spreads=spreads)


if __name__ == "__main__":
    main()
