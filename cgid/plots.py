"""Every picture; matplotlib (extra `plot`) is loaded only here and only when asked."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import MissingExtra
from cgid.signals import Signal
from cgid.validation import Floats


def require_matplotlib() -> Any:
    """Return matplotlib's Figure class, drawing without a screen.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("pictures need matplotlib, which is not installed: pip install 'cgid[plot]'") from None
    return Figure


def judgement_pictures(
    labels: NDArray[np.str_], probabilities: Floats, classes: tuple[str, ...], metrics: dict[str, Any]
) -> dict[str, bytes]:
    """Return PNG pictures of how a model did: "confusion", "reliability" and "roc".

    Parameters
    ----------
    labels : ndarray of str, (n_impacts,)
        The truth.
    probabilities : ndarray, (n_impacts, n_classes)
    classes : tuple of str
    metrics : dict
        From `cgid.identification.metrics.evaluate`.
    """
    return {
        "confusion": _confusion(np.array(metrics["confusion"]), classes),
        "reliability": _reliability(metrics["reliability"]),
        "roc": _roc(labels, probabilities, classes),
    }


def _confusion(counts: NDArray[np.int_], classes: tuple[str, ...]) -> bytes:
    figure = require_matplotlib()(figsize=(4.2, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.imshow(counts / counts.sum(axis=1, keepdims=True), cmap="Blues", vmin=0, vmax=1)
    for (row, column), count in np.ndenumerate(counts):
        share = count / counts[row].sum()
        axes.text(column, row, f"{count}\n{share:.1%}", ha="center", va="center", color="w" if share > 0.5 else "k")
    axes.set(xticks=range(len(classes)), xticklabels=classes, xlabel="answer")
    axes.set(yticks=range(len(classes)), yticklabels=classes, ylabel="truth")
    return png(figure)


def _reliability(bins: list[list[float]]) -> bytes:
    figure = require_matplotlib()(figsize=(4.2, 3.8), layout="constrained")
    axes = figure.subplots()
    confidence, accuracy, _ = zip(*bins, strict=True)
    axes.plot([0, 1], [0, 1], color="0.7", label="calibrated")
    axes.plot(confidence, accuracy, "o-", label="model")
    lowest = min(0.5, *confidence, *accuracy)
    axes.set(xlabel="probability of the answer", ylabel="share of right answers", xlim=(lowest, 1), ylim=(lowest, 1))
    axes.legend()
    return png(figure)


def _roc(labels: NDArray[np.str_], probabilities: Floats, classes: tuple[str, ...]) -> bytes:
    from sklearn.metrics import roc_curve

    figure = require_matplotlib()(figsize=(4.2, 3.8), layout="constrained")
    axes = figure.subplots()
    for column, label in enumerate(classes):
        wrong, right, _ = roc_curve(labels == label, probabilities[:, column])
        axes.plot(wrong, right, label=label)
    axes.plot([0, 1], [0, 1], color="0.7")
    axes.set(xlabel="share of the others taken for it", ylabel="share of it that is found")
    axes.legend()
    return png(figure)


def survey_picture(points: Mapping[str, Sequence[Any]], present: Mapping[str, float], here: Any) -> bytes:
    """Return a PNG picture of the ceiling against noise, sampling rate and spread of sizes.

    Parameters
    ----------
    points : dict
        Of the axes "snr", "sampling_rate", "size_spread" the points (`cgid.ceiling.survey.Point`).
    present : dict of float
        Where the scene stands on each axis.
    here : Point
        The scene as it is.
    """
    titles = {
        "snr": "peak over noise [dB]",
        "sampling_rate": "sampling rate [Hz]",
        "size_spread": "largest over smallest rock",
    }
    figure = require_matplotlib()(figsize=(10, 3.6), layout="constrained")
    for axes, (axis, title) in zip(figure.subplots(1, 3, sharey=True), titles.items(), strict=True):
        held = sorted((p for p in points[axis] if np.isfinite(p.accuracy)), key=lambda p: p.value)
        for suffix, colour, name in (("", "C0", "drop height not known"), ("_known", "C1", "drop height known")):
            heights = [getattr(p, f"accuracy{suffix}") for p in held]
            errors = [2 * getattr(p, f"accuracy{suffix}_error") for p in held]
            axes.errorbar([p.value for p in held], heights, errors, fmt="o-", color=colour, capsize=2, label=name)
            if np.isfinite(present[axis]):
                axes.plot(present[axis], getattr(here, f"accuracy{suffix}"), "D", color=colour, mec="k", ms=8, zorder=3)
        if np.isfinite(present[axis]):
            axes.axvline(present[axis], color="0.7", zorder=0, label="now")
        if axis != "snr":
            axes.set_xscale("log")
        axes.set(xlabel=title)
        axes.grid(alpha=0.3)
    figure.axes[0].set(ylabel="highest accuracy possible (2 std. errors)")
    figure.axes[0].legend(fontsize="small")
    return png(figure)


def recording_picture(recording: Signal, truth: Mapping[str, NDArray[Any]]) -> bytes:
    """Return a PNG picture of a long recording: waveform with its impacts, spectrogram, shares of the labels.

    Parameters
    ----------
    recording : Signal
    truth : dict of ndarray, each (n_impacts,)
        time [s], bounce and label of every impact, as a recording of `cgid generate` holds them.
    """
    figure = require_matplotlib()(figsize=(11, 8), layout="constrained")
    waveform, spectrogram, shares = figure.subplots(3, 1, sharex=True)
    colours = {label: f"C{k}" for k, label in enumerate(np.unique(truth["label"]))}
    _waveform(waveform, recording, truth, colours)
    _spectrogram(spectrogram, recording)
    _shares(shares, recording.duration, truth, colours)
    shares.set(xlabel="time [s]", xlim=(0, recording.duration))
    return png(figure)


def _waveform(axes: Any, recording: Signal, truth: Mapping[str, NDArray[Any]], colours: Mapping[str, str]) -> None:
    """Draw lowest and highest sample of each pixel, and above them a mark for each rock's first hit and its bounces."""
    step = max(recording.samples.size // 4000, 1)
    whole = recording.samples[: recording.samples.size // step * step].reshape(-1, step)
    middle = (np.arange(len(whole)) + 0.5) * step / recording.sampling_rate
    axes.fill_between(middle, whole.min(axis=1), whole.max(axis=1), color="0.2", lw=0.3)
    top = float(recording.samples.max()) or 1.0
    for row, (label, colour) in enumerate(colours.items()):
        for is_bounce, height, name in ((False, 1.08, label), (True, 1.16, f"{label}, bounces")):
            times = truth["time"][(truth["label"] == label) & ((truth["bounce"] > 0) == is_bounce)]
            place = np.full(times.size, top * (height + 0.2 * row))
            axes.plot(times, place, "|", color=colour, ms=5, alpha=0.35 if is_bounce else 1.0, label=name)
    axes.set(ylabel=f"{recording.quantity or 'signal'} [{recording.unit or '1'}]")
    axes.legend(fontsize="x-small", ncols=2 * len(colours), loc="upper right", bbox_to_anchor=(1, 1.16))


def _spectrogram(axes: Any, recording: Signal) -> None:
    from scipy.signal import spectrogram

    n = min(4096, recording.samples.size)
    frequency, times, density = spectrogram(
        recording.samples, recording.sampling_rate, nperseg=n, noverlap=n // 2, detrend=False
    )
    level = 10 * np.log10(np.maximum(density[1:], np.finfo(np.float32).tiny))
    floor, top = np.quantile(level, [0.02, 0.999])
    mesh = axes.pcolormesh(times, frequency[1:], level, vmin=floor, vmax=top, cmap="magma", rasterized=True)
    axes.set(yscale="log", ylabel="frequency [Hz]")
    axes.figure.colorbar(mesh, ax=axes, label=f"dB re ({recording.unit or '1'})²/Hz", pad=0.01)


def _shares(
    axes: Any, duration: float, truth: Mapping[str, NDArray[Any]], colours: Mapping[str, str], width: float = 0.05
) -> None:
    """Draw the share of each label among the rocks that arrive about a time, within `width` of the duration."""
    first = truth["bounce"] == 0
    arrivals, labels = truth["time"][first], truth["label"][first]
    times = np.linspace(0, duration, 400)
    weights = np.exp(-0.5 * ((times[:, None] - arrivals) / (width * duration)) ** 2)
    total = np.maximum(weights.sum(axis=1), np.finfo(np.float64).tiny)
    for label, colour in colours.items():
        axes.plot(times, weights[:, labels == label].sum(axis=1) / total, color=colour, label=label)
    axes.set(ylim=(0, 1), ylabel=f"share of the arriving rocks\n(within {width * duration:g} s)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="center left")


def frequency_response_picture(frequency: Floats, responses: Mapping[str, NDArray[np.complex128]], unit: str) -> bytes:
    """Return a PNG picture of frequency responses: level over phase.

    Parameters
    ----------
    frequency : ndarray, (n_frequencies,)
        [Hz], above 0.
    responses : dict of ndarray of complex, (n_frequencies,)
        By the name that the picture gives them.
    unit : str
        Of the responses, as "m/s^2/N"; 0 dB is one of it.
    """
    figure = require_matplotlib()(figsize=(7.2, 5.0), layout="constrained")
    level, phase = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for name, response in responses.items():
        # A node is no response at all; the picture leaves it out.
        height = np.where(response == 0, np.nan, np.abs(response))
        level.plot(frequency, 20 * np.log10(height), lw=1, label=name)
        degrees = np.degrees(np.angle(response))
        # Broken where it jumps from one end of the circle to the other.
        degrees[1:][np.abs(np.diff(degrees)) > 180] = np.nan
        phase.plot(frequency, degrees, lw=1)
    level.set(ylabel=f"dB re 1 {unit}", xscale="log", xlim=(frequency[0], frequency[-1]))
    phase.set(xlabel="frequency [Hz]", ylabel="phase [degrees]", ylim=(-185, 185), yticks=range(-180, 181, 90))
    for axes in (level, phase):
        axes.grid(alpha=0.3, which="both")
    if len(responses) > 1:
        level.legend(fontsize="small")
    return png(figure)


def png(figure: Any) -> bytes:
    """Return a matplotlib figure as a PNG picture; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=120, metadata={"Software": None})
    return stream.getvalue()
