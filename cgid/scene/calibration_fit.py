"""Fit the modes of a beam to recorded blows: first guesses from free ringing, then least squares over whole recordings.

ESPRIT (Roy & Kailath 1989, IEEE Trans. ASSP 37, 984) on all decays together yields more poles than there are modes:
once for the whole band and twice for its lower parts, where a mode turns slowly. A greedy search then picks the pole
that explains most of the rest, as long as chance would not explain as much.

The linear unknowns, participations or gain, are solved for directly. Gauss-Newton steps on the residual give
frequencies, damping ratios and delays (variable projection, Golub & Pereyra 1973, with the derivative of Kaufman 1975,
BIT 15, 49).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cgid.physics.response import Quantity, Resonators, Response
from cgid.scene.calibration_blow import PreparedBlow
from cgid.scene.schema import Scene
from cgid.validation import Complex, Floats

#: Decimation factors: the whole band, a quarter and a sixteenth of it.
_DECIMATIONS = (1, 4, 16)
#: Decimation filter: clean share of the decimated rate, and spoilt samples at the start.
_CLEAN_BAND, _UNCLEAN_START = 0.4, 6
#: Longest sliding window and shortest decay [samples].
_WINDOW, _SHORTEST = 192, 48
#: Additional poles beyond the number of modes.
_BEYOND = (4, 12)
#: The model order assumes at most this many modes: more would be noise.
_MOST_ASKED = 20
#: Range of damping ratios of structural modes.
DAMPING_RATIOS = (1e-4, 0.3)
#: Most modes if the caller sets no limit.
MOST_MODES = 40
#: Longest part of a decay that is used [samples].
_LONGEST = 8192
#: No more poles are picked below this share of the energy, because synthetic recordings may have no noise.
NOTHING_LEFT = 1e-7


@dataclass(frozen=True)
class Ringing:
    """Damped modes without shapes or masses."""

    frequency: Floats  # [Hz], (n,)
    damping_ratio: Floats  # (n,)

    def joined(self, other: Ringing) -> Ringing:
        """Return these modes and others."""
        return Ringing(
            np.concatenate([self.frequency, other.frequency]), np.concatenate([self.damping_ratio, other.damping_ratio])
        )


def ringing_modes(decays: list[Floats], rate: float, n_modes: int, highest: float, of_filters: Complex) -> Ringing:
    """Return at most `n_modes` modes of the decays that stand out of the noise, the loudest first.

    rate and highest frequency are in Hz. of_filters are poles of the upper half-plane [rad/s] that are no modes.
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
    """Return the poles of the upper half-plane [rad/s] from models of several orders."""
    n_samples = decays.shape[1]
    window = min(_WINDOW, n_samples // 2)
    if n_samples < _SHORTEST:
        return np.empty(0, complex)
    # Its eigenvectors are the left singular vectors of the concatenated Hankel matrices.
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
    """Return the poles that explain the decays (n_samples, n_decays), in descending order of explained energy."""
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
        # Bayesian information criterion: amplitude and phase for each decay, one frequency and damping for all.
        chance = (2 * n_decays + 2) * np.log(decays.size)
        if energy < NOTHING_LEFT * before or decays.size * np.log(energy / rest) < chance:
            break
        picked.append(best)
        basis = np.concatenate([basis, new[best]], axis=1)
        left = left - new[best] @ (new[best].T @ left)
    return poles[picked]


def _orthogonal(pairs: Complex, basis: Floats) -> Floats:
    """Return an orthonormal basis of the real and imaginary parts after projecting out another basis."""
    parts = np.concatenate([pairs.real, pairs.imag], axis=1)
    parts = parts[:, np.abs(parts).max(axis=0, initial=0.0) > 0]
    size = np.linalg.norm(parts, axis=0)
    for _ in range(2):  # one pass is not orthogonal to rounding
        parts = parts - basis @ (basis.T @ parts)
    parts = parts[:, np.linalg.norm(parts, axis=0) > 1e-6 * size]
    return np.linalg.qr(parts)[0] if parts.size else parts


#: Error of the response.
_TOLERANCE = 1e-6
#: Samples of a blow used to find its delay.
_ALIGNED = 2048
#: Step of the derivatives: frequency in half-widths of the mode, log of the damping ratio, samples.
_STEP = 1e-3
#: Most steps of a fit: if it needs more, there is a mode too many, but the others are already found.
_MOST_STEPS = 20
#: Bounds of the fit: in half-widths, in logs of the damping ratio, in samples.
_FAR, _FAR_DAMPING, _FAR_DELAY = 3.0, 1.5, 2.0


@dataclass(frozen=True)
class Fit:
    """The least-squares fit of some blows."""

    modes: Resonators
    amounts: Floats  # of the rows of participation, (n_columns,)
    delays: Floats  # relative to the detected start of each blow [samples], (n_blows,)
    remains: list[Floats]  # the residual of each blow, over its largest sample
    losses: Floats  # additional residual energy without each column, (n_columns,)

    def only(self, which: NDArray[np.bool_]) -> Ringing:
        """Return some of the modes."""
        return Ringing(np.asarray(self.modes.frequency)[which], np.asarray(self.modes.damping_ratio)[which])

    @property
    def energy(self) -> float:
        """Energy of the residuals."""
        return sum(float((rest**2).sum()) for rest in self.remains)

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Which columns explain more than chance; each has three numbers: amount, frequency and damping ratio."""
        n = sum(rest.size for rest in self.remains)
        return np.asarray(n * np.log1p(self.losses / max(self.energy, 1e-300)) > 3 * np.log(n))


def columns(scene: Scene, blow: PreparedBlow, modes: Resonators, participation: Floats, shifts: Floats) -> Floats:
    """Return the motion for rows of participation (n_columns, n_modes), (n_shifts, n_columns, n_samples)."""
    sensor, rate = scene.sensor, scene.sampling.sampling_rate
    assert sensor.quantity != "force"
    quantity: Quantity = sensor.quantity
    response = Response(sampling_rate=rate, quantity=quantity, modes=modes, filters=blow.filters, tolerance=_TOLERANCE)
    n = shifts.size * len(participation)
    frames = np.zeros((n, blow.samples.size))
    onset = np.repeat((blow.onset + shifts) / rate, len(participation))
    response.add_to_frames(frames, _Rows(blow, n), onset, np.tile(participation, (shifts.size, 1)))
    heard = sensor.limit_band(frames, rate) if blow.limited else frames
    heard = (heard - heard.mean(axis=1, keepdims=True)) / blow.level
    return np.asarray(heard.reshape(shifts.size, len(participation), -1), np.float64)


class _Rows:
    """The force of a blow, repeated for each frame."""

    def __init__(self, blow: PreparedBlow, n: int) -> None:
        self.contact_duration = np.broadcast_to(blow.pulse.contact_duration.ravel(), (n,))
        self.end_of_contact = np.broadcast_to(blow.pulse.end_of_contact.ravel(), (n,))
        self.add_to_frames = blow.pulse.add_to_frames


def _aligned(scene: Scene, blows: Sequence[PreparedBlow], modes: Resonators, participation: Sequence[Floats]) -> Floats:
    """Return the best of the shifts of each blow [samples], (n_blows,)."""
    squares, products, energies = [], [], []
    for blow, rows in zip(blows, participation, strict=True):
        samples = blow.samples[:_ALIGNED]
        short = replace(blow, samples=samples - samples.mean())
        sound = columns(scene, short, modes, rows, short.shifts)
        squares.append(np.einsum("sit,sjt->sij", sound, sound))
        products.append(np.einsum("sit,t->si", sound, short.samples))
        energies.append(float((short.samples**2).sum()))
    explained = [np.einsum("si,si->s", h, _solved(g, h)) for g, h in zip(squares, products, strict=True)]
    clearest = int(np.argmax([part.max() / energy for part, energy in zip(explained, energies, strict=True)]))
    best = int(np.argmax(explained[clearest]))
    amounts = _solved(squares[clearest][best], products[clearest][best])
    # A shift by half a period with the opposite sign fits almost as well, so the clearest blow sets the sign.
    for _ in range(3):
        places = [
            int(np.argmin(np.einsum("i,sij,j->s", amounts, g, amounts) - 2 * h @ amounts))
            for g, h in zip(squares, products, strict=True)
        ]
        amounts = _solved(
            sum(g[place] for g, place in zip(squares, places, strict=True)),
            sum(h[place] for h, place in zip(products, places, strict=True)),
        )
    return np.array([blow.shifts[place] for blow, place in zip(blows, places, strict=True)])


def _solved(squares: Floats, products: Floats) -> Floats:
    """Return the least-squares amounts; two equal columns share theirs."""
    return np.asarray((np.linalg.pinv(squares, rcond=1e-12, hermitian=True) @ products[..., None])[..., 0])


@dataclass(frozen=True)
class _Model:
    """The model of all blows, with free or fixed frequencies and damping ratios; see `fitted`."""

    scene: Scene
    blows: Sequence[PreparedBlow]
    modes: Resonators
    participation: Sequence[Floats]
    free: bool

    @property
    def n_moved(self) -> int:
        return self.modes.frequency.size if self.free else 0

    def at(self, unknowns: Floats) -> Resonators:
        """Return the modes for the unknowns: frequencies, damping ratios, delays."""
        if not self.free:
            return self.modes
        n, f, zeta = self.n_moved, self.modes.frequency, self.modes.damping_ratio
        return Ringing(f * (1 + zeta * unknowns[:n]), zeta * np.exp(unknowns[n : 2 * n]))

    def sound(self, unknowns: Floats) -> Floats:
        """Return the concatenated columns of all blows, (n_samples, n_columns)."""
        modes, delays = self.at(unknowns), unknowns[2 * self.n_moved :]
        parts = [
            columns(self.scene, blow, modes, rows, delay)[0]
            for blow, rows, delay in zip(self.blows, self.participation, delays[:, None], strict=True)
        ]
        return np.concatenate(parts, axis=1).T

    @property
    def samples(self) -> Floats:
        return np.concatenate([blow.samples for blow in self.blows])

    def amounts(self, unknowns: Floats) -> tuple[Floats, Floats]:
        """Return the amounts of the columns, and the residual."""
        sound = self.sound(unknowns)
        amounts = np.asarray(np.linalg.lstsq(sound, self.samples, rcond=None)[0], np.float64)
        return amounts, self.samples - sound @ amounts

    def derivative(self, unknowns: Floats) -> Floats:
        """Return the derivative of the residual by each unknown, (n_samples, n_unknowns)."""
        sound = self.sound(unknowns)
        basis, triangle = np.linalg.qr(sound)
        amounts = np.linalg.lstsq(triangle, basis.T @ self.samples, rcond=None)[0]
        slopes = []
        n = self.n_moved
        # A column depends only on its own mode, a blow only on its own delay, so all of a kind move in one step.
        for first in (0, n) if self.free else ():
            slopes.append((self.sound(_moved(unknowns, first, first + n)) - sound) / _STEP * amounts)
        late = (self.sound(_moved(unknowns, 2 * n, unknowns.size)) - sound) @ amounts / _STEP
        edges = np.cumsum([0, *(blow.samples.size for blow in self.blows)])
        delays = np.zeros((late.size, len(self.blows)))
        for number in range(len(self.blows)):
            part = slice(edges[number], edges[number + 1])
            delays[part, number] = late[part]
        slope = np.concatenate([*slopes, delays], axis=1)
        return np.asarray(basis @ (basis.T @ slope) - slope)


def _moved(unknowns: Floats, first: int, last: int) -> Floats:
    moved = unknowns.copy()
    moved[first:last] += _STEP
    return moved


def fitted(
    scene: Scene,
    blows: Sequence[PreparedBlow],
    modes: Resonators,
    participation: Sequence[Floats] | None = None,
    delays: Floats | None = None,
) -> Fit:
    """Return the least-squares fit of all blows, starting from a first guess of modes and delays [samples].

    participation holds the columns of each blow whose amounts are sought, (n_columns, n_modes). By default each mode
    has its own amount, and frequencies and damping ratios are fitted as well. Delays are sought unless given.
    """
    from scipy.optimize import least_squares

    free = participation is None
    rows = [np.eye(modes.frequency.size)] * len(blows) if participation is None else participation
    delays = _aligned(scene, blows, modes, rows) if delays is None else delays
    model = _Model(scene, blows, modes, rows, free)
    n = model.n_moved
    damped = np.minimum(_FAR_DAMPING, np.log(0.95 / modes.damping_ratio[:n]))
    far = np.concatenate([np.full(n, _FAR), damped, np.full(delays.size, _FAR_DELAY)])
    lowest = np.concatenate([np.full(n, -_FAR), np.full(n, -_FAR_DAMPING), np.full(delays.size, -_FAR_DELAY)])
    start = np.concatenate([np.zeros(2 * n), delays])
    found = least_squares(
        lambda unknowns: model.amounts(unknowns)[1],
        start,
        model.derivative,
        bounds=(start + lowest, start + far),
        xtol=1e-6,
        ftol=1e-6,
        max_nfev=_MOST_STEPS,
    ).x
    amounts, rest = model.amounts(found)
    sound = model.sound(found)
    losses = amounts**2 / np.maximum(np.diag(np.linalg.pinv(sound.T @ sound, hermitian=True)), 1e-300)
    edges = np.cumsum([blow.samples.size for blow in blows])[:-1]
    return Fit(model.at(found), amounts, found[2 * n :], np.split(rest, edges), losses)
