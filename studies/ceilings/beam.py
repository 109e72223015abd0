"""What anybody can know of a pulse behind a beam: the errors of Cramér and Rao.

The samples of a scene with a tail beam depend on six unknowns: ln peak, ln width and shape of the pulse, touch, and the
place x, y. Their slopes and the noise give the information of Fisher; its inverse is the least covariance of an
unbiased estimate (Rao 1945, Cramér 1946), which estimates reach at high signal to noise. What a scene says of touch and
place is information, too. A learner on pulses with such errors estimates the limit (`studies.ceilings.learners`). It is
no bound: estimates may be biased, faint blows are not linear, and a pulse stands for the closest one of the family.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.identification.inversion.contact import HIGHEST, LOWEST, ContactFit
from cgid.identification.inversion.inversion import Inversion
from cgid.measure.fit.template import curve
from cgid.measure.modal.beam import respond
from cgid.scene import Scene
from cgid.scene.synthesis.draws import BLOCK
from cgid.scene.synthesis.impacts import PulseBlock, draw
from cgid.scene.synthesis.through_beam import beam_of, has_beam
from studies.ceilings.limit import require_supported

#: Unknowns of a blow, in order; touch in samples after the table of forces begins, so many before that of touch.
UNKNOWNS, _LEAD = ("ln peak", "ln width", "shape", "touch", "x", "y"), 3
#: Share of the energy of a response that may be left out, and rows at a time.
_LEFT_OUT, _ROWS = 1e-10, 64
#: Least deviation that a scene leaves to touch [samples] and place [m].
_KNOWN = 1e-6
#: Points of a pulse from touch to separation, less one.
_POINTS = 512
#: Least and largest shape s = ln e; above 0 a pulse rises more slowly than it falls.
_SHAPES = (float(np.log(0.06)), 1.2)
#: Times at which pulses are compared, in widths.
_TIMES = np.linspace(-8, 8, 801)


def check_estimated(scene: Scene) -> None:
    """Raise `InvalidValue` if the errors behind the beam of a scene are not known, or nothing is asked."""
    require_supported(scene)
    sensor = scene.sensor
    problems = (
        (scene.tail_beam is None, "a [tail_beam], add one"),
        (sensor.quantity == "force", "a sensor of motion: give sensor.quantity, or take [tail_beam] out"),
        (scene.randomise is not None, "one rig and one sampling rate: take [randomise] out"),
        (not has_beam(scene), "at least 2 samples, at one sampling rate: give sampling.samples"),
        (sensor.bandwidth is not None, "a causal filter: give sensor.anti_alias in place of bandwidth"),
        (sensor.coloured, "white noise: take sensor.noise_exponent or noise_spectrum out"),
        (scene.background is not None, "white noise: take [background] out, or give its level as sensor.noise_density"),
        (not sensor.noisy, "noise: give sensor.noise_density; without it every pulse is told exactly"),
        (
            any(p.second_hit is not None or p.clipped_at is not None for p in scene.populations),
            "single hits that are not cut off: take second_hit and clipped_at out",
        ),
    )
    for wrong, rule in problems:
        if wrong:
            raise InvalidValue(f"scene {scene.name}: the estimate of a ceiling behind a beam needs {rule}")


@dataclass(frozen=True, eq=False)
class Pulses:
    """The pulses of some blows.

    Attributes
    ----------
    unknowns : ndarray, (n, 6)
        As in `UNKNOWNS`, of the closest pulse of the family.
    apart : ndarray, (n,)
        Distance of the closest pulse, root mean square, over that of the pulse.
    blows : Blows
    """

    unknowns: Floats
    apart: Floats
    blows: PulseBlock


class BeamErrors:
    """The errors of estimates of pulses behind the beam of a scene.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    InvalidValue
        The errors behind its beam are not known, as for coloured noise or several sampling rates.
    """

    def __init__(self, scene: Scene) -> None:
        check_estimated(scene)
        self.scene, self.beam = scene, beam_of(scene)
        self._inversion = Inversion(self.beam)
        self.fit = ContactFit(self._inversion)

    @cached_property
    def _tables(self) -> tuple[NDArray[np.float32], Floats]:
        """Responses of each mode to each shape in a basis of all, (n_modes, n_shapes * n_basis), and the basis.

        The basis is orthonormal, (n_samples, n_basis): white noise stays white in it.
        """
        sampling = self.scene.sampling
        n_samples = max(sampling.samples - sampling.pre_trigger - int(np.ceil(sampling.jitter)) + _LEAD + 1, 2)
        found = respond(self.beam, self._inversion.forces, n_samples)
        flat = found.reshape(-1, n_samples)
        power, basis = np.linalg.eigh(flat.T @ flat)
        basis = basis[:, power > _LEFT_OUT * power[-1]]
        return np.ascontiguousarray((flat @ basis).reshape(len(found), -1), dtype=np.float32), basis

    @cached_property
    def _prior(self) -> Floats:
        """Information that the scene gives on the unknowns, (6,)."""
        deviation = np.array([np.inf, np.inf, np.inf, self.scene.sampling.jitter / np.sqrt(12), 0.0, 0.0])
        beam = self.scene.tail_beam
        if beam is not None and beam.impact_point is not None:
            middles = (np.arange(512) + 0.5) / 512
            point = beam.impact_point
            deviation[4:] = np.std(point.x.quantile(middles)), np.std(point.y.quantile(middles))
        return np.asarray(np.maximum(deviation, _KNOWN) ** -2)

    def slopes(self, unknowns: Floats) -> Floats:
        """Return the slopes of the noiseless samples in the unknowns, in a basis of these.

        Parameters
        ----------
        unknowns : ndarray, (n, 6)
            ln peak [N], ln width [s], shape, touch [samples], x and y [m].

        Returns
        -------
        ndarray, (n, 6, n_basis)
            The slope in ln peak is the signal itself. `signals` turns them into samples.
        """
        log_peak, log_width, shape, touch, x, y = unknowns.T
        rate, height = self.beam.sampling_rate, np.exp(log_peak)[:, None]
        own, ways = self.fit.coefficients(np.exp(log_width), shape, touch / rate)
        ways = np.concatenate([own[:, None], ways], axis=1) * height[:, None]
        ways[:, 3] /= rate
        rows = self._rung(x, y)
        pulse = ways.astype(np.float32) @ rows[0]
        place = ways[:, None, 0].astype(np.float32) @ rows[1:]
        return np.concatenate([pulse, *place], axis=1).astype(np.float64)

    def signals(self, slopes: Floats) -> Floats:
        """Return slopes as samples.

        Parameters
        ----------
        slopes : ndarray, (..., n_basis)

        Returns
        -------
        ndarray, (..., n_samples)
            In the unit of the sensor, the first one where the table of forces begins.
        """
        return slopes @ self._tables[1].T

    def _rung(self, x: Floats, y: Floats) -> NDArray[np.float32]:
        """Return responses to the shapes at places and their slopes in x and y, (3, n, n_shapes, n_basis)."""
        table, basis = self._tables
        at = np.concatenate(self.beam.weights(x, y))
        return (at @ table).reshape(3, len(x), -1, basis.shape[1])

    def information(self, unknowns: Floats) -> Floats:
        """Return Fisher's information on the unknowns, with what the scene says of touch and place.

        Parameters
        ----------
        unknowns : ndarray, (n, 6)
            As in `slopes`.

        Returns
        -------
        ndarray, (n, 6, 6)
            Its inverse is the least covariance of an unbiased estimate.
        """
        parts = [self._information(unknowns[first : first + _ROWS]) for first in range(0, len(unknowns), _ROWS)]
        return np.concatenate(parts)

    def _information(self, unknowns: Floats) -> Floats:
        slopes, sensor = self.slopes(unknowns), self.scene.sensor
        signals = self.signals(slopes[:, 0])
        peak = np.abs(signals).max(axis=1)
        variance = sensor.noise_level(peak, self.beam.sampling_rate) ** 2
        full: Any = sensor.full_scale(peak)
        found = slopes @ slopes.transpose(0, 2, 1)
        if full is not None:
            full = np.broadcast_to(full, peak.shape)
            if sensor.bits is not None:
                variance = variance + (full / 2 ** (sensor.bits - 1)) ** 2 / 12
            for row in np.flatnonzero(peak > full):  # a sample at full scale tells nothing
                lost = slopes[row] @ self._tables[1][np.abs(signals[row]) > full[row]].T
                found[row] -= lost @ lost.T
        found /= variance[:, None, None]
        found[:, range(6), range(6)] = found[:, range(6), range(6)] * (1 + 1e-9) + self._prior
        return np.asarray(found)

    def drawn(self, seed: int, block: int) -> Pulses:
        """Return the pulses of a block of the scene's impacts, each as the closest one of the family.

        Parameters
        ----------
        seed, block : int
            As of `cgid.scene.synthesise`, in blocks of 256.

        Returns
        -------
        Pulses
        """
        blows = draw(self.scene, seed, block)
        values, width, shape, apart = blows.parameters, np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
        for strike in blows.strikes:
            rows = strike.rows
            lasts, peak = values["contact_duration"][rows], values["peak_force"][rows]
            force = np.zeros((rows.size, _POINTS + 1))
            strike.pulses.add_to_frames(force, _POINTS / lasts, np.zeros(rows.size))
            relative, shape[rows], apart[rows] = _closest(force / peak[:, None])
            width[rows] = relative * lasts
        touch = _LEAD + values["onset"] * self.beam.sampling_rate % 1
        places = [values.get(name, np.zeros(BLOCK)) for name in ("impact_x", "impact_y")]
        unknowns = np.stack([np.log(values["peak_force"]), np.log(width), shape, touch, *places], axis=1)
        return Pulses(unknowns, apart, blows)

    def estimated(self, seed: int, n_draws: int) -> Iterator[tuple[Floats, Pulses]]:
        """Yield what estimates of pulses tell, block by block of 256 impacts, and the true pulses.

        Parameters
        ----------
        seed : int
        n_draws : int
            Rounded up to whole blocks.

        Yields
        ------
        tuple of ndarray, (256, 9), and Pulses
            ln peak, ln width and shape, the logarithms of their deviations, and their correlations.
        """
        for block in range(-(-n_draws // BLOCK)):
            true = self.drawn(seed, block)
            numbers = np.random.default_rng([seed, block]).standard_normal((BLOCK, 6))
            unknowns = self._scattered(true.unknowns, numbers)
            # As of any estimate, its covariance is taken at the estimate. That at the truth would tell the truth: in
            # scene tail_beam a learner would be right in .895 in place of .851.
            covariance = np.linalg.inv(self.information(unknowns))[:, :3, :3]
            deviation = np.sqrt(covariance[:, range(3), range(3)])
            correlation = covariance[:, [0, 0, 1], [1, 2, 2]] / deviation[:, [0, 0, 1]] / deviation[:, [1, 2, 2]]
            yield np.hstack([unknowns[:, :3], np.log(deviation), correlation]), true

    def _scattered(self, unknowns: Floats, numbers: Floats) -> Floats:
        """Return estimates: the truth and errors of the covariance of Cramér and Rao, within the bounds of a fit."""
        information = self.information(unknowns)
        upper = np.linalg.cholesky(information).transpose(0, 2, 1)
        found = unknowns + np.linalg.solve(upper, numbers[:, :, None])[:, :, 0]
        covariance = np.linalg.inv(information)
        for column, low, high in ((2, LOWEST[1], HIGHEST[1]), (1, LOWEST[0], HIGHEST[0])):
            # The best estimate on the bound: the others follow by their covariance.
            beyond = np.clip(found[:, column], low, high) - found[:, column]
            found += covariance[:, column] * (beyond / covariance[:, column, column])[:, None]
        found[:, 1:3] = np.clip(found[:, 1:3], LOWEST, HIGHEST)
        return np.asarray(found)


def _closest(pulse: Floats) -> tuple[Floats, Floats, Floats]:
    """Return width over duration, shape, and distance of the closest pulses of the family, each (n,).

    Those with the same peak, impulse and mean time that come closest to pulses of peak 1, (n, `_POINTS` + 1). The
    distance is root mean square, over that of the pulse.
    """
    width, own = _centred(pulse)
    shapes, others = _nodes()
    apart = np.square(own).sum(axis=1)[:, None] + np.square(others).sum(axis=1) - 2 * own @ others.T
    best = np.clip(apart.argmin(axis=1), 1, shapes.size - 2)
    before, here, after = (apart[np.arange(len(own)), best + step] for step in (-1, 0, 1))
    bend = before + after - 2 * here
    offset = np.clip((before - after) / (2 * bend), -1, 1)  # the lowest point of a parabola
    least = np.maximum(here - 0.5 * bend * offset**2, 0.0) / np.square(own).sum(axis=1)
    return width, shapes[best] + offset * (shapes[1] - shapes[0]), np.sqrt(least)


@cache
def _nodes() -> tuple[Floats, Floats]:
    """Return shapes and their pulses as of `_centred`."""
    shapes, share = np.linspace(*_SHAPES, 129), np.linspace(0, 1, _POINTS + 1)
    return shapes, _centred(curve(np.broadcast_to(share, (shapes.size, share.size)), shapes))[1]


def _centred(pulse: Floats) -> tuple[Floats, Floats]:
    """Return the width of pulses over their duration, (n,), and the pulses by widths from their mean time."""
    share = np.linspace(0, 1, pulse.shape[1])
    width, middle = pulse.sum(axis=1) / (share.size - 1), (pulse @ share) / pulse.sum(axis=1)
    places = middle[:, None] + width[:, None] * _TIMES
    rows = zip(places, pulse, strict=True)
    return width, np.array([np.interp(at, share, one, left=0.0, right=0.0) for at, one in rows])
