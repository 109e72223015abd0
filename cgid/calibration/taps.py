"""A tap test: hammer taps on a beam, recorded by an accelerometer on it, and the modes in the decay after them.

From the end of an impact to the next tap the recording is a free decay; `poles` finds the modes in all decays together.
With an instrumented hammer the participations of all modes, `shape(tap) shape(sensor) / modal mass`, follow together
from the force and the vibration after it (`joint`), without windows or leakage.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cgid._lib import validation
from cgid._lib.files import check_new, read_cells, write_whole
from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted
from cgid._lib.validation import Floats
from cgid.calibration.agreement import (
    LATEST,
    are_alike,
    disagreeing,
    disagreeing_at_first,
    fine_delay,
    shifted,
    starts_late,
)
from cgid.calibration.frequency_response import FrequencyResponse
from cgid.calibration.joint import Blow, Participations, fitted, gram_of, lines_of
from cgid.calibration.poles import Complexes, Poles, poles_of
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection.ear import Ear
from cgid.identification.detection.events import Event
from cgid.measure.modal.finite import Stretch
from cgid.measure.modal.modes import BAND_COLUMNS, COMPLEX_COLUMNS, LINE_DAMPING, Modes, residues, text_of_table
from cgid.physics.structure.response import DERIVATIVES
from cgid.units import UNITS, quantity_of

#: Contact time of a hammer without a hammer channel, and the ringing of its filter after the force has ended [s].
CONTACT, _AFTER = 2e-3, 0.5e-3
#: A tap ends this long before the onset of the next [s], since an onset may be detected late.
_BEFORE_NEXT = 1e-3
#: An impact makes the second differences of a response grow this many times within this time [s].
JUMP, _JUMP_TIME = 3.0, 2e-3
#: Two impacts within this time are a double tap [s].
DOUBLE = 0.1
#: Minimum length of a decay [s], and relative to the median one.
SHORTEST, _MIN_PART = 30e-3, 0.5
#: Maximum length of a decay [samples].
LONGEST = 1 << 18
#: A clipped response stays at its extreme for three samples, at least at this fraction of the largest deviation.
_CLIPPED_SHARE = 0.5
#: Time within which a recording must show taps [s].
_LOOK = 60.0
#: Listed and detected taps match within this time [s].
NEAR = 0.1
#: Lowest natural frequency in periods of a decay, highest in sampling rates.
_PERIODS, _HIGHEST = 5.0, 0.4
#: Minimum participation, so that masses are finite.
_LEAST = 1e-12
#: An earlier tap is heard for this many times the slowest mode's time constant.
RINGS = 30.0
#: A second force within a tap test is a tap above this fraction of the largest; below it the hammer's channel vibrates.
_FLOOR = 0.05
#: Delays of taps within this time are one [s]; so is none. Phases of fewer modes show none.
_SAME_DELAY, _MIN_PHASES = 1.5e-3, 3
#: No delay is taken if it leaves less than this fraction of the energy that the delay of the phases leaves.
_CLEARLY = 0.25
#: Maximum standard deviation of a row of the response over what is unexplained, and its least.
_AS_A_WHOLE, EXACT = 2.0, 0.01
#: Columns of a table of taps, and their units.
_TAPS = {"time_s": "s", "x_m": "m", "y_m": "m"}
#: Largest table of taps [bytes].
_MAX_FILE_SIZE = 1 << 20


class Flaw(StrEnum):
    """Why a tap is not used."""

    CUT_OFF = "cut off by the start of the recording"
    DOUBLE = "double tap"
    CLIPPED = "clipped"
    BEFORE_NEXT = "too close to the next tap"
    BEFORE_END = "too close to the end of the recording"
    NOT_LISTED = "not in the table of taps"
    UNEXPLAINED = "not explained by the other taps"
    ELSEWHERE = "not where the table of taps says"


#: What to do where no tap is usable, by flaw.
_CURES = {
    Flaw.CUT_OFF: "record again, some samples before a tap",
    Flaw.DOUBLE: "tap again, and lift the hammer at once",
    Flaw.CLIPPED: "record with a larger range, or tap more gently",
    Flaw.BEFORE_NEXT: "leave a second or more between taps",
    Flaw.BEFORE_END: "leave a second or more after the last tap",
    Flaw.NOT_LISTED: "add other taps to the table",
}


@dataclass(frozen=True, kw_only=True)
class Tap:
    """A hammer tap in a recording.

    Attributes
    ----------
    time : float [s]
        Of its onset.
    start, stop : int
        Samples of its free decay.
    flaw : Flaw or None
        Why it is not used; None if used.
    detail : str
        The flaw in numbers, where it has any.
    """

    time: float
    start: int
    stop: int
    flaw: Flaw | None = None
    detail: str = ""

    @property
    def reason(self) -> str:
        """Why it is not used, as text; empty if used."""
        return ", ".join(filter(None, (self.flaw, self.detail)))


@dataclass(frozen=True, kw_only=True, eq=False)
class TapTest:
    """Modes of a beam from a tap test.

    Attributes
    ----------
    modes : Modes
        With standard deviations, by ascending frequency. Only the participation at the first sensor is known, so that
        shapes are those of taps next to it. Without a hammer channel the scale is unknown: participations are over the
        largest.
    taps : tuple of Tap
        In order of time.
    duration : float [s]
        Of each used decay.
    band : tuple of float [Hz]
        Range of the natural frequencies.
    poles : Poles
    delay : float [s]
        By how much the hammer was recorded later than the sensor; it is corrected.
    response : Modes
        What responds to a force like the beam: the modes, or two for each whose decay is not exponential where taps say
        so, with the mass line and the stiffness lines, modes far below and above the band for what those outside of it
        add. Their participations are complex where points do not move in phase. Without a hammer channel the modes.
    unexplained : ndarray, (n_used,), optional
        Fraction of the amplitude of each used tap, in the band, that the response fitted to the other taps leaves.
    measure : callable, optional
        Returns the frequency response, measured and modelled, with a hammer channel.
    """

    modes: Modes
    taps: tuple[Tap, ...]
    duration: float
    band: tuple[float, float]
    poles: Poles
    response: Modes
    delay: float = 0.0
    unexplained: Floats | None = None
    measure: Callable[[], FrequencyResponse] | None = None

    @cached_property
    def frequency_response(self) -> FrequencyResponse | None:
        """The frequency response, measured and modelled, computed when first used; None without a hammer channel."""
        return None if self.measure is None else self.measure()

    @property
    def used(self) -> list[Tap]:
        """The taps with used decays."""
        return [tap for tap in self.taps if not tap.flaw]

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the response as a table for `tail_beam.modes` of a scene, and `tail_beam.learned` next to it.

        Only the participation is known. The shapes are 1 and 1 or -1, and the modal mass is the inverse of its size:
        correct for taps next to the sensor, elsewhere a guess of the beam's compliance. Rows with a damping ratio of
        0.5 are the mass line and the stiffness lines. Scenes and models know real participations alone: those that
        respond most like the complex ones, which have columns of their own.
        """
        every, own = self.response.in_phase(), self.response.participation()
        participation = every.participation()
        columns = {
            "frequency": every.frequency,
            "damping_ratio": every.damping_ratio,
            "modal_mass": 1 / np.maximum(np.abs(participation), _LEAST),
            "shape_impact": np.ones_like(participation),
            "shape_sensor": np.copysign(1.0, participation),
            **every.columns,
            **dict(zip(COMPLEX_COLUMNS, (own.real, own.imag), strict=True)),
            **{name: np.full(own.size, edge) for name, edge in zip(BAND_COLUMNS, every.band or (), strict=False)},
        }
        note = "participations are shape_impact shape_sensor / modal_mass, "
        note += "in 1/kg" if every.scaled else "without a hammer over the largest: masses have no scale"
        if every.scaled:
            note += f"; rows with a damping ratio of {LINE_DAMPING:g} are modes outside of the band"
        return save_table(path, text_of_table(columns, "1/kg" if every.scaled else "1"), note, overwrite)


