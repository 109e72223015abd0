"""What the methods `plot` of signals, impacts, scenes and datasets draw, on axes of matplotlib."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid.errors import InvalidValue, optional
from cgid.plots.figure import COLOURS, NEUTRAL, colours_of, plain, written
from cgid.units import quantity_of

if TYPE_CHECKING:
    from cgid.physics.contact.impact import Impact
    from cgid.signals import Batch, Signal

#: Maximum number of lines of one picture: more cannot be told apart.
MAX_LINES = 200
#: Maximum number of points of a line; of a longer one, the smallest and the largest sample of each part are drawn.
_MAX_POINTS = 20_000
#: Signals are drawn around the samples above this part of their largest one; by eye.
_LOUD = 0.2
#: Largest duration that is drawn in ms [s].
_SHORT = 0.5


def plot_signal(signal: Signal, axes: Any = None) -> Any:
    """Draw a signal over time."""
    axes, short = _axes(axes), signal.duration <= _SHORT
    times, samples = _thinned(signal.samples)
    marker = "." * (samples.size == 1)  # a line of one point is nothing
    axes.plot(times / signal.sampling_rate * (1e3 if short else 1.0), samples, marker, lw=0.8, color=NEUTRAL)
    axes.set(xlabel=f"time [{'ms' if short else 's'}]", ylabel=_quantity(signal.unit), title=plain(signal.name))
    return axes


def plot_impact(impact: Impact, axes: Any = None) -> Any:
    """Draw the contact force of an impact, or of each of an array, over time."""
    axes, n = _axes(axes), impact.peak_force.size
    if not 1 <= n <= MAX_LINES:
        raise InvalidValue(f"impact must be 1 to {MAX_LINES} to be drawn, got {n}; take some of its values")
    times = np.linspace(-0.05, 1.1, 600) * float(np.max(impact.contact_duration))
    force = impact.force(times).reshape(n, -1)
    few = n <= len(COLOURS)
    for row, colour in zip(force, COLOURS if few else [NEUTRAL] * n, strict=False):
        axes.plot(times * 1e3, row / 1e3, lw=1.2 if few else 0.8, color=colour)
    axes.set(xlabel="time after first contact [ms]", ylabel="contact force [kN]")
    return axes


def plot_batches(batches: Iterable[Batch], n: int, title: str, axes: Any = None) -> Any:
    """Draw the first `n` signals of each label, on top of one another, in the colours of reports."""
    n, axes = validation.whole("n", n, 1, MAX_LINES), _axes(axes)
    drawn: dict[str, list[tuple[NDArray[Any], NDArray[Any]]]] = {}
    batch = None
    for batch in batches:
        times = (np.arange(batch.signals.shape[-1]) - batch.pre_trigger) / batch.sampling_rate * 1e3
        for label in np.unique(batch.labels).tolist():
            lines = drawn.setdefault(label, [])
            lines += [(times, row) for row in batch.signals[batch.labels == label][: n - len(lines)]]
    if batch is None or not drawn:
        raise InvalidValue(f"{title}: must have a signal to be drawn, it has none")
    for label, colour in colours_of(drawn).items():
        for number, (times, row) in enumerate(drawn[label]):
            line, *_ = axes.plot(times, row.T, color=colour, lw=0.8, alpha=0.6)  # of each sensor
            line.set_label("" if number else label)
    axes.set(xlabel="time after onset [ms]", ylabel=_quantity(batch.unit), title=plain(title))
    loud = [
        times[np.abs(row).reshape(-1, len(times)).max(axis=0) >= _LOUD * np.abs(row).max()]
        for lines in drawn.values()
        for times, row in lines
    ]
    ends = min(one[0] for one in loud), max(one[-1] for one in loud)
    margin = ends[1] - ends[0] + times[1] - times[0]
    axes.set_xlim(max(times[0], ends[0] - margin / 2), min(times[-1], ends[1] + margin))
    if any(drawn):
        axes.legend()
    return axes


def _axes(axes: Any) -> Any:
    """Return the axes, or new ones that a notebook shows; raises `MissingExtra` without matplotlib."""
    if axes is not None:
        return axes
    pyplot = optional("matplotlib.pyplot", "pictures need", "plot", name="matplotlib")
    return pyplot.subplots(figsize=(7, 3.2), layout="constrained")[1]


def _thinned(samples: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return numbers and values of the samples to draw."""
    step = -(-len(samples) // (_MAX_POINTS // 2))
    if step < 3:
        return np.arange(len(samples)), samples
    whole = len(samples) // step * step
    parts = samples[:whole].reshape(-1, step)
    extremes = np.sort(np.stack([parts.argmin(axis=1), parts.argmax(axis=1)]), axis=0)
    numbers = (extremes + np.arange(len(parts)) * step).T.ravel()
    return numbers, samples[numbers]


def _quantity(unit: str | None) -> str:
    return f"{'signal' if unit is None else quantity_of(unit)} [{written(unit)}]"
