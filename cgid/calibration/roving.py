"""A beam without a drawing: the shapes of its modes from hammer taps at many places, at one sensor.

All taps see the same modes, so their decays determine the poles together. The participations of a place follow from
its own taps. They are the product of the shapes at the place and at the sensor; those of a tap next to the sensor are
its square, which tells one from the other. Between the places shapes are interpolated
(`cgid.physics.structure.places`), and how well each place follows from the others tells how dense they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cgid._lib import validation
from cgid._lib.files import check_new, write_whole
from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted
from cgid._lib.validation import Floats
from cgid.calibration.joint import Gram, gram_of, lines_of
from cgid.calibration.poles import poles_of
from cgid.calibration.taps import (
    EXACT,
    LONGEST,
    RINGS,
    Flaw,
    Tap,
    TapTest,
    aligned,
    band_of,
    blows_of,
    hammer_force,
    judged,
    remaining_delay,
    save_table,
    usable,
)
from cgid.errors import BadData, InvalidValue
from cgid.measure.modal.modes import Modes, are_lines, shapes_beside, text_of_shapes, text_of_table
from cgid.physics.structure.places import PlacedShapes, placed
from cgid.physics.structure.response import DERIVATIVES

#: Poles are sought in the decays of so many taps.
_DECAYS = 24
#: Taps nearer to each other are at one place [m]. Fewest places.
_SAME_PLACE, FEWEST = 1e-3, 6
#: A mode that other places predict this badly, over its root mean square, is noise.
_NOISE = 0.95
#: A tap is not where its row says if its place is off so many times as much as a usual one, and by this much.
_SURPRISE, _OFF = 4.0, 0.3
#: The modal mass is within this factor of the usual one; what stands for modes outside of the band gives no way to a
#: contact: its mass is so many times the usual one.
_MASSES, _OUTSIDE = 4.0, 100.0


@dataclass(frozen=True, kw_only=True, eq=False)
class RovingTest(TapTest):
    """Modes of a beam with their shapes at places.

    Participations of `modes` are root mean squares over the places; `unexplained` is what those that follow from other
    places leave of each used tap.

    Attributes
    ----------
    modes, taps, duration, band, poles, delay, response, unexplained, measure
        As of `TapTest`; there is no frequency response.
    places : ndarray, (n_places, 2) [m]
    shapes : ndarray, (n_places, n_rows)
        Of the rows of `response`, over their root mean square.
    placed : PlacedShapes
        The same between the places.
    """

    places: Floats
    shapes: Floats
    placed: PlacedShapes

    @property
    def unpredicted(self) -> Floats:
        """Fraction of the amplitude of each mode that other places do not predict, root mean square, (n_modes,)."""
        return self.placed.unpredicted[~are_lines(self.response.damping_ratio)]

    @property
    def mode_shapes(self) -> Floats:
        """Shapes of `modes` at the places, over their root mean square, (n_places, n_modes)."""
        return self.shapes[:, ~are_lines(self.response.damping_ratio)]

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write tables for `tail_beam.modes` and `tail_beam.learned`, and next to it one for `tail_beam.shapes`.

        The deviation of a participation is that of the shape between places.
        """
        beside = check_new(shapes_beside(path), "a table of shapes", (".csv",), overwrite=overwrite)
        at_impact = np.asarray(self.response.at_impact)
        root = np.asarray(self.response.at_sensor) / at_impact
        columns = {
            "frequency": self.response.frequency,
            "damping_ratio": self.response.damping_ratio,
            "modal_mass": np.square(1 / at_impact),
            "shape_impact": np.ones_like(root),
            "shape_sensor": root,
            **self.response.columns,
        }
        note = "shapes are over their root mean square at the places of the taps"
        path = save_table(path, text_of_table(columns, "1/kg"), note, overwrite)
        write_whole(beside, text_of_shapes(self.places, self.shapes).encode(), overwrite=overwrite)
        return path


