"""Detection of impacts: precision, recall and onset error on streams with known truth, and time per sample.

    python benchmarks/detection.py [--seconds 30] [--quick]
    python benchmarks/detection.py --peers [--seconds 60] [--ramp FOLDER]

Streams of the scene `caving` are made without noise; then noise of 30 to 0 dB is added. `tests/impact_truth.py` defines
dB, loud, alone, precision and recall. Further rows have other noises, among them the scene's own background (hum,
rumble and sensor noise), arrivals, sampling rates and beams. Onset errors, onset - touch [samples], are those of
impacts that count: the median and the range of the middle 90 %. They include the delay of the anti-aliasing filter.

Then: 600 force pulses of the scene `reference`, with peaks over more than two decades, in one recording with white
noise of 2 % of the lowest peak: how many are found, and the number of false events.

Then: events in ten minutes of white noise; processor time per sample and channel without events, and per event.

`--peers` puts it beside what seismologists use: the classic and the recursive ratio of a short and a long average of
the energy (STA/LTA, Withers et al. 1998), with onsets by Akaike's criterion (Maeda 1985) in the 5 ms about the trigger.
They are those of obspy where it is installed, else written out here from their definitions; both agree to rounding.
Averages, thresholds and a high pass before them are chosen for the best F1, of precision and of recall of all loud
impacts, on a stream of its own at 20 dB. `--ramp` names a folder of WAV files of two channels without truth, such as
those of github.com/spatialaudio/classification_exercise: how often the two channels agree, and what noise changes.
"""

import argparse
import itertools
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.signal import butter, lfilter, sosfilt

from cgid.identification.detection import ImpactDetector
from cgid.recordings import read_recording
from cgid.scene import parse_scene, record, synthesise
from cgid.shipped import scene_path
from tests.impact_truth import Stream, caving, score

BLOCK = 65_536


def onsets(samples: np.ndarray, sampling_rate: float) -> np.ndarray:
    """Return the detected onsets in a recording of one channel."""
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
    """Return the change to another sampling rate, with its anti-aliasing filter."""
    edge = {"frequency": f"{min(10e3, 0.39 * sampling_rate):g} Hz", "order": 8}
    return {"sampling": {"sampling_rate": f"{sampling_rate:g} Hz"}, "sensor": {"anti_alias": edge}}


