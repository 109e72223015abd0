"""Scenes with a beam against real recordings of things that hit metal: spectra and decay of the ringing.

    python benchmarks/real_beside_synthetic.py [--real FOLDER] [--signals 256] [-o FILE.png]

The real recordings are those of ../shared/realdata (for sources see its README): small bodies sliding down an aluminium
ramp (`bulk_ramp`, hundreds of overlapping blows each) and a board shocked in a drop tower (`shock/acc_pcb_*`). Without
them there is nothing to show. None of them is coal or gangue, and none a tail beam.

Spectrum: power in third-octave bands over the whole (Welch). Decay: the envelope after a blow (Hilbert, its square
averaged over `SMOOTHING`) over its highest value, the median over blows. In a recording of many blows, a blow is a peak
that is the highest from `BEFORE` before to `ALONE` after it; only the tenth with the least sound afterwards is used,
and that sound still makes the decay look slower than it is. Crest factors are the median over pieces of `PIECE`. Prints
the figures as Markdown and writes the picture.
"""

import argparse
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage, signal

from cgid import plots, shipped
from cgid.recordings import read_recording
from cgid.scene import load_scene, synthesise
from cgid.validation import Floats

HERE = Path(__file__).parent
REAL = HERE.parents[1] / "shared" / "realdata"
#: File name without its number -> label in the picture.
BULK = {
    "steel_nut_M3": "steel nuts M3",
    "steel_nut_M4": "steel nuts M4",
    "messing_nut_M4": "brass nuts M4",
    "screws": "screws",
    "plastic_spheres": "plastic spheres",
}
SCENES = {"tail_beam": "k", "plate": "C9"}  # and their colours
#: Compared frequencies [Hz] and number of bands; the lowest band is twice as wide as the resolution.
BAND, N_BANDS = (100.0, 20e3), 23
#: Smoothing of the envelope, shown time before and after a blow, and time without a louder peak after it [s].
SMOOTHING, BEFORE, BEHIND, ALONE = 1e-3, 5e-3, 60e-3, 30e-3
#: Length of the pieces for crest factors [s]: a frame of the scenes.
PIECE = 80e-3


@dataclass(frozen=True)
class Kind:
    """Signals of one kind."""

    name: str
    signals: list[Floats]
    sampling_rate: float
    many_blows: bool = False


def recorded(folder: Path) -> Iterator[Kind]:
    """Yield the real kinds."""
    for stem, name in BULK.items():
        files = sorted((folder / "bulk_ramp").glob(f"{stem}_*.wav"))
        heard = [read_recording(file, channel=1)[0] for file in files]
        yield Kind(name, [one.samples for one in heard], heard[0].sampling_rate, many_blows=True)
    heard = [read_recording(file)[0] for file in sorted((folder / "shock").glob("acc_pcb_*.txt"))]
    yield Kind("board in a drop tower", [one.samples for one in heard], heard[0].sampling_rate)


def synthetic(n: int) -> Iterator[Kind]:
    """Yield each scene's coal and gangue."""
    for name in SCENES:
        batches = list(synthesise(load_scene(shipped.scene_path(name)), n))
        frames = np.concatenate([batch.signals for batch in batches]).astype(np.float64)
        labels = np.concatenate([batch.labels for batch in batches])
        for label in np.unique(labels).tolist():
            yield Kind(f"{name}, {label}", list(frames[labels == label]), batches[0].sampling_rate)


