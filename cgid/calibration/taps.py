"""A tap test: hammer taps on a beam, recorded by an accelerometer on it, and the modes in the decay after them.

From the end of an impact to the next tap the recording is a free decay; `poles` finds the modes in all decays together.
With an instrumented hammer, the participation of a mode, `shape(tap) shape(sensor) / modal mass`, is its amplitude over
the Laplace transform of the force at its pole: the estimate H1 at the pole, without windows or leakage.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from cgid._lib import validation
from cgid._lib.files import check_new, read_cells, write_whole
from cgid._lib.terminal import counted
from cgid._lib.validation import Floats
from cgid.calibration.poles import Complexes, Poles, poles_of
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection.detector import ImpactDetector
from cgid.identification.detection.events import Event
from cgid.measure.modal.modes import Modes, residues, text_of_table
from cgid.physics.structure.response import DERIVATIVES
from cgid.units import UNITS, quantity_of

#: Contact time of a hammer without a hammer channel, and the ringing of its filter after the force has ended [s].
CONTACT, _AFTER = 2e-3, 0.5e-3
#: A tap ends this long before the onset of the next [s], since an onset may be detected late.
_BEFORE_NEXT = 1e-3
#: An impact makes the second differences of a response grow this many times within this time [s].
_JUMP, _JUMP_TIME = 3.0, 2e-3
#: Two impacts within this time are a double tap [s].
DOUBLE = 0.1
#: Minimum length of a decay [s], and relative to the median one.
SHORTEST, _MIN_PART = 30e-3, 0.5
#: Maximum length of a decay [samples].
_LONGEST = 1 << 18
#: A clipped response stays at its extreme for three samples, at least at this fraction of the largest deviation.
_CLIPPED_SHARE = 0.5
#: Time within which a recording must show taps [s].
_LOOK = 60.0
#: Listed and detected taps match within this time [s].
_NEAR = 0.1
#: Lowest natural frequency in periods of a decay, highest in sampling rates.
_PERIODS, _HIGHEST = 5.0, 0.4
#: Minimum participation, so that masses are finite.
_LEAST = 1e-12
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
    """

    modes: Modes
    taps: tuple[Tap, ...]
    duration: float
    band: tuple[float, float]
    poles: Poles

    @property
    def used(self) -> list[Tap]:
        """The taps with used decays."""
        return [tap for tap in self.taps if not tap.flaw]

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the modes as a table for `tail_beam.modes` of a scene, and `tail_beam.learned` next to it.

        Only the participation is known. The shapes are 1 and 1 or -1, and the modal mass is the inverse of its size:
        correct for taps next to the sensor, elsewhere a guess of the beam's compliance.
        """
        participation = self.modes.participation()
        learned = self.modes.columns | {"participation": np.ones_like(participation)}
        columns = {
            "frequency": self.modes.frequency,
            "damping_ratio": self.modes.damping_ratio,
            "modal_mass": 1 / np.maximum(np.abs(participation), _LEAST),
            "shape_impact": np.ones_like(participation),
            "shape_sensor": np.copysign(1.0, participation),
            **learned,
        }
        scale = "in 1/kg" if self.modes.scaled else "without a hammer over the largest: masses have no scale"
        return _save(path, columns, f"shape_impact shape_sensor / modal_mass is the participation, {scale}", overwrite)


def save_learned(modes: Modes, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write the modes of a scene, corrected by taps, as a table for `tail_beam.learned`."""
    return _save(path, modes.columns, "a line for each mode of the scene, in its order", overwrite)


