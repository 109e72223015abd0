"""Real blows: steel balls of 6 and 10 mm on concrete; which one struck, what Hertz says of it, and what models answer.

    python benchmarks/identification/steel_balls.py [--balls FOLDER]

The recordings are those of ../shared/realdata/steel_balls (for their source see the README there): the displacement of
the surface beside the blow at 625 kHz, whose first downward lobe is the contact. The balls were welded to a rod and
struck by hand, one session a ball. Without the recordings there is nothing to show.

The lobe is what lies between its zero crossings, sign turned; `estimate` fits the pulse to it. Prints the figures as
Markdown.
"""

import argparse
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cgid._lib.validation import Floats
from cgid.identification.detection import find_impacts
from cgid.identification.model.confusion import wilson_interval
from cgid.identification.prediction import load_model, predict
from cgid.recordings import read_recording
from cgid.scene import parse_scene
from cgid.signals import Signal
from studies.impactor.estimation import Estimates, estimate
from studies.impactor.measured import MeasuredPulses
from studies.impactor.population import population_of

HERE = Path(__file__).parent
BALLS = HERE.parents[2] / "shared" / "realdata" / "steel_balls"
#: Diameters [mm], and the contact times of the author's table [us].
DIAMETERS, TABLE = (6, 10), {6: 26.0, 10: 43.0}
#: Samples before the trigger that show baseline and noise, and samples kept before the lobe.
QUIET, BEFORE, LENGTH = 450, 200, 400
#: Newtons (or m/s^2) that a volt may stand for, which nobody says.
GAINS = 10.0 ** np.arange(7)
#: Draws of a bootstrap.
RESAMPLED = 2000


@dataclass(frozen=True)
class Ball:
    """The blows of one ball."""

    diameter: int
    signals: list[Signal]
    fit: Estimates

    @property
    def duration(self) -> Floats:
        """Contact times [s]."""
        return self.fit.contact_duration

    @property
    def peak(self) -> Floats:
        """Amplitudes [V]."""
        return self.fit.peak


def first_lobe(signal: Signal) -> Floats:
    """Return the frame of the first downward lobe, upwards; what comes after its end is the noise from before touch."""
    samples = -(signal.samples - signal.samples[:QUIET].mean())
    loud = np.flatnonzero(samples > max(0.2 * samples.max(), 8 * samples[:QUIET].std()))
    start = last = int(loud[0])
    while samples[start - 1] > 0:
        start -= 1
    while samples[last] > 0:
        last += 1
    frame = samples[start - BEFORE : start - BEFORE + LENGTH].copy()
    frame[BEFORE + last - start :] = samples[: LENGTH - BEFORE - last + start]
    return np.asarray(frame, np.float64)


def ball(folder: Path, diameter: int) -> Ball:
    signals = [read_recording(file)[0] for file in sorted((folder / f"{diameter}mm").glob("*.txt"))]
    frames = np.stack([first_lobe(signal) for signal in signals])
    return Ball(diameter, signals, estimate(frames, signals[0].sampling_rate, pre_trigger=BEFORE - 10))


def n_detected(balls: list[Ball]) -> int:
    count = 0
    for signal in (signal for one in balls for signal in one.signals):
        events = find_impacts(replace(signal, unit="N", samples=-signal.samples), kind="pulse")
        samples = -(signal.samples - signal.samples[:QUIET].mean())
        loud = np.flatnonzero(samples > max(0.2 * samples.max(), 8 * samples[:QUIET].std()))[0]
        count += any(abs(event.time * signal.sampling_rate - loud) < 30 for event in events)
    return count


def left_out(balls: list[Ball]) -> int:
    """Return how many balls are told by their contact time, each blow by the others."""
    value = np.concatenate([np.log(one.duration) for one in balls])
    truth = np.concatenate([np.full(one.duration.size, k) for k, one in enumerate(balls)])
    odds = np.empty(value.size)
    for row in range(value.size):
        rest = np.arange(value.size) != row
        parts = [value[rest & (truth == k)] for k in range(2)]
        middle, spread = [np.median(p) for p in parts], np.sqrt(np.mean([p.var(ddof=1) for p in parts]))
        distance = [((value[row] - m) / spread) ** 2 for m in middle]
        odds[row] = 0.5 * (distance[0] - distance[1])
    return int(np.sum((odds > 0) == (truth == 1)))


def slope(one: Ball) -> tuple[float, float]:
    x, y = np.log(one.peak), np.log(one.duration)
    fit, covariance = np.polyfit(x, y, 1, cov=True)
    return float(fit[0]), float(np.sqrt(covariance[0, 0]))