def roving_test(  # noqa: PLR0913
    response: Floats,
    sampling_rate: float,
    *,
    hammer: Floats,
    places: Floats,
    sensor: tuple[float, float],
    times: Sequence[float] | None = None,
    quantity: str = "acceleration",
    band: tuple[float, float] | None = None,
    max_order: int = 24,
    source: str = "signal",
    progress: Callable[[int], object] | None = None,
) -> RovingTest:
    """Return the modes of a beam with their shapes from hammer taps at known places.

    Parameters
    ----------
    response : ndarray, (n_channels, n_samples)
        Motion of the beam in SI units; shapes are those of the first channel.
    sampling_rate : float [Hz]
    hammer : ndarray, (n_samples,)
        Force of the hammer [N], in either direction.
    places : ndarray, (n_taps, 2) [m]
        x and y of each tap. Taps at one place are averaged.
    sensor : tuple of float [m]
        x and y of the sensor; one of the taps must be next to it.
    times : sequence of float, optional [s]
        Of each tap; by default the taps of the recording in their order.
    quantity, band, max_order, source, progress
        As of `tap_test`.

    Returns
    -------
    RovingTest

    Raises
    ------
    InvalidValue
        A number breaks its rule.
    BadData
        Places and taps do not match, are too few, or no place is next to the sensor; or as of `tap_test`.
    """
    quantity = validation.choice("quantity", quantity, tuple(DERIVATIVES))
    places = np.asarray(places, np.float64)
    if places.ndim != 2 or places.shape[1:] != (2,) or (times is not None and len(times) != len(places)):
        raise InvalidValue(f"places must be x and y of each tap, got shape {places.shape}; give one for each time")
    force, hits = hammer_force(hammer, sampling_rate, source)
    force, hits, delay = aligned(response, force, hits, sampling_rate, source)
    taps = judged(response, sampling_rate, hits, 0.0, times, source)
    rows = _rows_of(taps, places, times, source)
    used = usable(taps, source)
    row_of = [rows[tap.time] for tap in used]
    _, of_tap = np.unique(np.round(places[row_of] / _SAME_PLACE).astype(int), axis=0, return_inverse=True)
    of_tap = of_tap.ravel()
    every = np.array([places[row_of][of_tap == k].mean(axis=0) for k in range(of_tap.max() + 1)])
    _require_enough(every, sensor, source)
    length = min(min(tap.stop - tap.start for tap in used), LONGEST)
    low, high = band_of(band, length / sampling_rate, sampling_rate, source)
    chosen = np.unique(np.linspace(0, len(used) - 1, min(len(used), _DECAYS)).round().astype(int)).tolist()
    decays = np.stack([row[used[k].start : used[k].start + length] for row in response for k in chosen])
    with threadpool_limits(1, "blas"):
        poles = poles_of(decays, sampling_rate, (low, high), max_order, progress)
    if not poles.pole.size:
        raise BadData(
            f"{source}: the decays must contain a mode from {low:.4g} to {high:.4g} Hz; change {spelled('band')}"
        )
    pole = np.concatenate([poles.pole, lines_of((low, high))])
    blows = blows_of(response[0], force, hits, used, sampling_rate, RINGS / np.abs(pole.real).min())
    part = [blows[k] for k in chosen], [used[k] for k in chosen]
    rest, alike = remaining_delay(poles, *part, sampling_rate, DERIVATIVES[quantity])
    if not alike.all():
        raise BadData(f"{source}: the hammer's delay must be constant; record both on one device")
    gram = gram_of(blows, pole, sampling_rate, DERIVATIVES[quantity], (low, high), rest)
    size, ratio = np.abs(pole), -pole.real / np.abs(pole)
    while True:
        known = np.unique(of_tap)
        points = every[known]
        kept, value, shape = _shapes(gram, of_tap, known, points, size / (2 * np.pi), ratio)
        if not kept.size or not (kept < poles.pole.size).any():
            raise BadData(
                f"{source}: the places must be close enough for a mode to be interpolated, none of "
                f"{counted(poles.pole.size, 'mode')} is; tap a finer grid, check the table of taps, or lower "
                f"{spelled('band')}"
            )
        off = np.sqrt(np.mean(np.square(shape.left_out[:, kept < poles.pole.size]), axis=1))
        worst = int(np.argmax(shape.surprise))
        if shape.surprise[worst] < _SURPRISE * np.median(shape.surprise) or off[worst] < _OFF:
            break
        bad = of_tap == known[worst]
        detail = f"{100 * off[worst]:.0f} % off what other places predict ({100 * np.median(off):.0f} % usual)"
        wrong = {used[k].time for k in np.flatnonzero(bad)}
        taps = [replace(tap, flaw=Flaw.ELSEWHERE, detail=detail) if tap.time in wrong else tap for tap in taps]
        if sum(tap.flaw == Flaw.ELSEWHERE for tap in taps) > len(taps) // 4:
            raise BadData(f"{source}: a quarter of the taps is not where the table of taps says; correct it")
        used, of_tap, gram = usable(taps, source), of_tap[~bad], gram.of(np.flatnonzero(~bad))
    level = np.sqrt(np.mean(np.square(value), axis=0))
    is_mode = kept < poles.pole.size
    at_sensor = shape.shapes(np.clip(sensor[0], *shape.shapes.region[:2]), np.clip(sensor[1], *shape.shapes.region[2:]))
    mass = at_sensor / np.square(level)
    usual = float(np.median(mass[is_mode & (mass > 0)])) if (mass[is_mode] > 0).any() else 1.0
    mass = np.where(is_mode, np.clip(mass, usual / _MASSES, usual * _MASSES), usual * _OUTSIDE)
    deviation = np.zeros((3, kept.size))
    deviation[:2, is_mode] = poles.deviation[:, kept[is_mode]]
    deviation[2] = np.clip(shape.deviation, EXACT, 1.0)
    found = Modes(
        frequency=size[kept] / (2 * np.pi),
        damping_ratio=ratio[kept],
        at_impact=1 / np.sqrt(mass),
        at_sensor=level * np.sqrt(mass),
        deviation=deviation,
    )
    order = np.argsort(found.frequency)
    predicted = np.zeros((len(known), 2 * pole.size))
    predicted[:, kept] = value - shape.left_out * level
    left = [
        gram.of(np.array([k])).unexplained(predicted[np.searchsorted(known, row)])[0] for k, row in enumerate(of_tap)
    ]
    return RovingTest(
        modes=found.taken(np.flatnonzero(is_mode)),
        taps=tuple(taps),
        duration=length / sampling_rate,
        band=(low, high),
        poles=poles.taken(kept[is_mode]),
        delay=delay + rest,
        response=found.taken(order),
        unexplained=np.sqrt(left),
        places=points,
        shapes=(value / level)[:, order],
        placed=shape.taken(order),
    )