def _save(path: str | Path, columns: dict[str, Floats], note: str, overwrite: bool) -> Path:
    path = check_new(Path(path), "a table of modes", (".csv",), overwrite=overwrite)
    text = f"# Written by cgid tap: {note}; deviations are standard deviations of logarithms\n{text_of_table(columns)}"
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
    force, hits = None, None
    if hammer is not None:
        force, hits = _force(hammer, sampling_rate, source)
    events = hits if hits is not None else _events(response, sampling_rate, times is None, source)
    taps = _judged(response, sampling_rate, events, contact, times, source)
    used = [tap for tap in taps if not tap.flaw]
    if not used:
        raise BadData(f"{source}: at least one tap must be usable, of {_listed(taps)}; {_cures(taps)}")
    length = min(min(tap.stop - tap.start for tap in used), _LONGEST)
    low, high = _band(band, length / sampling_rate, sampling_rate, source)
    decays = np.stack([row[tap.start : tap.start + length] for row in response for tap in used])
    poles = poles_of(decays, sampling_rate, (low, high), max_order, progress)
    if not poles.pole.size:
        raise BadData(
            f"{source}: the decays must contain a mode, none is found between {low:.4g} and {high:.4g} Hz in "
            f"{counted(len(used), 'decay')} of {length / sampling_rate:.3g} s; tap harder, put the sensor where it "
            "moves, or change --band"
        )
    participation, participation_std = _participation(poles, used, force, hits, sampling_rate, DERIVATIVES[quantity])
    root = np.sqrt(np.abs(participation))
    return TapTest(
        modes=Modes(
            frequency=poles.frequency,
            damping_ratio=poles.damping_ratio,
            at_impact=root,
            at_sensor=np.copysign(root, participation),
            deviation=np.stack([*poles.deviation, participation_std]),
            scaled=force is not None,
        ),
        taps=tuple(taps),
        duration=length / sampling_rate,
        band=(low, high),
        poles=poles,
    )


def read_times(path: str | Path) -> list[float]:
    """Return the times [s] of a table of taps: a CSV file with a column `time_s`."""
    lines = read_cells(path, "the table of taps", _MAX_FILE_SIZE)
    titles = lines[0][1] if lines else []
    if "time_s" not in titles or len(lines) < 2:
        raise BadData(f"{path}: a table of hammer taps must have the column time_s [s] and one line per tap; add them")
    column, out = titles.index("time_s"), []
    for number, cells in lines[1:]:
        cell = cells[column] if column < len(cells) else ""
        try:
            out.append(float(validation.not_negative("time", float(cell), "s")))
        except ValueError:
            raise BadData(f"{path}, line {number}: time must be a number of at least 0 s, got {cell!r}") from None
    return out


# -- taps -------------------------------------------------------------------------------------------------


def _events(response: Floats, sampling_rate: float, every: bool, source: str) -> list[Event]:
    """Return the impacts detected by the sensors."""
    detector = ImpactDetector(sampling_rate, len(response), kind="vibration", joint=True)
    first = round(_LOOK * sampling_rate)
    events = detector.feed(response[:, :first])
    separation = np.median(np.diff([event.onset for event in events])) / sampling_rate if len(events) > 1 else np.inf
    if every and separation < DOUBLE:
        raise BadData(
            f"{source}: taps must be at least {DOUBLE:g} s apart, better a second, got a median of {separation:.2g} s "
            f"between {counted(len(events), 'impact')}; record hammer taps with silence between them, or list the taps "
            "in a table (--taps)"
        )
    events += detector.feed(response[:, first:]) + detector.finish()
    if not events:
        raise BadData(f"{source}: a recording of taps must contain one, {detector.why_silent()}")
    return [event for event in events if _jump(response, event.onset, sampling_rate) > _JUMP] or events