def pulses() -> None:
    content = tomllib.loads(scene_path("reference").read_text())
    del content["sensor"]["relative_noise"]
    frames = np.concatenate([batch.signals for batch in synthesise(parse_scene(content), 600, seed=1)])
    rate, touch = 200e3, content["sampling"]["pre_trigger"]
    print("\n| from blow to blow [ms] | found, of 600 | others |\n|---|---|---|")
    for step in (2048, 6000, 20_000):
        samples = 0.02 * frames.max(axis=1).min() * np.random.default_rng(0).normal(size=600 * step)
        for number, frame in enumerate(frames):
            samples[number * step : number * step + frame.size] += frame
        detector = ImpactDetector(rate, kind="pulse")
        onsets = np.array([event.onset for event in detector.feed(samples) + detector.finish()])
        hits = np.unique(onsets[np.abs(onsets % step - touch) < 200] // step).size
        print(f"| {step / rate * 1e3:g} | {hits} | {onsets.size - hits} |", flush=True)


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


# -- beside others ----------------------------------------------------------------------------------------

Finder = Callable[[np.ndarray, float], np.ndarray]


def classic(samples: np.ndarray, n_short: int, n_long: int) -> np.ndarray:
    """Return the ratio of the mean energies of the last `n_short` and the last `n_long` samples, 0 at first."""
    sums = np.append(0.0, np.cumsum(samples**2))
    ends = np.arange(n_long, samples.size + 1)
    ratio = np.zeros(samples.size)
    long = np.maximum((sums[ends] - sums[ends - n_long]) / n_long, np.finfo(float).tiny)
    ratio[n_long - 1 :] = (sums[ends] - sums[ends - n_short]) / n_short / long
    return ratio


def recursive(samples: np.ndarray, n_short: int, n_long: int) -> np.ndarray:
    """Return the ratio of two averages of the energy that forget exponentially, 0 at first."""
    energy = np.append(0.0, samples[1:] ** 2)
    short, long = (lfilter([1 / n], [1, 1 / n - 1], energy) for n in (n_short, n_long))
    ratio = short / np.maximum(long, np.finfo(float).tiny)
    ratio[:n_long] = 0
    return ratio


def rises(ratio: np.ndarray, on: float, off: float) -> np.ndarray:
    """Return where the ratio exceeds `on`, once until it has fallen below `off`."""
    state = np.where(ratio > on, 1, np.where(ratio < off, -1, 0))
    known = np.flatnonzero(state)
    values = state[known]
    first = np.append(True, values[1:] != values[:-1]) & (values > 0)
    return known[first]


def akaike(samples: np.ndarray) -> int:
    """Return where one variance changes to another (Maeda 1985)."""
    n = samples.size
    count = np.arange(2, n - 2)
    sums, squares = (np.cumsum(part) for part in (samples, samples**2))
    early = squares[count - 1] / count - (sums[count - 1] / count) ** 2
    late = (squares[-1] - squares[count - 1]) / (n - count) - ((sums[-1] - sums[count - 1]) / (n - count)) ** 2
    tiny = max(float(squares[-1]), 1e-300) * 1e-12
    criterion = count * np.log(np.maximum(early, tiny)) + (n - count - 1) * np.log(np.maximum(late, tiny))
    return int(count[np.argmin(criterion)])


def averages(name: str) -> Callable[[np.ndarray, int, int], np.ndarray]:
    """Return the ratio of a name: that of obspy if there is one."""
    own = {"classic": classic, "recursive": recursive}[name]
    try:
        from obspy.signal import trigger
    except ImportError:
        return own
    theirs = getattr(trigger, f"{name}_sta_lta")
    noise = np.random.default_rng(0).normal(size=4000)
    np.testing.assert_allclose(theirs(noise, 50, 500)[501:], own(noise, 50, 500)[501:], rtol=1e-9)
    return theirs


def seismic(name: str, short: float, long: float, on: float, highest: float) -> Finder:
    """Return a finder with averages over times [s], a threshold, and a high pass before them [Hz] (0: none)."""
    ratio_of = averages(name)

    def find(samples: np.ndarray, rate: float) -> np.ndarray:
        heard = samples
        if highest:
            heard = sosfilt(butter(4, highest, "highpass", fs=rate, output="sos"), samples)
        ratio = ratio_of(np.ascontiguousarray(heard), max(round(short * rate), 2), round(long * rate))
        reach, found = round(2.5e-3 * rate), []
        for place in rises(ratio, on, max(0.5 * on, 1.0)).tolist():
            first = max(place - reach, 0)
            found.append(first + akaike(heard[first : place + reach]))
        found = np.unique(found).astype(int)
        apart = np.append(True, np.diff(found) > 2e-3 * rate) if found.size else np.ones(0, bool)
        return found[apart]

    return find


def tuned(name: str, stream: Stream) -> tuple[str, Finder]:
    """Return the finder with the best F1 on a stream at 20 dB, and its settings."""
    noise = stream.noise(20, seed=1)
    best = (-1.0, "", seismic(name, 1e-3, 0.05, 3.0, 0.0))
    for short, long, on, highest in itertools.product(
        (5e-4, 1e-3, 2e-3), (0.01, 0.02, 0.05), (1.5, 2.0, 3.0, 4.0), (0.0, 1000.0, 3000.0, 5000.0)
    ):
        finder = seismic(name, short, long, on, highest)
        found = score(stream, noise, finder(stream.samples + noise, stream.sampling_rate))
        value = 2 * found.precision * found.recall_of_all / max(found.precision + found.recall_of_all, 1e-9)
        if value > best[0]:
            text = f"{1e3 * short:g} ms over {1e3 * long:g} ms, above {on:g}"
            best = (value, text + (f", high pass {highest:g} Hz" if highest else ""), finder)
    return best[1], best[2]


def peers(seconds: float, ramp: str | None) -> None:
    tuning = Stream.of(caving(min(seconds, 10.0)), 100)
    finders: dict[str, Finder] = {"cgid": onsets}
    for name in ("classic", "recursive"):
        text, finders[f"{name} STA/LTA and AIC"] = tuned(name, tuning)
        print(f"{name} STA/LTA: {text}", flush=True)
    print("\n| finder | noise | events | precision | recall | recall, all loud | F1 | onset error | ns a sample |")
    print(f"|{'---|' * 9}")
    clean = Stream.of(caving(seconds), 0)
    own = record(caving(seconds, noise=True), 0, dtype="float64")[0].samples - clean.samples
    noises = {f"white, {level} dB": clean.noise(level) for level in (30, 20, 10, 0)}
    noises["the scene's own"] = own
    for (kind, noise), (name, finder) in itertools.product(noises.items(), finders.items()):
        samples = clean.samples + noise
        start = time.process_time()
        events = finder(samples, clean.sampling_rate)
        taken = (time.process_time() - start) / samples.size * 1e9
        found = score(clean, noise, events)
        low, middle, high = np.quantile(found.errors, [0.05, 0.5, 0.95])
        both = 2 * found.precision * found.recall_of_all / (found.precision + found.recall_of_all)
        print(
            f"| {name} | {kind} | {found.n_events} | {found.precision:.3f} | {found.recall:.3f} | "
            f"{found.recall_of_all:.3f} | {both:.3f} | {middle:.1f} ({low:.1f} to {high:.1f}) | {taken:.0f} |",
            flush=True,
        )
    if ramp is not None:
        without_truth(finders, Path(ramp))


def without_truth(finders: dict[str, Finder], folder: Path) -> None:
    """Print what can be said of recordings whose impacts nobody knows."""
    print("\n| finder | events a second | also in the other channel | by chance | left in noise | new in noise |")
    print(f"|{'---|' * 6}")
    recordings = [read_recording(file) for file in sorted(folder.glob("*.wav"))]
    for name, finder in finders.items():
        counts, seconds = np.zeros(6), 0.0
        for number, signals in enumerate(recordings):
            rate = signals[0].sampling_rate
            seconds += signals[0].samples.size / rate
            found = [finder(np.asarray(signal.samples, float), rate) for signal in signals[:2]]
            shifted = (found[1] + round(0.317 * rate)) % signals[0].samples.size
            samples = np.asarray(signals[0].samples, float)
            noise = np.random.default_rng(number).normal(0, 0.1 * np.std(samples), samples.size)
            noisy = finder(samples + noise, rate)
            counts += [
                found[0].size,
                near(found[0], found[1], rate),
                near(found[0], np.sort(shifted), rate),
                near(found[0], noisy, rate),
                noisy.size,
                noisy.size - near(noisy, found[0], rate),
            ]
        shares = counts[1:4] / max(counts[0], 1)
        cells = " | ".join(f"{one:.2f}" for one in [*shares, counts[5] / max(counts[4], 1)])
        print(f"| {name} | {counts[0] / seconds:.1f} | {cells} |", flush=True)


def near(events: np.ndarray, others: np.ndarray, rate: float) -> int:
    """Return how many events have another within 1 ms."""
    if not others.size:
        return 0
    place = np.clip(np.searchsorted(others, events), 1, others.size) - 1
    behind = np.minimum(place + 1, others.size - 1)
    apart = np.minimum(np.abs(events - others[place]), np.abs(events - others[behind]))
    return int((apart <= 1e-3 * rate).sum())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="length of a stream")
    parser.add_argument("--quick", action="store_true", help="one seed, fewer levels")
    parser.add_argument("--peers", action="store_true", help="beside STA/LTA and AIC, instead")
    parser.add_argument("--ramp", help="folder of WAV files of two channels without truth")
    arguments = parser.parse_args()
    if arguments.peers:
        peers(arguments.seconds, arguments.ramp)
    else:
        accuracy(arguments.seconds, arguments.quick)
        pulses()
        silence()
        speed()
