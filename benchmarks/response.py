"""Force to acceleration: time per mode and sample against scipy's filters, the error of both, signals per second.

    python benchmarks/response.py [--modes 8 32 128] [--signals 256] [--rounds 5]

First table: rocks of the scene `tail_beam` (impact by the impedance of the beam) on this many of its modes below half
the sampling rate, without the sensor chain, 2048 samples at 25.6 kHz. The peers run the same modes as second-order
sections that are exact for a force linear between samples (`cont2discrete`, "foh"), or convolve with the sum of their
impulse responses by FFT. They receive the sampled forces ready-made; the time of cgid includes making its own from the
impacts. At the recorder's rate ("x 1") a short contact has only a few samples; "x L" is the least power of two by which
the peers must be oversampled for a worst error not above cgid's, every L-th sample kept. Errors are over the largest
sample of a signal, against cgid at a tolerance of 1e-10, which the tests verify against matrix exponentials.

All in one process, alternating, best of several rounds; time divided by signals, modes and samples of the frame. cgid
skips ringing before touch, below the tolerance or decayed; the share that it ran is printed (the few samples of contact
come on top), and the time divided by it. Oversampled peers are so slow that they get a few signals, one thread and one
round; cgid's error is still that of all signals.

Then: signals per second of the whole scene, and the error of its response after the sensor chain.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal
from threadpoolctl import threadpool_limits

from cgid import shipped
from cgid.counting import counted
from cgid.physics import HertzRangeWarning, HuntCrossley, Impact, ModalImpact, Sphere, ThinPlateWarning
from cgid.physics.driving import Windows
from cgid.physics.materials import Material
from cgid.physics.response import Response
from cgid.scene import Scene, load_scene, synthesise
from cgid.scene.draws import BLOCK
from cgid.scene.impacts import blows_of, recorder_of
from cgid.scene.plan import RESPONSE_TOLERANCE as TOLERANCE
from cgid.scene.plan import plan
from cgid.validation import Floats

TRUTH = 1e-10
#: Number of signals for oversampled peers.
FEW = 8
#: Samples that a peer receives at once; they fit into the cache.
AT_ONCE = 1 << 16

Frames = NDArray[Any]


@dataclass(frozen=True)
class Blows:
    """Impacts, and the modes of a beam that they drive.

    onset : (n,) [s]
    participation : (n, n_modes) [1/kg]
    frequency, damping_ratio : (n_modes,)
    """

    impact: Impact
    onset: Floats
    participation: Floats
    frequency: Floats
    damping_ratio: Floats
    sampling_rate: float
    n_samples: int

    def heard(self, tolerance: float, dtype: str = "float64", threads: int = 1) -> Frames:
        """Return cgid's accelerations, (n, n_samples)."""
        frames = np.zeros((len(self.onset), self.n_samples), dtype)
        self.response(tolerance).add_to_frames(frames, self.impact, self.onset, self.participation, threads=threads)
        return frames

    def response(self, tolerance: float) -> Response:
        """Return cgid's response, cached, as a scene keeps it from block to block."""
        return self._responses.setdefault(
            tolerance, Response(sampling_rate=self.sampling_rate, modes=self, tolerance=tolerance)
        )

    @cached_property
    def _responses(self) -> dict[float, Response]:
        return {}

    def forces(self, oversampling: int, dtype: str) -> Frames:
        """Return the forces, (n, n_samples * oversampling)."""
        frames = np.zeros((len(self.onset), self.n_samples * oversampling), dtype)
        self.impact.add_to_frames(frames, self.sampling_rate * oversampling, self.onset)
        return frames

    def sections(self, oversampling: int) -> list[tuple[Floats, Floats]]:
        """Return numerator and denominator of each mode, for a participation of 1 and a piecewise linear force."""
        found = []
        for w, zeta in zip(2 * np.pi * self.frequency, self.damping_ratio, strict=True):
            mode = ([1.0, 0.0, 0.0], [1.0, 2 * zeta * w, w**2])
            numerator, denominator, _ = signal.cont2discrete(mode, 1 / (self.sampling_rate * oversampling), "foh")
            found.append((numerator.ravel(), denominator))
        return found


