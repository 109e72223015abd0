"""Detection of impacts: precision, recall and onset error on streams with known truth, and time per sample.

    python benchmarks/identification/detection.py [--seconds 30] [--quick]

Streams of the scene `caving` are made without noise; then noise of 30 to 0 dB is added. `tests/impact_truth.py` defines
dB, loud, alone, precision and recall. Further rows have other noises, among them the scene's own background (hum,
rumble and sensor noise), arrivals, sampling rates and beams. Onset errors, onset - touch [samples], are those of
impacts that count: the median and the range of the middle 90 %. They include the delay of the anti-aliasing filter.

Then: events in ten minutes of white noise; processor time per sample and channel without events, and per event.
"""

import argparse
import time

import numpy as np

from cgid.identification.detection import ImpactDetector
from cgid.scene import record
from tests.impact_truth import Stream, caving, score

BLOCK = 65_536


def onsets(samples: np.ndarray, sampling_rate: float) -> np.ndarray:
    detector = ImpactDetector(sampling_rate, kind="vibration")
    events = []
    for start in range(0, samples.size, BLOCK):
        events += detector.feed(samples[start : start + BLOCK])
    return np.array([event.onset for event in events + detector.finish()])


def row(name: str, stream: Stream, noise: np.ndarray, decibels: float) -> None:
    found = score(stream, noise, onsets(stream.samples + noise, stream.sampling_rate))
    low, middle, high = np.quantile(found.errors, [0.05, 0.5, 0.95])
    print(
        f"| {name} | {decibels:g} | {found.n_events} | {found.precision:.3f} | {found.n_counting} | {found.recall:.3f} "
        f"| {found.recall_of_all:.3f} | {middle:.1f} ({low:.1f} to {high:.1f}) |",
        flush=True,
    )


def accuracy(seconds: float, quick: bool) -> None:
    print("| stream | noise [dB] | events | precision | impacts that count | recall | recall, all loud | onset error |")
    print("|---|---|---|---|---|---|---|---|")
    for seed in range(1 if quick else 3):
        stream = Stream.of(caving(seconds), seed)
        for decibels in (30, 20, 10, 0):
            row(f"caving, seed {seed}", stream, stream.noise(decibels), decibels)
    for kind in ("pink", "hum"):
        row(f"the last in {kind}", stream, stream.noise(20, kind), 20)
    own = record(caving(seconds, noise=True), seed, dtype="float64")[0].samples - stream.samples
    row(
        "the last in the scene's own background",
        stream,
        own,
        10 * np.log10(np.mean(stream.samples**2) / np.mean(own**2)),
    )
    row("the same, louder", stream, stream.scaled(own, 20), 20)
    others = {
        "3 rocks a second": {"stream": {"arrivals": {"rate": "3 Hz"}}},
        "20 rocks a second": {"stream": {"arrivals": {"rate": "20 Hz"}}},
        "10 kHz": rate_of(10_000),
        "51.2 kHz": rate_of(51_200),
        "100 kHz": rate_of(100_000),
        "plate of 15 mm, damping 1 %": {"tail_beam": {"thickness": "15 mm", "damping_ratio": "1 %"}},
        "2.2 m, 40 mm, damping 0.5 %": {
            "tail_beam": {"length": "2.2 m", "thickness": "40 mm", "damping_ratio": "0.5 %"}
        },
    }
    for number, (name, changes) in enumerate(others.items()):
        stream = Stream.of(caving(seconds / 2, **changes), 10 + number)
        for decibels in (20,) if quick else (40, 20, 10):
            row(name, stream, stream.noise(decibels), decibels)


def rate_of(sampling_rate: float) -> dict[str, dict]:
    edge = {"frequency": f"{min(10e3, 0.39 * sampling_rate):g} Hz", "order": 8}
    return {"sampling": {"sampling_rate": f"{sampling_rate:g} Hz"}, "sensor": {"anti_alias": edge}}


def silence() -> None:
    print("\n| sampling rate [Hz] | events in 10 min of white noise |\n|---|---|")
    random = np.random.default_rng(1)
    for rate in (10_000.0, 25_600.0, 51_200.0):
        detector = ImpactDetector(rate, 4, kind="vibration")
        count = sum(len(detector.feed(random.normal(size=(4, int(rate))))) for _ in range(150))
        print(f"| {rate:g} | {count + len(detector.finish())} |", flush=True)


def speed() -> None:
    print("\n| kind | sampling rate [Hz] | channels | ns a sample and channel |\n|---|---|---|---|")
    random = np.random.default_rng(2)
    for kind, rate, n_channels in (
        ("vibration", 25_600.0, 1),
        ("vibration", 25_600.0, 4),
        ("vibration", 51_200.0, 4),
        ("vibration", 100_000.0, 4),
        ("pulse", 100_000.0, 4),
    ):
        samples = random.normal(size=(n_channels, int(8e6 / n_channels / 4))).astype(np.float32)
        print(
            f"| {kind} | {rate:g} | {n_channels} | {best_time(kind, rate, samples) / samples.size * 1e9:.1f} |",
            flush=True,
        )
    stream = Stream.of(caving(10))
    samples = (stream.samples + stream.noise(20)).astype(np.float32)[None]
    quiet = best_time("vibration", 25_600.0, random.normal(size=samples.shape).astype(np.float32))
    count = onsets(samples[0], 25_600.0).size
    print(f"\n{(best_time('vibration', 25_600.0, samples) - quiet) / count * 1e6:.0f} us more for each event")


def best_time(kind: str, sampling_rate: float, samples: np.ndarray) -> float:
    """Return the best processor time of five runs [s]."""
    times = []
    for _ in range(5):
        detector, start = ImpactDetector(sampling_rate, len(samples), kind=kind), time.process_time()
        for first in range(0, samples.shape[1], BLOCK):
            detector.feed(samples[:, first : first + BLOCK])
        detector.finish()
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="length of a stream")
    parser.add_argument("--quick", action="store_true", help="one seed, fewer levels")
    arguments = parser.parse_args()
    accuracy(arguments.seconds, arguments.quick)
    silence()
    speed()


if __name__ == "__main__":
    main()
