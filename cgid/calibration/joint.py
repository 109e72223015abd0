"""All participations of a beam's modes together, from recorded forces: least squares on the found poles.

A band also contains the tails of modes outside of it. Below their frequencies these respond to a force like a spring,
above like a free mass (residuals of modal analysis). Each is a mode here, far from the band and strongly damped, so
that a table of modes contains them, and scenes and inversions need to know nothing of them.

Where a beam is damped in places, joints for example, its points do not move in phase: a participation is a complex
number, whose imaginary part responds a quarter of a period later. Both parts are columns of the fit.

Columns that do not help to predict a tap that was left out are dropped one by one, the least useful first. This needs
only products of columns: the Gram matrix of each tap.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Complex, Floats
from cgid.measure.modal.finite import Stretch, bins_in
from cgid.measure.modal.modes import LINE_DAMPING, resonator_poles

#: The mass line is a mode at this fraction of the lowest frequency of the band, the stiffness lines are at these
#: multiples of the highest: modes near the band bend the response more than those far away. Their damping ratio.
_BELOW, _ABOVE = 0.1, (1.5, 4.0)
#: Bins of a tap processed at once.
_BINS = 4096
#: Complex participations leave at most this fraction of the energy that real ones leave.
_TURNED = 0.5
#: Relative size of what is added to the diagonal of a Gram matrix of normed columns.
_RIDGE = 1e-12

Indices = NDArray[np.intp]


def lines_of(band: tuple[float, float]) -> Complex:
    """Return the poles of the mass line and the stiffness lines of a band [Hz] [1/s]."""
    return resonator_poles([_BELOW * band[0], *(above * band[1] for above in _ABOVE)], LINE_DAMPING)


@dataclass(frozen=True, kw_only=True, eq=False)
class Blow:
    """The force of a tap and the vibration from its start."""

    response: Floats  # (n_samples,), of one sensor
    force: Floats  # (n,) [N], at the first samples; 0 afterwards
    earlier: Sequence[tuple[int, Floats]] = ()  # forces before, and how many samples earlier they begin


def spectra_of(blows: Sequence[Blow], bins: Indices) -> tuple[Complex, Complex]:
    """Return some bins of the responses and forces of taps, equally long, each (n_taps, n_bins)."""
    n = blows[0].response.size
    response = np.stack([np.fft.rfft(blow.response)[bins] for blow in blows])
    return response, np.stack([np.fft.rfft(blow.force, n)[bins] for blow in blows])


@dataclass(frozen=True, eq=False)
class Gram:
    """Products of the responses to the forces of taps, column by column, and of the measured responses.

    A column is a mode of participation 1 kg^-1, or 1j behind those of all modes.
    """

    matrix: Floats  # (n_taps, 2 n_modes, 2 n_modes)
    vector: Floats  # (n_taps, 2 n_modes)
    power: Floats  # (n_taps,)
    n_bins: int  # of all taps

    def of(self, taps: Indices) -> Gram:
        """Return the same of some taps."""
        return Gram(self.matrix[taps], self.vector[taps], self.power[taps], self.n_bins * len(taps) // len(self.power))

    def solved(self, columns: Indices) -> tuple[Floats, Floats]:
        """Return the factors of all columns from all taps, 0 but for some, and the inverse of their Gram matrix."""
        matrix, vector = self.matrix.sum(axis=0)[np.ix_(columns, columns)], self.vector.sum(axis=0)[columns]
        norm = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        inverse = np.linalg.inv(matrix * np.outer(norm, norm) + _RIDGE * np.eye(columns.size)) * np.outer(norm, norm)
        out = np.zeros(self.matrix.shape[1])
        out[columns] = inverse @ vector
        return out, inverse

    def unexplained(self, factors: Floats) -> Floats:
        """Return the fraction of the energy of each tap that factors of columns do not explain, (n_taps,)."""
        explained = 2 * self.vector @ factors - np.einsum("i,tij,j->t", factors, self.matrix, factors, optimize=True)
        return np.asarray(np.maximum(1 - explained / self.power, 0.0))

    def left(self) -> float:
        """Return the median fraction of the energy of a tap that all columns leave."""
        return float(np.median(self.unexplained(self.solved(np.arange(self.matrix.shape[1]))[0])))

    def eliminated(self, left: Indices) -> Iterator[tuple[Indices, Floats]]:
        """Yield the columns left and the factors of all, from some columns to one; the least useful goes next."""
        factors, inverse = self.solved(left)
        while True:
            yield left, factors
            if left.size == 1:
                return
            curvature = np.maximum(np.diag(inverse), 1e-300)
            worst = int(np.argmin(np.square(factors[left]) / curvature))
            # The inverse without a row and a column (Schur), and the factors that go with it.
            step = inverse[worst] / curvature[worst]
            factors = factors.copy()
            factors[left] -= step * factors[left[worst]]
            inverse = np.delete(np.delete(inverse - np.outer(inverse[:, worst], step), worst, 0), worst, 1)
            factors[left[worst]] = 0.0
            left = np.delete(left, worst)


def gram_of(
    blows: Sequence[Blow],
    pole: Complex,
    sampling_rate: float,
    derivatives: int,
    band: tuple[float, float],
    delay: float = 0.0,
) -> Gram:
    """Return the products of equally long taps in a band [Hz] for forces recorded `delay` [s] too late."""
    n = len(blows)
    size = 2 * pole.size
    matrix, vector, power = np.zeros((n, size, size)), np.zeros((n, size)), np.zeros(n)
    n_samples = blows[0].response.size  # of all
    inside = bins_in(n_samples, sampling_rate, band)
    spectra = [np.fft.rfft(blow.response)[inside] / sampling_rate for blow in blows]
    for first in range(0, inside.size, _BINS):
        part = slice(first, first + _BINS)
        stretch = Stretch(
            pole=pole,
            bins=inside[part],
            n_samples=n_samples,
            sampling_rate=sampling_rate,
            derivatives=derivatives,
        )
        for k, (blow, spectrum) in enumerate(zip(blows, spectra, strict=True)):
            before = np.zeros(pole.size, complex)
            for ago, force in blow.earlier:
                before += stretch.states(force, ago, delay)
            columns = np.concatenate(stretch.by_mode(blow.force, before, delay), axis=1)
            power[k] += np.sum(np.square(np.abs(spectrum[part])))
            matrix[k] += (columns.conj().T @ columns).real
            vector[k] += (columns.conj().T @ spectrum[part]).real
    return Gram(matrix, vector, np.maximum(power, 1e-300), n * inside.size)


@dataclass(frozen=True, eq=False)
class Participations:
    """Participations fitted together."""

    kept: Indices  # numbers of the modes that help to predict other taps, ascending
    value: Complex  # (n_kept,)
    deviation: Floats  # (n_kept,), standard deviations
    unexplained: Floats  # (n_taps,), fraction of the amplitude of each tap that the others' participations leave

    def is_better_than(self, other: Participations, n_bins: int) -> bool:
        """Return whether these predict taps better than those of fewer poles; of one tap, by Schwarz's criterion."""
        gain = np.square(other.unexplained) - np.square(self.unexplained)
        if gain.size > 1:
            return bool(gain.mean() > gain.std(ddof=1) / np.sqrt(gain.size))
        more = 4 * (self.value.size - other.value.size)
        ratio = float(other.unexplained[0] / max(self.unexplained[0], 1e-300))
        return bool(4 * n_bins * np.log(max(ratio, 1e-300)) > more * np.log(2 * n_bins))


