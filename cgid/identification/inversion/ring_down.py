"""Ring-down of earlier impacts at the onset of an impact, predicted from the samples before it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.inversion.beam_responses import BeamResponses


class RingDown:
    """Ring-down of earlier impacts: a Gaussian process, observed in `n_quiet` samples before the onset."""

    # Mode amplitudes are those of an impact anywhere after one of `AGES`, with the strength of highest evidence.

    #: Ages of the earlier impact [s], powers of its ring-down over that of the noise, and minimum gain of evidence.
    AGES, POWERS, CERTAIN = (0.005, 0.02, 0.08), np.geomspace(0.3, 3e6, 15), 12.0
    #: The tables are this many samples longer than the inversion, because the onset is not known yet.
    LATER = 64

    def __init__(self, responses: BeamResponses, n_quiet: int, sensor: int = 0) -> None:
        self.n_quiet, self.n_samples = n_quiet, responses.n_samples + self.LATER
        tables = responses.kept(f"ring-down-{n_quiet}-{sensor}", lambda: self._made(responses, sensor))
        self._tables = list(zip(*[iter(tables)] * 5, strict=True))

    def _made(self, responses: BeamResponses, sensor: int) -> list[Floats]:
        """Return powers, rotation, onward, total and spectrum of each age, one after the other."""
        beam, n_quiet = responses.beam, self.n_quiet
        time = np.arange(n_quiet + self.n_samples) / beam.sampling_rate
        frequency = np.abs(beam.poles) / (2 * np.pi)
        loud = np.sqrt(np.mean(np.square(beam.participation), axis=(1, 2))) * np.abs(beam.gain(frequency))
        loud *= np.abs(beam.poles) ** (beam.derivatives - 1) * np.abs(beam.shares[sensor])
        tables = []
        for age in self.AGES:
            size = loud * np.exp(beam.poles.real * age)
            selected = size > 1e-4 * size.max()
            waves = size[selected] * np.exp(np.outer(time, beam.poles[selected]))
            both = np.concatenate([waves.real, waves.imag], axis=1)
            both /= np.sqrt(np.mean(np.sum(np.square(both[:n_quiet]), axis=1)))
            before, after = both[:n_quiet], both[n_quiet:]
            power, rotation = np.linalg.eigh(before @ before.T)
            onward = after @ (before.T @ rotation)
            spectra = [np.square(responses.transformed(part.T[:, : responses.n_samples])) for part in (after, onward)]
            tables += [np.maximum(power, 0.0), rotation, onward, spectra[0].sum(axis=0), spectra[1]]
        return tables

    def after(self, before: Floats, innovation: Floats) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        """Return the ring-down, the noise, the power of the error by coefficient, and whether there is any."""
        # `innovation` (n,) is the innovation of AR noise, the alternative to a ring-down.
        n = len(before)
        best = -self.n_quiet * np.log(np.maximum(innovation, 1e-150)) + self.CERTAIN
        out, level, has_ring_down = np.zeros((n, self.n_samples)), innovation.copy(), np.zeros(n, bool)
        error = np.zeros((n, self._tables[0][3].size))
        for power, rotation, onward, total, spectrum in self._tables:
            variance = 1 + self.POWERS[:, None] * power
            # The most likely noise for each power of the ring-down has a closed form.
            turned = before @ rotation
            noise = np.square(turned) @ (1 / variance.T) / self.n_quiet
            evidence = -0.5 * self.n_quiet * np.log(np.maximum(noise, 1e-300)) - 0.5 * np.log(variance).sum(axis=1)
            which = evidence.argmax(axis=1)
            rows = np.flatnonzero(evidence[np.arange(n), which] > best)
            which = which[rows]
            best[rows], has_ring_down[rows], level[rows] = evidence[rows, which], True, np.sqrt(noise[rows, which])
            gain_of = self.POWERS[which, None] / variance[which]
            out[rows] = (turned[rows] * gain_of) @ onward.T
            error[rows] = self.POWERS[which, None] * np.maximum(total - gain_of @ spectrum, 0.0)
        return out, level, error, has_ring_down