def _rows_of(taps: Sequence[Tap], places: Floats, times: Sequence[float] | None, source: str) -> dict[float, int]:
    """Return the row of the table of places of each tap, by its time; raises `BadData` if they do not match."""
    if times is None:
        if len(taps) != len(places):
            raise BadData(
                f"{source}: the table of taps must have a row for each tap, got {len(places)} for "
                f"{counted(len(taps), 'tap')}; correct it, or add the column time_s"
            )
        return {tap.time: row for row, tap in enumerate(taps)}
    nearest = np.abs(np.array(times)[:, None] - [tap.time for tap in taps]).argmin(axis=1)
    tap, count = np.unique(nearest, return_counts=True)
    if (count > 1).any():
        raise BadData(
            f"{source}: each row of the table of taps must have a tap of its own, the tap at "
            f"{taps[tap[count.argmax()]].time:.4g} s has {count.max()}; correct time_s"
        )
    return {taps[k].time: row for row, k in enumerate(nearest.tolist())}


def _require_enough(points: Floats, sensor: tuple[float, float], source: str) -> None:
    """Raise `BadData` unless there are enough places, one of them next to the sensor."""
    if len(points) < FEWEST:
        raise BadData(f"{source}: taps must be at {FEWEST} places or more, got {len(points)}; tap a grid of places")
    apart = np.linalg.norm(points[:, None] - points, axis=2) + np.where(np.eye(len(points)), np.inf, 0.0)
    spacing, nearest = float(np.median(apart.min(axis=1))), float(np.linalg.norm(points - sensor, axis=1).min())
    if nearest > spacing:
        raise BadData(
            f"{source}: a tap must be next to the sensor, the nearest is {1e3 * nearest:.0f} mm from it where places "
            f"are {1e3 * spacing:.0f} mm apart; tap there, too, or correct {spelled('sensor')}"
        )


def _shapes(
    gram: Gram, of_tap: NDArray[np.intp], known: NDArray[np.intp], points: Floats, frequency: Floats, ratio: Floats
) -> tuple[NDArray[np.intp], Floats, PlacedShapes]:
    """Return the columns that are no noise, their participations (n_places, n_columns), and the same between places."""
    kept = np.arange(frequency.size)
    while True:
        value = np.stack([gram.of(np.flatnonzero(of_tap == k)).solved(kept)[0][kept] for k in known])
        shape = placed(points, value, frequency[kept], ratio[kept])
        noise = shape.unpredicted > _NOISE
        if not noise.any():
            return kept, value, shape
        kept = kept[~noise]
        if not kept.size:
            return kept, value[:, :0], shape
