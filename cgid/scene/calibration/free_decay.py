"""Poles of a beam from how it rings after blows.

ESPRIT (Roy & Kailath 1989, IEEE Trans. ASSP 37, 984) on all decays together gives more poles than there are modes,
once over the whole band and twice over its lower parts, where a mode turns slowly. Of these the ones are picked, one
after the other, that explain most of what is left, as long as chance would not explain as much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.validation import Floats

Complex = NDArray[np.complex128]

#: Every so many samples are looked at: the whole band, a quarter of it, a sixteenth.
_DECIMATIONS = (1, 4, 16)
#: Of a decimated band so much is free of what the filter before it does, of its beginning so few samples are not.
_CLEAN_BAND, _UNCLEAN_START = 0.4, 6
#: Samples of the window that is moved along the decays, at most, and of a decay, at least.
_WINDOW, _SHORTEST = 192, 48
#: Poles asked for beyond the modes that are.
_BEYOND = (4, 12)
#: Of these no more are asked for than so many modes have: more would be noise.
_MOST_ASKED = 20
#: A mode of a structure has a damping ratio between these.
DAMPING_RATIOS = (1e-4, 0.3)
#: No more modes are looked for where nobody says how many.
MOST_MODES = 40
#: Samples of a decay that are looked at.
_LONGEST = 8192
#: What is left when no more is picked, over what there was: recordings from a computer have no noise.
NOTHING_LEFT = 1e-7


@dataclass(frozen=True)
class Ringing:
    """Damped modes by themselves.

    Attributes
    ----------
    frequency : ndarray, (n,)
        [Hz].
    damping_ratio : ndarray, (n,)
    """

    frequency: Floats
    damping_ratio: Floats


def ringing_modes(decays: list[Floats], rate: float, n_modes: int, highest: float, of_filters: Complex) -> Ringing:
    """Return the modes that ring in decays, the loudest first.

    Parameters
    ----------
    decays : list of ndarray, (n_samples,) each
    rate : float
        [Hz].
    n_modes : int
        Not more than these; fewer if no more stand out of the noise.
    highest : float
        No mode is higher [Hz].
    of_filters : ndarray of complex, (n_filters,)
        Poles of the upper half-plane [rad/s] that ring, too, and are no modes.
    """
    length = min(_LONGEST, *(len(decay) for decay in decays))
    together = np.stack([decay[:length] for decay in decays])
    asked = min(n_modes, _MOST_ASKED)
    found = [_poles(together, rate, asked, 1)] + [
        _poles(_decimated(together, factor), rate / factor, asked, factor) for factor in _DECIMATIONS[1:]
    ]
    poles = np.concatenate(found)
    size = np.abs(poles)
    damping = -poles.real / np.maximum(size, 1e-300)
    frequency = size / (2 * np.pi)
    real = (damping > DAMPING_RATIOS[0]) & (damping < DAMPING_RATIOS[1])
    real &= (frequency > rate / length) & (frequency < highest)
    picked = _picked(together.T, poles[real], of_filters[np.abs(of_filters) < np.pi * rate], rate, n_modes)
    return Ringing(np.abs(picked) / (2 * np.pi), -picked.real / np.abs(picked))


def _decimated(decays: Floats, factor: int) -> Floats:
    from scipy.signal import decimate

    if decays.shape[1] < factor * (_SHORTEST + _UNCLEAN_START):
        return decays[:, :0]
    while factor > 1:
        decays, factor = decimate(decays, 4, axis=1, zero_phase=True), factor // 4
    return decays[:, _UNCLEAN_START:]


def _poles(decays: Floats, rate: float, n_modes: int, factor: int) -> Complex:
    """Return the poles [rad/s] of the upper half-plane, of models of several orders."""
    n_samples = decays.shape[1]
    window = min(_WINDOW, n_samples // 2)
    if n_samples < _SHORTEST:
        return np.empty(0, complex)
    # The left singular vectors of all Hankel matrices side by side are the eigenvectors of this.
    rows = np.concatenate([np.lib.stride_tricks.sliding_window_view(decay, window) for decay in decays])
    vectors = np.linalg.eigh(rows.T @ rows)[1][:, ::-1]
    found = []
    for beyond in _BEYOND:
        space = vectors[:, : min(2 * (n_modes + beyond), window // 2)]
        moved = np.linalg.lstsq(space[:-1], space[1:], rcond=None)[0]
        found.append(np.log(np.linalg.eigvals(moved).astype(complex) + 1e-300) * rate)
    poles = np.concatenate(found)
    clean = 0.5 if factor == 1 else _CLEAN_BAND
    return np.asarray(poles[(poles.imag > 0) & (np.abs(poles) < 2 * np.pi * clean * rate)])


def _picked(decays: Floats, poles: Complex, of_filters: Complex, rate: float, n_modes: int) -> Complex:
    """Return the poles that explain the decays (n_samples, n_decays), those first that explain most."""
    n_samples, n_decays = decays.shape
    time = np.arange(n_samples)[:, None] / rate
    basis = _orthogonal(np.exp(of_filters * time), np.empty((n_samples, 0)))
    left = decays - basis @ (basis.T @ decays)
    energy = before = float((decays**2).sum())
    pairs = np.exp(poles * time)
    picked: list[int] = []
    while len(picked) < min(n_modes, poles.size):
        new = [_orthogonal(pairs[:, [number]], basis) for number in range(poles.size)]
        heard = [float(np.sum((own.T @ left) ** 2)) for own in new]
        best = int(np.argmax(heard))
        energy = float((left**2).sum())
        rest = max(energy - heard[best], 1e-300)
        # The Bayesian information criterion: amplitude and phase in every decay, frequency and damping of all.
        chance = (2 * n_decays + 2) * np.log(decays.size)
        if energy < NOTHING_LEFT * before or decays.size * np.log(energy / rest) < chance:
            break
        picked.append(best)
        basis = np.concatenate([basis, new[best]], axis=1)
        left = left - new[best] @ (new[best].T @ left)
    return poles[picked]


def _orthogonal(pairs: Complex, basis: Floats) -> Floats:
    """Return an orthonormal basis of what real and imaginary parts have beside a basis."""
    parts = np.concatenate([pairs.real, pairs.imag], axis=1)
    parts = parts[:, np.abs(parts).max(axis=0, initial=0.0) > 0]
    size = np.linalg.norm(parts, axis=0)
    for _ in range(2):  # once is not enough to be orthogonal to rounding
        parts = parts - basis @ (basis.T @ parts)
    parts = parts[:, np.linalg.norm(parts, axis=0) > 1e-6 * size]
    return np.linalg.qr(parts)[0] if parts.size else parts
