"""The samples around a pulse that a fit uses, in windows of similar length, and the run of samples that stands out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.fit.ar_noise import ARNoise
from cgid.measure.fit.template import FREE, relative_times, slopes_and_pulse

#: Margin of a window around the contact found by the search, and its largest extent after the peak, in widths: less
#: than 0.2 % of the peak is left there at any restitution.
_MARGIN, _FURTHEST = 0.35, 4.5
#: Window lengths are powers of this number.
_STEP = 1.5
#: Longer windows are averaged over equal runs of samples: a few hundred points suffice for a smooth curve.
_LONGEST = 240
#: Runs of `strongest_run`: growth factor, shortest [samples], longest over the frame.
_GROWTH, _SHORTEST, _MAX_SHARE = 1.4, 3, 0.5
#: Best run of a pulse over its width (impulse over peak), and mean of that run over the peak.
_RUN_OVER_WIDTH, _MEAN_OVER_PEAK = 1.1, 0.74

Selected = NDArray[np.intp] | NDArray[np.bool_] | slice
#: Maximum number of samples of a mixing matrix (2 GiB).
_MAX_MIXED = 1 << 14


class Window:
    """The samples of some rows that a fit uses, `length` columns from `first` (n,) on, and the curve to fit to them."""

    # A `run` of columns makes a point. `levels` (3, n): an offset, the sensor's limit, and a divisor of the samples.
    # Attributes: `rows` (n,) of the frames; `values` and `times` (n, n_points), times in samples of the frame;
    # `averaged` (n,) samples per point; `outside` and `clipped` (n, n_points) or None; `largest_outside` (n,), largest
    # magnitude outside the window; `reach` (n,), its last column; `free`, columns of the fitted parameters; `colour` of
    # the noise or None.

    def __init__(
        self,
        samples: NDArray[np.floating],
        rows: NDArray[np.intp],
        first: NDArray[np.intp],
        length: int,
        run: int,
        levels: Floats,
        onset: Floats | None,
        response: Floats | None,
    ) -> None:
        (n, n_samples), (offset, clip_level, unit) = (len(rows), samples.shape[1]), levels
        self.rows, self.run, self.averaged, self.reach = rows, run, np.full(n, float(run)), first + length - 1
        self.onset, self.free = onset, FREE[onset is not None]
        self.largest_outside = _largest_outside(samples, rows, first, length, offset) / unit
        self.times = first[:, None] + (0.5 * (run - 1) + run * np.arange(length // run, dtype=np.float64))
        columns = first[:, None] + np.arange(length)
        beyond = None
        if first.min() < 0 or first.max() + length > n_samples:
            beyond = (columns < 0) | (columns >= n_samples)
            columns = np.minimum(np.maximum(columns, 0), n_samples - 1)
        columns += (rows * n_samples)[:, None]
        values = samples.ravel().take(columns) - offset[:, None]
        clipped = values >= clip_level[:, None] if np.isfinite(clip_level).any() else None
        if clipped is not None and beyond is not None:
            clipped &= ~beyond
        # Each run of samples becomes one point.
        if run > 1:
            shape = (n, length // run, run)
            values = values.reshape(shape).mean(axis=2)
            beyond, clipped = (
                None if flags is None else np.asarray(flags.reshape(shape).any(axis=2)) for flags in (beyond, clipped)
            )
        values /= unit[:, None]
        self.values, self.outside = values, beyond
        self.clipped = clipped if clipped is not None and clipped.any() else None
        self.n_clipped, n_outside = (
            np.zeros(n, np.intp) if flags is None else flags.sum(axis=1) for flags in (self.clipped, beyond)
        )
        self.n_inside = values.shape[1] - n_outside
        self.colour: ARNoise | None = None
        self._mixing = None if response is None else mixing_matrix(response, values.shape[1])

    def tied(self, parameters: Floats) -> Floats:
        """Return the parameters, with the peak time that follows from a known onset."""
        return tied(parameters, self.onset)

    def residual(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Return samples minus curve (n, n_points), and the slopes of the curve (n, n_free, n_points)."""
        both = self.slopes_and_residual(parameters)
        return both[:, -1], both[:, :-1]

    def slopes_and_residual(self, parameters: Floats, rows: Selected = slice(None)) -> Floats:
        """Return the slopes of the curve and, last, samples minus curve, (n, n_free + 1, n_points)."""
        curves = slopes_and_pulse(parameters, self.times[rows], self.onset is not None)
        if self._mixing is not None:
            curves = curves @ self._mixing
        if self.run > 1:
            # The mean over a run of samples is the curve at its middle plus this part of its second difference.
            curves[..., 1:-1] += (1 - self.run**-2) / 24 * np.diff(curves, n=2)
        residual = curves[:, -1]
        np.subtract(self.values[rows], residual, out=residual)
        # Points outside the frame have no weight, nor do clipped samples below the curve.
        ignored = None if self.outside is None else self.outside[rows]
        if self.clipped is not None:
            above = self.clipped[rows] & (residual < 0)
            ignored = above if ignored is None else ignored | above
        if ignored is not None:
            curves[np.broadcast_to(ignored[:, None], curves.shape)] = 0.0
        return curves if self.colour is None else self.colour.whitened(curves, np.arange(len(self.rows))[rows])