def save_learned(modes: Modes, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write the modes of a scene, corrected by taps, as a table for `tail_beam.learned`."""
    return save_table(path, text_of_table(modes.columns), "a line for each mode of the scene, in its order", overwrite)


def save_table(path: str | Path, table: str, note: str, overwrite: bool) -> Path:
    """Write a table of modes, and what it is in a comment before it."""
    path = check_new(Path(path), "a table of modes", (".csv",), overwrite=overwrite)
    text = f"# Written by cgid tap: {note}; deviations are standard deviations of logarithms\n{table}"
    write_whole(path, text.encode(), overwrite=overwrite)
    return path


def tap_test(
    response: Floats,
    sampling_rate: float,
    *,
    hammer: Floats | None = None,
    quantity: str = "acceleration",
    band: tuple[float, float] | None = None,
    max_order: int = 24,
    contact: float = CONTACT,
    times: Sequence[float] | None = None,
    source: str = "signal",
    progress: Callable[[int], object] | None = None,
) -> TapTest:
    """Return the modes of a beam from a recording of hammer taps on it.

    Parameters
    ----------
    response : ndarray, (n_channels, n_samples)
        Motion of the beam in SI units.
    sampling_rate : float [Hz]
    hammer : ndarray, (n_samples,), optional
        Force of the hammer [N], in either direction.
    quantity : {"acceleration", "velocity", "displacement"}
        Of the response.
    band : tuple of float, optional [Hz]
        Lowest and highest natural frequency; by default five periods of a decay, and 0.4 of the sampling rate.
    max_order : int
        Maximum number of modes in each of the narrow bands that are fitted one by one.
    contact : float [s]
        Contact time of the hammer, if there is no hammer channel.
    times : sequence of float, optional [s]
        Use only the taps at these times.
    source : str
        Name of the recording in errors.
    progress : callable, optional
        Called with the percentage of the work done since the last call.

    Returns
    -------
    TapTest

    Raises
    ------
    InvalidValue
        A number breaks its rule.
    BadData
        There is no usable tap, or no mode after it; the message gives the reason.
    """
    quantity = validation.choice("quantity", quantity, tuple(DERIVATIVES))
    max_order = validation.count("max_order", max_order)
    contact = validation.number("contact", contact, "s", validation.not_negative)
    force, hits, delay = None, None, 0.0
    if hammer is not None:
        force, hits = hammer_force(hammer, sampling_rate, source)
        force, hits, delay = aligned(response, force, hits, sampling_rate, source)
    events = hits if hits is not None else events_in(response, sampling_rate, source, apart=times is None)
    taps = judged(response, sampling_rate, events, contact, times, source)
    while True:
        used = usable(taps, source)
        length = min(min(tap.stop - tap.start for tap in used), LONGEST)
        low, high = band_of(band, length / sampling_rate, sampling_rate, source)
        if force is not None and hits is not None:
            blows = blows_of(response[0], force, hits, used, sampling_rate, 0.0)
            if bad := disagreeing_at_first(blows, sampling_rate, (low, high)):
                taps = _without(taps, {used[k].time: one for k, one in bad.items()})
                continue
        decays = np.stack([row[tap.start : tap.start + length] for row in response for tap in used])
        with threadpool_limits(1, "blas"):  # the matrices are small: threads would wait for each other
            poles = poles_of(decays, sampling_rate, (low, high), max_order, progress)
        progress = None
        if not poles.pole.size:
            raise BadData(
                f"{source}: the decays must contain a mode, none is found between {low:.4g} and {high:.4g} Hz in "
                f"{counted(len(used), 'decay')} of {length / sampling_rate:.3g} s; tap harder, put the sensor where it "
                f"moves, or change {spelled('band')}"
            )
        if force is None or hits is None:
            participation, relative = _relative_participation(poles, len(used), DERIVATIVES[quantity])
            modes = _modes(poles.pole, participation, np.stack([*poles.deviation, relative]), scaled=False)
            response_modes, unexplained, measured = modes, None, None
            break
        pole = np.concatenate([poles.pole, lines_of((low, high))])
        blows = blows_of(response[0], force, hits, used, sampling_rate, RINGS / np.abs(pole.real).min())
        rest, alike = remaining_delay(poles, blows, used, sampling_rate, DERIVATIVES[quantity])
        gram = gram_of(blows, pole, sampling_rate, DERIVATIVES[quantity], (low, high), rest)
        if abs(rest) > 1 / sampling_rate:  # phases may be those of damping in places
            none = gram_of(blows, pole, sampling_rate, DERIVATIVES[quantity], (low, high))
            if none.left() < _CLEARLY * gram.left():
                gram, rest, alike = none, 0.0, np.ones(len(used), bool)
        if bad := disagreeing(gram):
            taps = _without(taps, {used[k].time: one for k, one in bad.items()})
            continue
        if not alike.all():
            raise BadData(
                f"{source}: the hammer's delay must be constant, the modes of {counted(int((~alike).sum()), 'tap')} "
                "show another one than the rest; record both on one device"
            )
        delay += rest
        fit = fitted(gram)
        deviation = np.zeros((3, pole.size))
        deviation[:2, : poles.pole.size] = poles.deviation
        deviation[2, fit.kept] = _relative_deviation(fit, poles, len(used))
        kept_modes = fit.kept[fit.kept < poles.pole.size]
        modes = _modes(pole[kept_modes], fit.value[: kept_modes.size], deviation[:, kept_modes], scaled=True)
        if poles.apart.size > poles.pole.size:
            more = np.concatenate([poles.apart, pole[poles.pole.size :]])
            wider = fitted(gram_of(blows, more, sampling_rate, DERIVATIVES[quantity], (low, high), rest))
            if wider.is_better_than(fit, gram.n_bins):
                fit, pole, deviation = wider, more, np.zeros((3, more.size))
                deviation[2] = 1.0
        # Rows may be large and cancel: then they are as wrong as the response is as a whole.
        deviation[2] = np.minimum(deviation[2], max(_AS_A_WHOLE * float(np.median(fit.unexplained)), EXACT))
        response_modes = _modes(pole[fit.kept], fit.value, deviation[:, fit.kept], scaled=True)
        response_modes = response_modes.taken(np.argsort(response_modes.frequency))
        poles, unexplained = poles.taken(kept_modes), fit.unexplained
        measured = partial(
            FrequencyResponse.of,
            blows,
            response_modes,
            sampling_rate,
            quantity,  # type: ignore[arg-type]
            (low, high),
            rest,
        )
        break
    return TapTest(
        modes=modes,
        taps=tuple(taps),
        duration=length / sampling_rate,
        band=(low, high),
        poles=poles,
        delay=delay,
        response=replace(response_modes, band=(low, high)) if hammer is not None else modes,
        unexplained=unexplained,
        measure=measured,
    )


def _without(taps: Sequence[Tap], bad: dict[float, tuple[float, float, float]]) -> list[Tap]:
    """Return the taps, those with a time in `bad` with a flaw, from what `disagreeing` says of them."""
    out = []
    for tap in taps:
        if tap.time in bad and not tap.flaw:
            left, others, factor = bad[tap.time]
            detail = f"{100 * left:.0f} % unexplained ({100 * others:.0f} % of others), {factor:.2g} times as large"
            tap = replace(tap, flaw=Flaw.UNEXPLAINED, detail=detail)
        out.append(tap)
    return out


def _modes(pole: Complexes, participation: Floats | Complexes, deviation: Floats, *, scaled: bool) -> Modes:
    modes = Modes(
        frequency=np.abs(pole) / (2 * np.pi),
        damping_ratio=-pole.real / np.abs(pole),
        at_impact=np.empty(0),
        deviation=deviation,
        scaled=scaled,
    )
    return modes.with_participation(participation)


def read_taps(path: str | Path) -> tuple[list[float] | None, Floats | None]:
    """Return times (n_taps,) [s] and places (n_taps, 2) [m] of a table of taps, None for what it lacks.

    It is a CSV file with the columns `time_s`, or `x_m` and `y_m`, or all three.
    """
    lines = read_cells(path, "the table of taps", _MAX_FILE_SIZE)
    titles = lines[0][1] if lines else []
    present = [name for name in _TAPS if name in titles]
    if not present or ("x_m" in present) != ("y_m" in present) or len(lines) < 2:
        raise BadData(
            f"{path}: a table of hammer taps must have the column time_s [s], for a roving hammer x_m and y_m [m], and "
            f"one line per tap, got {', '.join(present) or 'none of them'} and {len(lines[1:])} taps; add them"
        )
    out: list[list[float]] = []
    for number, cells in lines[1:]:
        row = []
        for name in present:
            cell = cells[titles.index(name)] if titles.index(name) < len(cells) else ""
            try:
                row.append(float(validation.not_negative(name, float(cell), _TAPS[name])))
            except ValueError:
                raise BadData(
                    f"{path}, line {number}: {name} must be a number of at least 0 {_TAPS[name]}, got {cell!r}"
                ) from None
        out.append(row)
    columns = dict(zip(present, np.array(out).T, strict=True))
    times = columns["time_s"].tolist() if "time_s" in columns else None
    return times, np.stack([columns["x_m"], columns["y_m"]], axis=1) if "x_m" in columns else None


# -- taps -------------------------------------------------------------------------------------------------


def events_in(
    response: Floats, sampling_rate: float, source: str, *, apart: bool = True, beats: list[Event] | None = None
) -> list[Event]:
    """Return the impacts detected by the sensors; those of taps must lie `apart`. `beats` gets what is left out."""
    ear, first = (
        Ear(sampling_rate, len(response), kind="vibration", joint=True, lines=False),
        round(_LOOK * sampling_rate),
    )
    events = ear.feed(response[:, :first]).events
    separation = np.median(np.diff([event.onset for event in events])) / sampling_rate if len(events) > 1 else np.inf
    if apart and separation < DOUBLE:
        raise BadData(
            f"{source}: taps must be at least {DOUBLE:g} s apart, better a second, got a median of {separation:.2g} s "
            f"between {counted(len(events), 'impact')}; record hammer taps with silence between them, or list the taps "
            f"in a table ({spelled('times')})"
        )
    events += ear.feed(response[:, first:]).events + ear.feed(None).events
    if not events:
        raise BadData(f"{source}: a recording of taps must contain one, {ear.why_silent()}")
    sudden = [event for event in events if _jump(response, event.onset, sampling_rate) > JUMP] or events
    if beats is not None:
        onsets = {event.onset for event in sudden}
        beats += [event for event in events if event.onset not in onsets]
    return sudden


def _jump(response: Floats, onset: int, sampling_rate: float) -> float:
    """Return by how much the second differences grow at an onset; beating modes are no impact."""
    n = max(round(_JUMP_TIME * sampling_rate), 4)
    bends = np.diff(response[:, max(onset - 2 * n, 0) : onset + n], n=2, axis=1)
    before, after = bends[:, : -n - n // 2], bends[:, -n:]
    if before.shape[1] < n // 4:
        return np.inf
    return float(np.max(np.sqrt(np.mean(after**2, axis=1) / np.maximum(np.mean(before**2, axis=1), 1e-300))))


def aligned(
    response: Floats, force: Floats, hits: list[Event], sampling_rate: float, source: str
) -> tuple[Floats, list[Event], float]:
    """Return the force and its impacts as the sensors' clock has them, to a millisecond, and how late they were [s]."""
    reach = round(LATEST * sampling_rate)
    late = []
    for hit in hits:
        first = max(hit.onset - reach, 0)
        late.append(starts_late(response[:, first : hit.onset + 2 * reach], hit.onset - first, sampling_rate))
    middle = float(np.median(late))
    if np.mean(np.abs(np.array(late) - middle) < _SAME_DELAY) < 0.5:
        raise BadData(
            f"{source}: the hammer's delay must be constant, the sensor begins {1e3 * min(late):.3g} to "
            f"{1e3 * max(late):.3g} ms after it; record both on one device"
        )
    count = round(middle * sampling_rate)
    if abs(middle) < _SAME_DELAY or (len(hits) == 1 and hits[0].onset < reach):
        return force, hits, 0.0
    moved = [replace(hit, onset=hit.onset + count, end=hit.end + count) for hit in hits if hit.onset + count >= 0]
    return shifted(force, count), moved, -count / sampling_rate


def remaining_delay(
    poles: Poles, blows: Sequence[Blow], taps: Sequence[Tap], sampling_rate: float, derivatives: int
) -> tuple[float, NDArray[np.bool_]]:
    """Return by how much the forces are late [s], from the phases of the modes, and which taps say so."""
    if poles.pole.size < _MIN_PHASES:
        return 0.0, np.ones(len(taps), bool)
    stretch = Stretch(
        pole=poles.pole,
        bins=np.empty(0, np.intp),
        n_samples=blows[0].response.size,
        sampling_rate=sampling_rate,
        derivatives=derivatives,
    )
    lead = max(round(_AFTER * sampling_rate), 2)
    ratio = []
    for amplitude, blow, tap in zip(poles.amplitude, blows, taps, strict=False):
        first = max(round(tap.time * sampling_rate) - lead, 0)
        state = stretch.states(blow.force, tap.start - first)
        for ago, force in blow.earlier:
            state = state + stretch.states(force, tap.start - first + ago)
        ratio.append(amplitude / residues(poles.pole, derivatives) / state)
    weight = np.abs(poles.amplitude[: len(taps)]) / np.sqrt(-poles.pole.real)
    delay, each, deviation = fine_delay(np.array(ratio), weight, poles.pole)
    return delay, are_alike(each, deviation, sampling_rate)


def hammer_force(hammer: Floats, sampling_rate: float, source: str) -> tuple[Floats, list[Event]]:
    """Return the force during impacts, 0 between them, and the impacts; raises `BadData` if there is none."""
    for sign in (1.0, -1.0):
        ear = Ear(sampling_rate, kind="pulse", factor=sign)
        hits = ear.feed(hammer[None]).events + ear.feed(None).events
        if hits and not ear.is_upside_down():
            break
    else:
        raise BadData(f"{source}: the hammer channel must contain a tap, {ear.why_silent(unit='N')}")
    peaks = np.array([np.max(sign * hammer[hit.onset : hit.end + 1], initial=0.0) for hit in hits])
    hits = [hit for hit, peak in zip(hits, peaks, strict=True) if peak >= _FLOOR * peaks.max()]
    baseline = np.median(hammer)
    force = np.zeros(hammer.size)
    lead = max(round(_AFTER * sampling_rate), 2)
    for hit in hits:
        part = slice(max(hit.onset - lead, 0), hit.end + lead)
        force[part] = sign * (hammer[part] - baseline)
    return force, hits


def judged(
    response: Floats,
    sampling_rate: float,
    events: list[Event],
    contact: float,
    times: Sequence[float] | None,
    source: str,
) -> list[Tap]:
    """Return the taps with their decays and flaws."""
    n = response.shape[1]
    limits = response.max(axis=1), response.min(axis=1)
    nexts = [event.onset for event in events[1:]] + [n]
    taps = []
    for event, following in zip(events, nexts, strict=True):
        known = event.pre_trigger is None  # a pulse of a hammer ends with its contact
        start = (event.end + round(_AFTER * sampling_rate)) if known else event.onset + round(contact * sampling_rate)
        stop = following - (round(_BEFORE_NEXT * sampling_rate) if following < n else 0)
        separation = (following - event.onset) / sampling_rate
        flaw, detail = None, ""
        if event.onset < 2 or (event.cut and event.onset < _BEFORE_NEXT * sampling_rate):
            flaw = Flaw.CUT_OFF
        elif following < n and separation < DOUBLE:
            flaw, detail = Flaw.DOUBLE, f"another impact follows after {1e3 * separation:.3g} ms"
        elif not known and event.overlapping and _alone(event, events):
            flaw, detail = Flaw.DOUBLE, "another impact follows within some milliseconds"
        elif is_clipped(response[:, event.onset : max(stop, event.onset + 1)], *limits) or (known and event.clipped):
            flaw = Flaw.CLIPPED
        taps.append(Tap(time=event.onset / sampling_rate, start=start, stop=stop, flaw=flaw, detail=detail))
    taps = _required(taps, times, source)
    return _long_enough(taps, sampling_rate, n)


def _alone(event: Event, events: list[Event]) -> bool:
    """Return whether the frame of an event contains no other, so that it can only overlap with a hidden impact."""
    reach = len(np.atleast_2d(event.samples)[0])
    return all(other is event or abs(other.onset - event.onset) > reach for other in events)


def is_clipped(part: Floats, highest: Floats, lowest: Floats) -> bool:
    """Return whether a channel (n_channels, n) stays at an extreme of the recording for three samples."""
    for row, top, bottom in zip(part, highest, lowest, strict=True):
        limit = _CLIPPED_SHARE * max(abs(top), abs(bottom))
        for extreme in (top, bottom):
            at = row == extreme
            if abs(extreme) >= limit and bool(np.any(at[2:] & at[1:-1] & at[:-2])):
                return True
    return False


def _required(taps: list[Tap], times: Sequence[float] | None, source: str) -> list[Tap]:
    """Return the taps, those not selected by the user with a flaw; raises `BadData` if a listed one is missing."""
    if times is None:
        return taps
    selected = set()
    for time in times:
        near = min(range(len(taps)), key=lambda k: abs(taps[k].time - time))
        if abs(taps[near].time - time) > NEAR:
            raise BadData(
                f"{source}: a tap must be within {NEAR:g} s of {time:g} s, the nearest is at "
                f"{taps[near].time:.4g} s; correct the table of taps"
            )
        selected.add(near)
    return [tap if k in selected or tap.flaw else replace(tap, flaw=Flaw.NOT_LISTED) for k, tap in enumerate(taps)]


def _long_enough(taps: list[Tap], sampling_rate: float, n: int) -> list[Tap]:
    """Return the taps, those with too short a decay with a flaw."""
    free = np.array([(tap.stop - tap.start) / sampling_rate for tap in taps if not tap.flaw])
    needed = max(SHORTEST, _MIN_PART * float(np.median(free))) if free.size else SHORTEST
    out = []
    for tap in taps:
        duration = max(tap.stop - tap.start, 0) / sampling_rate
        if not tap.flaw and duration < needed:
            flaw = Flaw.BEFORE_END if tap.stop == n else Flaw.BEFORE_NEXT
            tap = replace(tap, flaw=flaw, detail=f"{duration:.3g} s where {needed:.3g} s are needed")
        out.append(tap)
    return out


def usable(taps: Sequence[Tap], source: str) -> list[Tap]:
    """Return the taps without a flaw; raises `BadData` if there is none."""
    used = [tap for tap in taps if not tap.flaw]
    if not used:
        raise BadData(f"{source}: at least one tap must be usable, of {_listed(taps)}; {_cures(taps)}")
    return used


def _listed(taps: Sequence[Tap]) -> str:
    """Return the number of taps, none of them usable, and of each flaw."""
    reasons = ", ".join(f"{number} {flaw}" for flaw, number in Counter(tap.flaw for tap in taps).items())
    return f"{counted(len(taps), 'tap')}: {reasons}"


def _cures(taps: Sequence[Tap]) -> str:
    """Return what to do about the flaws."""
    return "; ".join(_CURES[flaw] for flaw in dict.fromkeys(tap.flaw for tap in taps) if flaw is not None)


def band_of(
    band: tuple[float, float] | None, duration: float, sampling_rate: float, source: str
) -> tuple[float, float]:
    """Return the range of natural frequencies [Hz]."""
    least, max_frequency = _PERIODS / duration, 0.49 * sampling_rate
    if band is None:
        return least, _HIGHEST * sampling_rate
    low, high = band
    if not low < high:
        raise InvalidValue(f"band must be two ascending frequencies, got {low:g} and {high:g} Hz")
    if low < 1 / duration or high > max_frequency:
        raise BadData(
            f"{source}: band must be between one period of the decays ({1 / duration:.3g} Hz) and 0.49 of the sampling "
            f"rate ({max_frequency:.5g} Hz), got {low:g} to {high:g} Hz; leave more time between taps, or change "
            f"{spelled('band')}"
        )
    return low, high


# -- participation ----------------------------------------------------------------------------------------


def _relative_participation(poles: Poles, n_taps: int, derivatives: int) -> tuple[Floats, Floats]:
    """Return the relative sizes of modes from taps of unknown strength, and their relative deviations, (n_modes,)."""
    # Of q'' + 2 z w q' + w^2 q = p f: the decay is p Re(s^d F(s) exp(s t) / (j Im s)).
    unit = residues(poles.pole, derivatives)
    amplitude = np.abs(poles.amplitude[:n_taps] / unit)
    noise, shared = poles.amplitude_deviation[:, :n_taps] / np.abs(unit)
    strength = amplitude[:, int(np.argmax(amplitude.sum(axis=0)))][:, None]
    return _averaged(amplitude / strength, np.broadcast_to(strength, amplitude.shape), noise, shared)


def blows_of(
    response: Floats,
    force: Floats,
    hits: Sequence[Event],
    taps: Sequence[Tap],
    sampling_rate: float,
    reach: float,
) -> list[Blow]:
    """Return the force of each tap, those up to `reach` [s] before it, and the vibration from its start."""
    lead = max(round(_AFTER * sampling_rate), 2)
    parts = {round(hit.onset): slice(max(hit.onset - lead, 0), min(hit.end + lead, force.size)) for hit in hits}
    own = [parts[round(tap.time * sampling_rate)] for tap in taps]
    length = min(min(tap.stop - part.start for tap, part in zip(taps, own, strict=True)), LONGEST)
    return [
        Blow(
            response=response[part.start : part.start + length],
            force=force[part],
            earlier=[
                (part.start - other.start, force[other])
                for other in parts.values()
                if 0 < part.start - other.start < reach * sampling_rate
            ],
        )
        for part in own
    ]


def _relative_deviation(fit: Participations, poles: Poles, n_taps: int) -> Floats:
    """Return the relative standard deviations of participations, including what the poles' errors add, (n_kept,)."""
    relative = fit.deviation / np.maximum(np.abs(fit.value), 1e-300)
    of_poles = poles.amplitude_deviation[1, :n_taps] / np.maximum(np.abs(poles.amplitude[:n_taps]), 1e-300)
    shared = np.append(np.median(of_poles, axis=0), np.zeros(fit.kept.max() + 1))
    return np.asarray(np.minimum(np.hypot(relative, shared[fit.kept]), 1.0))


def _averaged(each: Floats, strength: Floats, noise: Floats, shared: Floats) -> tuple[Floats, Floats]:
    """Return the mean over taps (n_taps, n_modes) weighted by strength, and its relative standard deviation."""
    # `noise` is that of each tap, `shared` common to all taps; the scatter between taps replaces them if larger.
    n_taps, total = len(each), np.square(strength).sum(axis=0)
    mean = np.sum(np.square(strength) * each, axis=0) / total
    std = np.sqrt(np.square(noise * strength).sum(axis=0)) / total
    if n_taps > 1:
        off = np.square(np.square(strength) * (each - mean)).sum(axis=0)
        std = np.maximum(std, np.sqrt(n_taps / (n_taps - 1) * off) / total)
    std = np.hypot(std, np.sum(shared * strength, axis=0) / total)
    return mean, np.minimum(std / np.maximum(np.abs(mean), 1e-300), 1.0)


def factor_of(unit: str, source: str) -> tuple[str, float]:
    """Return quantity and factor to SI of a response's unit; raises `BadData` if it is not of motion."""
    quantity = quantity_of(unit)
    if quantity not in DERIVATIVES:
        cure = f"choose with {spelled('channel')}, and name the channel of the force with {spelled('hammer')}"
        raise BadData(
            f"{source}: the response must be an acceleration, velocity or displacement, got {quantity} [{unit}]; "
            + (f"give {spelled('full_scale', '500 g')}" if quantity == "level" else cure)
        )
    return quantity, UNITS[quantity][unit]