def blows(scene: Scene, n: int, n_modes: int) -> Blows:
    """Return n impacts of a scene on this many modes of its beam, evenly chosen below half the sampling rate."""
    asked = plan(scene)
    drawn, heard = blows_of(asked, 0, 0), recorder_of(asked)
    below = int(np.searchsorted(heard.modes.frequency, scene.sampling.sampling_rate / 2))
    if not 1 <= n_modes <= below:
        raise SystemExit(f"--modes must be at least 1 and at most {below}, got {n_modes}")
    chosen = np.linspace(0, below - 1, n_modes).round().astype(int)
    return Blows(
        first_of(drawn.impact, n),
        drawn.parameters["onset"][:n],
        heard.participation(drawn.parameters)[:n, chosen],
        heard.modes.frequency[chosen],
        heard.modes.damping_ratio[chosen],
        scene.sampling.sampling_rate,
        scene.sampling.samples,
    )


def first_of(impact: Impact, n: int) -> Impact:
    """Return the first n impacts."""
    sphere, dissipation = impact.sphere, impact.dissipation
    names = ("density", "youngs_modulus", "poisson_ratio")
    material = Material(**{name: getattr(sphere.material, name)[:n] for name in names})
    return replace(
        impact,
        sphere=Sphere(material=material, radius=sphere.radius[:n]),
        velocity=impact.velocity[:n],
        dissipation=HuntCrossley(restitution=dissipation.restitution[:n], law=dissipation.law),
    )