def tied(parameters: Floats, onset: Floats | None) -> Floats:
    """Return the parameters (n, 4), with the peak time that follows from a known onset (n,), changed in place."""
    if onset is not None:
        parameters[:, 2] = onset + relative_times(parameters[:, 3])[1] * np.exp(parameters[:, 1])
    return parameters


def windows(
    samples: NDArray[np.floating],
    guess: Floats,
    offset: Floats | float,
    clip_level: Floats | float,
    unit: Floats | float = 1.0,
    *,
    onset: Floats | None = None,
    response: Floats | None = None,
    before: int = 0,
    among: NDArray[np.intp] | None = None,
) -> Iterator[Window]:
    """Yield windows around pulses (peak, ln width, peak time, shape), grouped by similar length."""
    # Values are divided by `unit`; `offset` and `clip_level` are in the unit of the samples. Each window begins
    # `before` points earlier than the pulse needs. With a sensor's response samples are not averaged.
    levels = np.stack([np.broadcast_to(value, len(guess)) for value in (offset, clip_level, unit)])
    width = np.exp(guess[:, 1])
    duration, lead, *_ = relative_times(guess[:, 3])
    first = np.floor(guess[:, 2] - (lead + _MARGIN) * width).astype(np.intp) - 2
    lengths = np.minimum(duration + 2 * _MARGIN, lead + _MARGIN + _FURTHEST) * width
    for rows, length in by_length(lengths):
        length += 4
        run = max(-(-length // _LONGEST), 1) if response is None else 1
        length = -(-length // run) * run + before * run
        selected = rows if among is None else among[rows]
        curve = (None if onset is None else onset[rows], response)
        yield Window(samples, selected, first[rows] - before * run, length, run, levels[:, rows], *curve)


def mixing_matrix(response: Floats, n_samples: int) -> Floats:
    """Return the matrix (n_samples, n_samples) that applies a symmetric impulse response to rows of samples."""
    if n_samples > _MAX_MIXED:
        raise InvalidValue(
            f"a low-passed pulse must last at most {_MAX_MIXED} samples with the ringing of its filter, got "
            f"{n_samples}; leave the bandwidth out, which hardly changes such a long pulse, or use fewer samples"
        )
    lags = np.zeros(2 * n_samples - 1)
    truncated = response[:n_samples]
    lags[n_samples - len(truncated) : n_samples], lags[n_samples - 1 : n_samples - 1 + len(truncated)] = (
        truncated[::-1],
        truncated,
    )
    return np.ascontiguousarray(np.lib.stride_tricks.sliding_window_view(lags, n_samples)[::-1])


def by_length(required: Floats) -> Iterator[tuple[NDArray[np.intp], int]]:
    """Yield rows of similar lengths (n,), and a length that is enough for all of them."""
    # Lengths come in steps, so that a row's window does not depend on the other rows.
    step = np.ceil(np.log(np.maximum(required, 1.0)) / np.log(_STEP)).astype(np.intp)
    for exponent in sorted(set(step.tolist())):
        yield np.flatnonzero(step == exponent), int(np.ceil(_STEP**exponent))


def _largest_outside(
    samples: NDArray[np.floating], rows: NDArray[np.intp], first: NDArray[np.intp], length: int, offset: Floats
) -> Floats:
    """Return the largest magnitude of the samples outside windows, (n,)."""
    outside = samples[rows]
    columns = np.minimum(np.maximum(first[:, None] + np.arange(length), 0), samples.shape[1] - 1)
    columns += (np.arange(len(rows)) * samples.shape[1])[:, None]
    # The window is filled with a sample from outside it, if there is one.
    before, after = first > 0, first + length < samples.shape[1]
    spare = np.where(before, outside[:, 0], np.where(after, outside[:, -1], offset))
    outside.ravel()[columns] = spare[:, None]
    away = np.maximum(outside.max(axis=1) - offset, offset - outside.min(axis=1))
    return np.where(before | after, away, 0.0)


def strongest_run(samples: NDArray[np.floating], offset: Floats) -> tuple[Floats, Floats, Floats]:
    """Return peak, width [samples] and centre [samples] of the most significant running mean, each (n,)."""
    # A box is within 6 % of the matched filter for these pulses, and running sums make boxes of all lengths cheap.
    n, n_samples = samples.shape
    total = np.zeros((n, n_samples + 1))
    np.cumsum(samples - offset[:, None], axis=1, dtype=np.float64, out=total[:, 1:])
    best = np.full(n, -np.inf)
    run, peak_time = np.ones(n), np.zeros(n)
    rows = np.arange(n)
    length = _SHORTEST
    while length <= max(_MAX_SHARE * n_samples, _SHORTEST):
        strength = (total[:, length:] - total[:, :-length]) / np.sqrt(length)
        top = np.argmax(strength, axis=1)
        better = strength[rows, top] > best
        best = np.where(better, strength[rows, top], best)
        run, peak_time = np.where(better, length, run), np.where(better, top + 0.5 * (length - 1), peak_time)
        length = max(int(length * _GROWTH), length + 1)
    return best / np.sqrt(run) / _MEAN_OVER_PEAK, run / _RUN_OVER_WIDTH, peak_time