def spectrum(kind: Kind) -> tuple[Floats, Floats]:
    """Return frequencies [Hz] and power density of the whole signals within `BAND`, averaged over the signals."""
    length = 2 ** round(np.log2(9 * kind.sampling_rate / BAND[0]))
    total = np.zeros(length // 2 + 1)
    for samples in kind.signals:
        padded = np.pad(samples - np.median(samples), (0, max(length - samples.size, 0)))
        window = "hann" if kind.many_blows else "boxcar"  # a single blow begins and ends in its frame
        frequencies, power = signal.welch(padded, kind.sampling_rate, window, length, detrend=False)
        inside = (frequencies >= BAND[0]) & (frequencies <= BAND[1])
        total += power / power[inside].sum()
    return frequencies[inside], total[inside] / total[inside].sum()


def bands(frequencies: Floats, power: Floats) -> tuple[Floats, Floats]:
    """Return the centres of third-octave bands [Hz] and their power [dB], nan above the recorder's range."""
    edges = np.geomspace(*BAND, N_BANDS + 1)
    inside = np.histogram(frequencies, edges, weights=power)[0]
    return np.sqrt(edges[1:] * edges[:-1]), 10 * np.log10(np.where(inside > 0, inside, np.nan))


def decay(kind: Kind) -> tuple[Floats, Floats, int]:
    """Return times from a blow [s], the median level below its highest [dB], and the number of blows."""
    rate = kind.sampling_rate
    before, behind = round(BEFORE * rate), round(BEHIND * rate)
    found = []
    for samples in kind.signals:
        power = np.abs(signal.hilbert(samples - np.median(samples))) ** 2
        power = ndimage.uniform_filter1d(power, round(SMOOTHING * rate))
        for peak in _blows(power, rate) if kind.many_blows else [int(power.argmax())]:
            # A frame may begin later or end sooner than the shown interval.
            part = np.full(before + behind, np.nan)
            start, stop = max(peak - before, 0), min(peak + behind, power.size)
            part[start - peak + before : stop - peak + before] = power[start:stop]
            found.append(10 * np.log10(part / power[peak]))
    levels = np.array(found)
    if kind.many_blows:
        last = levels[:, before : before + round(ALONE * rate)].mean(axis=1)
        levels = levels[last <= np.quantile(last, 0.1)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no data before the first sample
        return np.arange(-before, behind) / rate, np.nanmedian(levels, axis=0), len(levels)


def _blows(power: Floats, rate: float) -> list[int]:
    """Return the positions of the blows in an envelope with many."""
    before, alone = round(BEFORE * rate), round(ALONE * rate)
    peaks = signal.find_peaks(power, distance=before)[0].tolist()
    return [p for p in peaks if before <= p < power.size - alone and power[p - before : p + alone].max() == power[p]]


@dataclass(frozen=True)
class Look:
    """The curves and figures of a kind."""

    kind: Kind
    frequencies: Floats
    levels: Floats
    times: Floats
    envelope: Floats
    figures: tuple[str, ...]


COLUMNS = ("signals", "centroid [kHz]", "10 dB band [kHz]", "to -10 dB [ms]", "to -20 dB [ms]", "crest factor", "blows")


def look(kind: Kind) -> Look:
    """Return curves and figures of a kind."""
    frequencies, power = spectrum(kind)
    middles, levels = bands(frequencies, power)
    times, envelope, n_blows = decay(kind)
    loud = middles[levels > np.nanmax(levels) - 10]
    figures = (
        f"{len(kind.signals)}",
        f"{(frequencies * power).sum() / 1e3:.2f}",
        f"{loud[0] / 1e3:.2f}-{loud[-1] / 1e3:.2f}",
        *(_time_to(level, times, envelope) for level in (-10, -20)),
        f"{np.median([crest for samples in kind.signals for crest in _crests(samples, kind.sampling_rate)]):.1f}",
        f"{n_blows}",
    )
    return Look(kind, middles, levels, times, envelope, figures)


def _time_to(level: float, times: Floats, envelope: Floats) -> str:
    """Return the time from the highest point of an envelope until it first is below a level [ms]."""
    below = np.flatnonzero((times > 0) & (envelope < level))
    return f"{1e3 * times[below[0]]:.1f}" if below.size else "-"


def _crests(samples: Floats, rate: float) -> Floats:
    """Return the crest factor, largest sample / root mean square, of each piece."""
    length = min(round(PIECE * rate), samples.size)
    pieces = samples[: samples.size // length * length].reshape(-1, length)
    pieces = pieces - np.median(pieces, axis=1, keepdims=True)
    return np.asarray(np.abs(pieces).max(axis=1) / np.sqrt((pieces**2).mean(axis=1)))


def picture(rows: dict[str, list[Look]]) -> bytes:
    """Draw spectra on the left and decay on the right, real above synthetic, as PNG."""
    figure = plots.require_matplotlib()(figsize=(11, 6.6), layout="constrained")
    grid = figure.subplots(len(rows), 2, sharex="col", sharey="col")
    for (left, right), (title, looks) in zip(grid, rows.items(), strict=True):
        for number, one in enumerate(looks):
            colour = SCENES.get(one.kind.name.split(",")[0], f"C{number}")
            style = {"color": colour, "lw": 1.8, "ls": "--" if one.kind.name.endswith("gangue") else "-"}
            left.plot(one.frequencies / 1e3, one.levels, label=one.kind.name, **style)
            step = round(SMOOTHING / 2 * one.kind.sampling_rate)  # a finer step would repeat the same numbers
            right.plot(1e3 * one.times[::step], one.envelope[::step], **style)
        left.set(xscale="log", xlim=(BAND[0] / 1e3, BAND[1] / 1e3), ylim=(-50, 0), title=f"{title}: spectrum")
        left.set(ylabel="power in a third-octave\nover the whole [dB]")
        right.set(xlim=(-1e3 * BEFORE, 1e3 * BEHIND), ylim=(-40, 2), title=f"{title}: decay", ylabel="envelope [dB]")
        right.legend(*left.get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(1.02, 1))
        for axes in (left, right):
            axes.grid(alpha=0.3)
    left.set(xlabel="frequency [kHz]", xticks=[0.1, 0.3, 1, 3, 10], xticklabels=["0.1", "0.3", "1", "3", "10"])
    right.set(xlabel="time behind the blow's highest point [ms]")
    return plots.png(figure)


def main() -> None:
    """Read, synthesise, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--real", type=Path, default=REAL, help="the folder of the real recordings")
    parser.add_argument("--signals", type=int, default=256, help="of each scene")
    parser.add_argument("-o", "--output", type=Path, default=HERE / "real_beside_synthetic.png")
    arguments = parser.parse_args()
    if not (arguments.real / "bulk_ramp").is_dir():
        raise SystemExit(f"{arguments.real} must be the folder of the real recordings and is not there; give --real")
    rows = {
        "real": [look(kind) for kind in recorded(arguments.real)],
        "synthetic": [look(kind) for kind in synthetic(arguments.signals)],
    }
    print(f"| | | {' | '.join(COLUMNS)} |\n|---|---|{'---|' * len(COLUMNS)}")
    for title, looks in rows.items():
        for one in looks:
            print(f"| {title} | {one.kind.name} | {' | '.join(one.figures)} |")
    arguments.output.write_bytes(picture(rows))


if __name__ == "__main__":
    main()