def radii(one: Ball) -> tuple[Floats, Floats, Floats]:
    """Return the radius of a free steel ball on concrete by the contact time alone [mm]: ends of 90 % and median.

    Volts are no newtons, so the peak says nothing. Modulus and speeds are assumed.
    """
    scene = parse_scene(
        {
            "name": "steel balls",
            "impact": {
                "stiffness": "hertz",
                "dissipation": "hunt-crossley",
                "target": {"density": 2400.0, "youngs_modulus": 30e9, "poisson_ratio": 0.2},
            },
            "sampling": {"sampling_rate": 625e3, "samples": 400, "pre_trigger": 200},
            "populations": [
                {
                    "label": "ball",
                    "density": 7850.0,
                    "youngs_modulus": 210e9,
                    "poisson_ratio": 0.3,
                    "radius": {"distribution": "log-uniform", "lowest": "1 mm", "highest": "20 mm"},
                    "restitution": {"distribution": "uniform", "lowest": 0.3, "highest": 0.95},
                    "drop_height": {"distribution": "log-uniform", "lowest": "5 mm", "highest": "500 mm"},
                }
            ],
        }
    )
    seen = MeasuredPulses.of_estimates(one.fit)
    unknown = np.zeros((3, 3))
    # What lies between blow and sensor turns the shape: it rises more slowly than it falls, which no ball does.
    unknown[0, 0], unknown[2, 2] = 2.9**2, 1.0
    population = population_of(scene)
    middle = np.full(len(seen), np.median(population.log_peak))
    blind = replace(seen, log_peak=middle, covariance=seen.covariance + unknown, usable=np.ones(len(seen), bool))
    found = population.posterior(blind)
    low, high = found.interval("radius", 0.9)
    return 1e3 * low, 1e3 * found.median("radius"), 1e3 * high


def extended(signal: Signal) -> Signal:
    quiet = signal.samples[: QUIET - 10] - signal.samples[: QUIET - 10].mean()
    both = np.concatenate([quiet, quiet[::-1]])
    level = signal.samples[: QUIET - 10].mean()
    return replace(signal, samples=np.concatenate([np.tile(both, 6), signal.samples - level, np.tile(both, 30)]))


def answers(balls: list[Ball]) -> None:
    """Print how many blows each default model calls unknown, as recorded and extended, for all gains."""
    print("| model | recordings | a volt is | unknown, fewest | median |\n|---|---|---|---|---|")
    for name, unit in (("default", "N"), ("default-acceleration", "m/s^2")):
        model = load_model(name)
        for how in ("as recorded", "extended"):
            unknown = []
            for gain in GAINS:
                labels: list[str] = []
                for signal in (signal for one in balls for signal in one.signals):
                    own = extended(signal) if how == "extended" else signal
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore")
                        table = predict(replace(own, unit=unit, samples=-gain * own.samples), model=model)
                    # The blow is the first; echoes of the block follow it.
                    labels += table["label"].tolist()[:1]
                unknown.append(labels.count("unknown"))
            low, high = GAINS[0], GAINS[-1]
            print(
                f"| {name} | {how} | {low:g} to {high:g} {unit}, {len(GAINS)} gains | {min(unknown)} "
                f"| {np.median(unknown):g} |",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--balls", type=Path, default=BALLS)
    asked = parser.parse_args()
    if not (asked.balls / "6mm").is_dir():
        print(f"{asked.balls}: no recordings of steel balls here; give --balls FOLDER. Nothing to show.")
        return
    balls = [ball(asked.balls, diameter) for diameter in DIAMETERS]
    n = sum(one.duration.size for one in balls)
    print(f"The detector finds {n_detected(balls)} of {n} blows.\n")
    print("| ball | blows | contact time [us] | quartiles | the author's table | restitution | misfit |")
    print("|---|---|---|---|---|---|---|")
    for one in balls:
        time = 1e6 * one.duration
        low, high = np.quantile(time, [0.25, 0.75])
        print(
            f"| {one.diameter} mm | {time.size} | {np.median(time):.1f} | {low:.1f} to {high:.1f} "
            f"| {TABLE[one.diameter]:g} | {np.median(one.fit.restitution):.2f} | {np.median(one.fit.misfit):.2f} |"
        )
    right = left_out(balls)
    low, high = wilson_interval(right / n, n)
    print(f"\nWhich ball, each blow told by the others: {right} of {n} (95 % interval {low:.3f} to {high:.3f}).")
    rng = np.random.default_rng(0)
    ratios = [
        float(np.divide(*(np.median(rng.choice(one.duration, one.duration.size)) for one in balls[::-1])))
        for _ in range(RESAMPLED)
    ]
    ratio = np.median(balls[1].duration) / np.median(balls[0].duration)
    ends = np.quantile(ratios, [0.025, 0.975])
    print(f"Ratio of median contact times: {ratio:.2f} ({ends[0]:.2f} to {ends[1]:.2f}); diameters 10/6 = 1.67.")
    for one in balls:
        power, error = slope(one)
        print(f"Contact time, {one.diameter} mm ball: amplitude to the power {power:.3f} +- {error:.3f}; Hertz: -1/6.")
    for one in balls:
        low_end, middle, high_end = radii(one)
        held = np.mean((2 * low_end <= one.diameter) & (one.diameter <= 2 * high_end))
        print(
            f"Diameter by the contact time alone, {one.diameter} mm ball: median {2 * np.median(middle):.1f} mm, 90 % "
            f"intervals of {np.median(high_end / low_end):.1f} in ratio hold it in {held:.2f}."
        )
    print()
    answers(balls)


if __name__ == "__main__":
    main()
