"""Overlapping triangular bands of a spectrum: on the mel scale, or evenly spaced.

A band rises from the centre of the one below to its own and falls to the centre of the one above, so what leaves one
enters the next: between the first and the last centre the bands add up to the whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cgid.validation import Floats

#: Bands of the mel scale are so far apart [mel], and this many.
_MEL_STEP, _MEL_BANDS = 100.0, 39
#: Even bands are so far apart [Hz], and this many.
_EVEN_STEP, _EVEN_BANDS = 150.0, 150


def mel(frequency: Floats) -> Floats:
    """Return the mel of frequencies [Hz] (O'Shaughnessy 1987): even steps below 1 kHz, even ratios far above.

    Examples
    --------
    >>> float(mel(np.float64(1000.0)).round(2))
    999.99
    """
    return np.asarray(2595.0 * np.log10(1.0 + frequency / 700.0))


def frequency_of(mels: Floats) -> Floats:
    """Return the frequencies [Hz] of mels."""
    return np.asarray(700.0 * (10.0 ** (mels / 2595.0) - 1.0))


@dataclass(frozen=True, eq=False)
class TriangularBands:
    """A bank of triangular bands.

    Attributes
    ----------
    corners : ndarray, (n_bands + 2,)
        Lowest edge, centres, highest edge [Hz], rising.
    """

    corners: Floats

    @property
    def centres(self) -> Floats:
        """Of the bands [Hz], (n_bands,)."""
        return self.corners[1:-1]

    def __len__(self) -> int:
        return len(self.corners) - 2

    def within(self, highest: float) -> TriangularBands:
        """Return those of the bands that end at or below a frequency [Hz]."""
        return TriangularBands(self.corners[: max(int(np.searchsorted(self.corners, highest, side="right")), 2)])

    def sums(self, energy: Floats, spacing: float) -> Floats:
        """Return the energy in each band.

        Parameters
        ----------
        energy : ndarray, (..., n_bins)
            In each bin; the first is centred at 0 Hz. The last must reach the highest edge.
        spacing : float
            Between bins [Hz].

        Returns
        -------
        ndarray, (..., n_bands)
            Every row is the same whatever else is in the array (a product of matrices would not promise that).
        """
        first, stop = (int(np.ceil(edge / spacing)) for edge in (self.corners[0], self.corners[-1]))
        stop = min(stop, energy.shape[-1])
        frequency = np.arange(first, stop) * spacing
        # Bin by bin: how far it has come from the corner below to the one above.
        gap = np.clip(np.searchsorted(self.corners, frequency, side="right") - 1, 0, len(self))
        rise = (frequency - self.corners[gap]) / np.diff(self.corners)[gap]
        begin = np.searchsorted(gap, np.arange(len(self) + 1))
        held = np.flatnonzero(np.diff(np.append(begin, gap.size)))
        # Bins first: sums over them then run along all rows at once, and each row is added up by itself.
        part = np.ascontiguousarray(energy.reshape(-1, energy.shape[-1])[:, first:stop].T)
        out = np.zeros((len(self) + 2, part.shape[1]))
        if held.size:
            whole = np.add.reduceat(part, begin[held], axis=0)
            part *= rise[:, None]
            rising = np.add.reduceat(part, begin[held], axis=0)
            out[held + 1] += rising
            out[held] += whole - rising
        return np.ascontiguousarray(out[1:-1].T).reshape(*energy.shape[:-1], len(self))


#: 39 bands, 100 mel apart, up to 23.7 kHz.
MEL_BANDS = TriangularBands(frequency_of(_MEL_STEP * np.arange(_MEL_BANDS + 2, dtype=np.float64)))
#: 150 bands, 150 Hz apart, up to 22.65 kHz: small bodies ring high, where bands of the mel scale are a kilohertz wide.
EVEN_BANDS = TriangularBands(_EVEN_STEP * np.arange(_EVEN_BANDS + 2, dtype=np.float64))