class Peer:
    """A peer prepared for some blows: work that does not depend on the forces is done before timing."""

    def __init__(self, name: str, given: Blows, oversampling: int, dtype: str) -> None:
        self.oversampling, self.n_samples = oversampling, given.n_samples
        self.force = given.forces(oversampling, dtype)
        self.participation = given.participation.astype(dtype)
        self.sections = [(b.astype(dtype), a.astype(dtype)) for b, a in given.sections(oversampling)]
        self.run = {"lfilter": self._lfilter, "sosfilt": self._sosfilt, "FFT convolution": self._convolve}[name]
        if name == "FFT convolution":
            unit = np.zeros(self.force.shape[1])
            unit[0] = 1.0
            responses = [signal.lfilter(b, a, unit) for b, a in given.sections(oversampling)]
            self.impulse_responses = np.array(responses).astype(dtype)

    def heard(self, threads: int = 1) -> Frames:
        """Return the accelerations at the recorder's samples, (n, n_samples)."""
        rows = max(1, AT_ONCE // self.force.shape[1])
        parts = [slice(start, start + rows) for start in range(0, len(self.force), rows)]
        if threads == 1:
            return np.concatenate([self.run(part)[:, :: self.oversampling] for part in parts])
        with ThreadPoolExecutor(threads) as pool:
            return np.concatenate(list(pool.map(lambda part: self.run(part)[:, :: self.oversampling], parts)))

    def _lfilter(self, part: slice) -> Frames:
        return self._sum(part, lambda b, a, force: signal.lfilter(b, a, force))

    def _sosfilt(self, part: slice) -> Frames:
        return self._sum(part, lambda b, a, force: signal.sosfilt(np.concatenate([b, a])[None], force))

    def _sum(self, part: slice, passed: Callable[[Floats, Floats, Frames], Frames]) -> Frames:
        force, total = self.force[part], np.zeros_like(self.force[part])
        for share, (b, a) in zip(self.participation[part].T, self.sections, strict=True):
            heard = passed(b, a, force)
            heard *= share[:, None]
            total += heard
        return total

    def _convolve(self, part: slice) -> Frames:
        length = 2 * self.force.shape[1]
        impulse_response = self.participation[part] @ self.impulse_responses
        spectrum = fft.rfft(self.force[part], length) * fft.rfft(impulse_response, length)
        return fft.irfft(spectrum, length)[:, : length // 2]


PEERS = ("lfilter", "sosfilt", "FFT convolution")


def errors(frames: Frames, exact: Floats) -> Floats:
    """Return the error of each signal over its largest sample, (n,)."""
    return np.asarray(np.abs(frames - exact).max(axis=1) / np.abs(exact).max(axis=1))


def best_times(works: list[Callable[[], object]], rounds: int) -> list[float]:
    """Return the best time of each [s]; they alternate."""
    times = [float("inf")] * len(works)
    for _ in range(rounds + 1):  # the first round compiles and fills the caches
        for number, work in enumerate(works):
            start = time.perf_counter()
            work()
            times[number] = min(times[number], time.perf_counter() - start)
    return times


def oversampling_for(few: Blows, exact: Floats, error: float) -> int:
    """Return the least power of two at which the peers' error, equal for both, is not above this one."""
    factor = 2
    while errors(Peer("FFT convolution", few, factor, "float64").heard(), exact).max() > error:
        factor *= 2
    return factor


def line(n_modes: int, dtype: str, name: str, times: list[float], own: list[float], error: Floats) -> None:
    """Print a line: times per mode and sample [s] of one thread and, if given, of two."""
    cells = [f"{1e9 * spent:.2f} | {spent / ours:.1f}" for spent, ours in zip(times, own, strict=False)]
    cells += ["- | -"] * (2 - len(cells))
    print(
        f"| {n_modes} | {dtype} | {name} | {' | '.join(cells)} | {error.max():.1e} | {np.median(error):.1e} |",
        flush=True,
    )


def beside_peers(given: Blows, dtype: str, rounds: int) -> tuple[list[float], float, str]:
    """Print cgid and the peers at the recorder's rate; return cgid's times, error, and a note on its work."""
    n, n_modes = given.participation.shape
    nominal = n * n_modes * given.n_samples
    exact, response = given.heard(TRUTH), given.response(TOLERANCE)
    with counted() as counts:
        error = errors(given.heard(TOLERANCE, dtype), exact)
    peers = [Peer(name, given, 1, dtype) for name in PEERS]
    works = [partial(given.heard, TOLERANCE, dtype, threads) for threads in (1, 2)]
    works += [partial(peer.heard, threads) for peer in peers for threads in (1, 2)]
    works.append(partial(Windows, given.impact, given.onset, given.sampling_rate, response.tolerance))
    *times, forces = [seconds / nominal for seconds in best_times(works, rounds)]
    line(n_modes, dtype, "cgid", times[:2], times[:2], error)
    line(n_modes, dtype, "cgid, less its forces", [times[0] - forces], times[:2], error)
    for number, (name, peer) in enumerate(zip(PEERS, peers, strict=True), start=1):
        line(n_modes, dtype, f"{name} x 1", times[2 * number :], times[:2], errors(peer.heard(), exact))
    share = counts["mode_samples"] / nominal
    return (
        times[:2],
        error.max(),
        f"{n_modes} modes, {dtype}: cgid ran {counts['modes']} modes and {share:.0%} of the mode samples, "
        f"{1e9 * times[0] / share:.2f} ns for each of these, "
        f"{1e9 * (times[0] - forces) / share:.2f} without its forces.",
    )


def oversampled(few: Blows, own: list[float], error: float) -> None:
    """Print the peers at the rate at which they are as exact as cgid with this time and error."""
    n, n_modes = few.participation.shape
    exact = few.heard(TRUTH)
    factor = oversampling_for(few, exact, error)
    for name in PEERS:
        peer = Peer(name, few, factor, "float64")
        start = time.perf_counter()
        heard = peer.heard()
        spent = (time.perf_counter() - start) / (n * n_modes * few.n_samples)
        line(n_modes, "float64", f"{name} x {factor}", [spent], own, errors(heard, exact))


def scene_rate(scene: Scene, n: int, rounds: int) -> list[float]:
    """Return the signals per second of one thread, and of two that make half of them each."""
    blocks = max(n // (2 * BLOCK), 1)

    def make(first: int, count: int) -> None:
        for _ in synthesise(scene, count * BLOCK, first=first * BLOCK):
            pass

    def by_two() -> None:
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(make, (0, blocks), (blocks, blocks)))

    return [2 * blocks * BLOCK / seconds for seconds in best_times([partial(make, 0, 2 * blocks), by_two], rounds)]


def whole_scene(scene: Scene, n: int, rounds: int) -> None:
    """Print the speed of the whole scene: draw, impact, response, noise, range, bits."""
    print("\n| whole scene `tail_beam` | signals/s, one thread | two threads |\n|---|---|---|")
    for coupling in ("impedance", "auto"):
        one, two = scene_rate(with_coupling(scene, coupling), n, rounds)
        print(f"| coupling {coupling} | {one:.0f} | {two:.0f} |", flush=True)


def with_coupling(scene: Scene, coupling: str) -> Scene:
    """Return the scene with another coupling of rock and beam."""
    return scene.model_copy(update={"tail_beam": scene.tail_beam.model_copy(update={"coupling": coupling})})


def accuracy(scene: Scene) -> None:
    """Print the error after the sensor chain at the scene's tolerance."""
    asked = plan(scene)
    drawn, heard = blows_of(asked, 1, 0), recorder_of(asked)
    close, exact = np.zeros((2, BLOCK, scene.sampling.samples))
    true = replace(heard.response, tolerance=TRUTH)
    for strike in drawn.strikes:
        strike.add_response(close, heard, drawn.parameters)
        pulses = strike.pulses
        if isinstance(pulses, ModalImpact):
            pulses = replace(pulses, tolerance=TRUTH / 10)
        replace(strike, pulses=pulses).add_response(exact, replace(heard, response=true), drawn.parameters)
    modal = sum(strike.rows.size for strike in drawn.strikes if isinstance(strike.pulses, ModalImpact))
    error = errors(close, exact)
    print(
        f"\n{BLOCK} random impacts of `{scene.name}` ({modal} of them coupled through the modes), "
        f"{heard.response.n_modes} modes, behind mounting and anti-alias filter, at the scene's tolerance "
        f"{TOLERANCE:g} against {TRUTH:g}: error over the largest sample at most {error.max():.1e}, "
        f"median {np.median(error):.1e}."
    )


def main() -> None:
    """Time, compare, print Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--modes", type=int, nargs="+", default=[8, 32, 128])
    parser.add_argument("--signals", type=int, default=BLOCK, help=f"beside the peers, at most {BLOCK}")
    parser.add_argument("--scene-signals", type=int, default=8 * BLOCK, help="of the whole scene")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    for beyond in (HertzRangeWarning, ThinPlateWarning):
        warnings.simplefilter("ignore", beyond)
    shipped_scene = load_scene(shipped.scene_path("tail_beam"))
    scene = with_coupling(shipped_scene, "impedance")
    n = min(arguments.signals, BLOCK)
    with threadpool_limits(1):
        print(f"{n} signals of {scene.sampling.samples} samples; the oversampled peers have {min(n, FEW)} of them.\n")
        print("| modes | samples | | ns, one thread | over ours | ns, two threads | over ours | worst error | median |")
        print("|---|---|---|---|---|---|---|---|---|")
        notes = []
        for n_modes in arguments.modes:
            given = blows(scene, n, n_modes)
            for dtype in ("float32", "float64"):
                own, error, note = beside_peers(given, dtype, arguments.rounds)
                notes.append(note)
            oversampled(blows(scene, min(n, FEW), n_modes), own, error)
        print("\n" + "\n".join(f"- {note}" for note in notes))
        whole_scene(scene, arguments.scene_signals, max(arguments.rounds // 2, 1))
        accuracy(shipped_scene)


if __name__ == "__main__":
    main()
