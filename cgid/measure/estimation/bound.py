"""The statistical bound: how well any unbiased estimate can know a pulse's parameters (Rao 1945, Cramer 1946)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.errors import InvalidValue
from cgid.measure.estimation.model import PARAMETERS, covariance_of, parameters_of, pulse_and_slopes
from cgid.measure.estimation.template import HIGHEST_SHAPE, LOWEST_SHAPE, relative_times
from cgid.measure.filters import low_pass_response, mixing_matrix
from cgid.validation import Floats, rates

#: Impacts treated at once, at most, and their samples.
_ROWS, _SAMPLES = 64, 1 << 20
#: Most samples of a contact: with more of them the bound only falls with their root.
MOST_SAMPLES = 1_000_000
#: The band-limited pulse is followed this many contact durations beyond touch and separation.
_RINGING = 1.0


@dataclass(frozen=True)
class Bound:
    """The Cramer-Rao bound.

    Attributes
    ----------
    covariance : ndarray, (..., 5, 5)
        Of ln(peak), ln(contact duration), onset [s], ln(restitution), baseline over peak; zero where known.
    restitution : ndarray, (...)
        That of the pulse.
    """

    covariance: Floats
    restitution: Floats

    def _deviation(self, name: str) -> Floats:
        place = PARAMETERS.index(name)
        return np.sqrt(self.covariance[..., place, place])

    @property
    def peak_deviation(self) -> Floats:
        """Smallest standard deviation of the peak, over the peak."""
        return self._deviation("ln_peak")

    @property
    def duration_deviation(self) -> Floats:
        """Smallest standard deviation of the contact duration, over the contact duration."""
        return self._deviation("ln_duration")

    @property
    def onset_deviation(self) -> Floats:
        """Smallest standard deviation of the time of touch [s]."""
        return self._deviation("onset")

    @property
    def restitution_deviation(self) -> Floats:
        """Smallest standard deviation of the restitution."""
        return np.asarray(self.restitution * self._deviation("shape"))


def cramer_rao_bound(
    contact_duration: ArrayLike,
    restitution: ArrayLike,
    noise: ArrayLike,
    sampling_rate: ArrayLike,
    *,
    bandwidth: float | None = None,
    onset_known: bool = False,
    fit_baseline: bool = False,
    onset: ArrayLike = 0.5,
) -> Bound:
    """Return the bound of the parameters of a damped-Hertz pulse in white noise.

    Parameters
    ----------
    contact_duration : array_like
        [s].
    restitution : array_like
        Within .05 and 20; above 1 a pulse that leans the other way.
    noise : array_like
        Standard deviation of a sample over the peak.
    sampling_rate : array_like
        [Hz]; `contact_duration * sampling_rate` are the samples in contact, at most `MOST_SAMPLES`.
    bandwidth : float, optional
        Edge of the sensor's low-pass [Hz], as in `cgid.scene.Sensor`; the noise comes behind it, white. Then the
        sampling rate must be one number.
    onset_known : bool
        Whether the time of touch is known.
    fit_baseline : bool
        Whether a constant beside the pulse is unknown, too; it is judged on the samples in contact alone.
    onset : array_like
        Where touch lies between two samples, 0 to 1.

    Returns
    -------
    Bound
        Of the common shape of the parameters. Infinite where there are fewer samples than unknowns.

    Raises
    ------
    InvalidValue
        A number breaks its rule.

    Examples
    --------
    30 samples in contact and 2 % noise:

    >>> bound = cramer_rao_bound(150e-6, [0.35, 0.65], 0.02, 200e3)
    >>> bound.restitution_deviation.round(3).tolist()
    [0.072, 0.016]
    """
    duration, e, level, rate, phase = validation.broadcast(
        contact_duration=validation.positive("contact_duration", contact_duration, "s"),
        restitution=validation.positive("restitution", restitution),
        noise=validation.positive("noise", noise),
        sampling_rate=rates("sampling_rate", sampling_rate),
        onset=validation.between("onset", onset, 0, 1),
    )
    s = np.log(e).ravel()
    if not ((s >= LOWEST_SHAPE - 1e-12) & (s <= HIGHEST_SHAPE + 1e-12)).all():
        low, high = np.exp(LOWEST_SHAPE), np.exp(HIGHEST_SHAPE)
        raise InvalidValue(f"restitution must lie between {low:g} and {high:g}, got {e.min():g} to {e.max():g}")
    response = None
    if bandwidth is not None:
        if np.ptp(rate) > 0:
            raise InvalidValue("sampling_rate must be one number when there is a bandwidth; ask for each rate apart")
        response = low_pass_response(float(rate.flat[0]), bandwidth)
    samples = (duration * rate).ravel()
    if (samples > MOST_SAMPLES).any():
        raise InvalidValue(
            f"contact_duration must be at most {MOST_SAMPLES} samples, got {samples.max():g} "
            f"({duration.max():g} s); give it in seconds, or lower the sampling rate"
        )
    covariance = np.empty((s.size, 5, 5))
    order = np.argsort(samples)
    together = int(np.clip(_SAMPLES / samples.max(initial=1.0), 1, _ROWS))
    for first in range(0, s.size, together):
        rows = order[first : first + together]
        covariance[rows] = _covariance(samples[rows], s[rows], phase.ravel()[rows], response, onset_known, fit_baseline)
    covariance *= (level.ravel() ** 2)[:, None, None]
    covariance[:, 2] /= rate.ravel()[:, None]
    covariance[:, :, 2] /= rate.ravel()[:, None]
    return Bound(covariance.reshape(*e.shape, 5, 5), e)


def _covariance(
    samples: Floats, shape: Floats, phase: Floats, response: Floats | None, onset_known: bool, fit_baseline: bool
) -> Floats:
    """Return the covariance of pulses of peak 1 in noise of deviation 1, times in samples."""
    width = samples / relative_times(shape)[0]
    parameters = parameters_of(np.ones_like(shape), width, phase, shape)
    margin = 1 if response is None else int(_RINGING * samples.max()) + len(response)
    times = np.arange(-margin, int(samples.max()) + margin + 3, dtype=np.float64)
    mixing = None if response is None else mixing_matrix(response, times.size)
    _, slopes = pulse_and_slopes(
        parameters, np.broadcast_to(times, (len(shape), times.size)), onset_known, fit_baseline
    )
    if mixing is not None:
        slopes = slopes @ mixing
    if fit_baseline:
        # Samples in contact alone: how many there are beside it is no matter of the pulse.
        slopes = slopes * ((times > phase[:, None]) & (times < (phase + samples)[:, None]))[:, None]
    information = np.matmul(slopes, np.swapaxes(slopes, 1, 2))
    with np.errstate(all="ignore"):
        covariance = covariance_of(information, parameters, onset_known, fit_baseline)
    enough = np.ceil(phase + samples) - np.floor(phase) - 1 >= information.shape[1]
    return np.where(enough[:, None, None] if response is None else True, covariance, np.inf)