def _jump(response: Floats, onset: int, sampling_rate: float) -> float:
    """Return by how much the second differences grow at an onset; beating modes are no impact."""
    n = max(round(_JUMP_TIME * sampling_rate), 4)
    bends = np.diff(response[:, max(onset - 2 * n, 0) : onset + n], n=2, axis=1)
    before, after = bends[:, : -n - n // 2], bends[:, -n:]
    if before.shape[1] < n // 4:
        return np.inf
    return float(np.max(np.sqrt(np.mean(after**2, axis=1) / np.maximum(np.mean(before**2, axis=1), 1e-300))))


def _force(hammer: Floats, sampling_rate: float, source: str) -> tuple[Floats, list[Event]]:
    """Return the force during impacts, 0 between them, and the impacts; raises `BadData` if there is none."""
    for sign in (1.0, -1.0):
        detector = ImpactDetector(sampling_rate, kind="pulse")
        hits = detector.feed(sign * hammer) + detector.finish()
        if hits and not detector.is_upside_down():
            break
    else:
        raise BadData(f"{source}: the hammer channel must contain a tap, {detector.why_silent(unit='N')}")
    baseline = np.median(hammer)
    force = np.zeros(hammer.size)
    lead = max(round(_AFTER * sampling_rate), 2)
    for hit in hits:
        part = slice(max(hit.onset - lead, 0), hit.end + lead)
        force[part] = sign * (hammer[part] - baseline)
    return force, hits


def _judged(
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
        elif _is_clipped(response[:, event.onset : max(stop, event.onset + 1)], *limits) or (known and event.clipped):
            flaw = Flaw.CLIPPED
        taps.append(Tap(time=event.onset / sampling_rate, start=start, stop=stop, flaw=flaw, detail=detail))
    taps = _required(taps, times, source)
    return _long_enough(taps, sampling_rate, n)


def _alone(event: Event, events: list[Event]) -> bool:
    """Return whether the frame of an event contains no other, so that it can only overlap with a hidden impact."""
    reach = len(np.atleast_2d(event.samples)[0])
    return all(other is event or abs(other.onset - event.onset) > reach for other in events)


def _is_clipped(part: Floats, highest: Floats, lowest: Floats) -> bool:
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
        if abs(taps[near].time - time) > _NEAR:
            raise BadData(
                f"{source}: a tap must be within {_NEAR:g} s of {time:g} s, the nearest is at "
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


def _listed(taps: Sequence[Tap]) -> str:
    """Return the number of taps, none of them usable, and of each flaw."""
    reasons = ", ".join(f"{number} {flaw}" for flaw, number in Counter(tap.flaw for tap in taps).items())
    return f"{counted(len(taps), 'tap')}: {reasons}"


def _cures(taps: Sequence[Tap]) -> str:
    """Return what to do about the flaws."""
    return "; ".join(_CURES[flaw] for flaw in dict.fromkeys(tap.flaw for tap in taps) if flaw is not None)


def _band(band: tuple[float, float] | None, duration: float, sampling_rate: float, source: str) -> tuple[float, float]:
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
            f"rate ({max_frequency:.5g} Hz), got {low:g} to {high:g} Hz; leave more time between taps, or change --band"
        )
    return low, high


# -- participation ----------------------------------------------------------------------------------------


def _participation(
    poles: Poles,
    taps: Sequence[Tap],
    force: Floats | None,
    hits: Sequence[Event] | None,
    sampling_rate: float,
    derivatives: int,
) -> tuple[Floats, Floats]:
    """Return the participations at the first sensor and the standard deviations of their logarithms, (n_modes,)."""
    n_taps, pole = len(taps), poles.pole
    # Of q'' + 2 z w q' + w^2 q = p f: the decay is p Re(s^d F(s) exp(s t) / (j Im s)).
    unit = residues(pole, derivatives)
    amplitude = poles.amplitude[:n_taps] / unit
    noise, shared = poles.amplitude_deviation[:, :n_taps] / np.abs(unit)
    if force is None or hits is None:
        return _relative(np.abs(amplitude), noise, shared)
    transform = np.stack([_transform(force, hits, pole, tap, sampling_rate) for tap in taps])
    # Noise has any phase, and half of its power is along the amplitude.
    return _averaged((amplitude / transform).real, np.abs(transform), noise / np.sqrt(2), shared / np.sqrt(2))


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


def _transform(force: Floats, hits: Sequence[Event], pole: Complexes, tap: Tap, sampling_rate: float) -> Complexes:
    """Return the Laplace transforms at the poles of the force before a decay, from its first sample on, (n_modes,)."""
    out, lead = np.zeros(pole.size, complex), max(round(_AFTER * sampling_rate), 2)
    for hit in hits:
        part = np.arange(max(hit.onset - lead, 0), min(hit.end + lead, force.size))
        ago = (tap.start - part[-1]) / sampling_rate
        if hit.onset < tap.start and ago * np.abs(pole.real).min(initial=0.0) < 50:
            ago_each = (tap.start - part) / sampling_rate
            out += np.exp(ago_each[:, None] * pole).T @ force[part] / sampling_rate
    return out


def _relative(amplitude: Floats, noise: Floats, shared: Floats) -> tuple[Floats, Floats]:
    """Return the relative sizes of modes from taps of unknown strength, and their standard deviations."""
    strength = amplitude[:, int(np.argmax(amplitude.sum(axis=0)))][:, None]
    return _averaged(amplitude / strength, np.broadcast_to(strength, amplitude.shape), noise, shared)


def factor_of(unit: str, source: str) -> tuple[str, float]:
    """Return quantity and factor to SI of a response's unit; raises `BadData` if it is not of motion."""
    quantity = quantity_of(unit)
    if quantity not in DERIVATIVES:
        raise BadData(
            f"{source}: the response must be an acceleration, velocity or displacement, got {quantity} [{unit}]; "
            "choose with --channel, and name the channel of the force with --hammer"
        )
    return quantity, UNITS[quantity][unit]