def fitted(gram: Gram) -> Participations:
    """Return the participations of the modes that help to predict taps left out; of a single tap all.

    They are complex where that takes half of the energy that real ones leave.
    """
    # What modes outside of the band leave at the ends of a stretch has any phase, and few modes of it.
    columns = np.arange(gram.vector.shape[1])
    real, turned = _fitted(gram, columns[: columns.size // 2]), _fitted(gram, columns)
    better = np.square(turned.unexplained).mean() < _TURNED * np.square(real.unexplained).mean()
    return turned if better else real


def _fitted(gram: Gram, columns: Indices) -> Participations:
    n_taps, n_columns = gram.vector.shape
    everything = np.arange(n_taps)
    if n_taps == 1:
        kept = columns
    else:
        lost = np.zeros((n_taps, columns.size + 1))  # by the number of columns left
        for tap in everything:
            held_out, others = gram.of(everything[[tap]]), gram.of(np.delete(everything, tap))
            lost[tap, 0] = 1.0
            for left, factors in others.eliminated(columns):
                lost[tap, left.size] = held_out.unexplained(factors)[0]
        n_kept = _fewest(lost)
        kept = next(left for left, _ in gram.eliminated(columns) if left.size == max(n_kept, 1))
    value, inverse = gram.solved(kept)
    unexplained = gram.unexplained(value)
    noise = float(np.sum(unexplained * gram.power)) / max(gram.n_bins - kept.size / 2, 1)
    # A bin has two real parts.
    variance = np.zeros(n_columns)
    variance[kept] = np.diag(inverse) * noise / 2
    if n_taps > 1:
        each = np.stack([gram.of(np.delete(everything, tap)).solved(kept)[0] for tap in everything])
        variance = np.maximum(variance, (n_taps - 1) / n_taps * np.square(each - each.mean(axis=0)).sum(axis=0))
        unexplained = np.array([gram.of(everything[[tap]]).unexplained(each[tap])[0] for tap in everything])
    modes = np.unique(kept % (n_columns // 2))
    real, imaginary = value.reshape(2, -1)[:, modes]
    deviation = np.sqrt(variance.reshape(2, -1).sum(axis=0)[modes])
    return Participations(modes, real + 1j * imaginary, deviation, np.sqrt(unexplained))


def _fewest(lost: Floats) -> int:
    """Return the fewest columns that predict taps left out (n_taps, n + 1) as well as the best number."""
    best = int(np.argmin(lost.mean(axis=0)))
    worse = lost - lost[:, [best]]
    error = worse.std(axis=0, ddof=1) / np.sqrt(len(lost))
    return int(np.flatnonzero(worse.mean(axis=0) <= error)[0])
