"""On-site calibration: fit the gain or the modes of a scene to a tap test or to drops of known mass."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.scene.calibration_blow import Blow, PreparedBlow, prepared
from cgid.scene.calibration_fit import MOST_MODES, NOTHING_LEFT, Fit, Ringing, columns, fitted, ringing_modes
from cgid.scene.impacts import beam_modes
from cgid.scene.schema import Scene, load_scene, parse_scene
from cgid.scene.sections import TailBeamSection
from cgid.validation import Floats

#: Without an anti-alias filter or a bandwidth, modes are sought up to this share of the sampling rate.
_HEARD = 0.45
#: Fewest samples of free ringing, for each mode and in total.
_SAMPLES_A_MODE, _LEAST_SAMPLES = 8, 64
#: Modes sought in addition, so that one that stands for two others displaces none.
_SPARE = 2
#: Searches of the residual, and modes that each may add.
_ROUNDS, _MODES_A_ROUND = 3, 2
#: A blow that explains less of the motion did not cause it.
_LEAST_EXPLAINED = 0.02


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """A calibrated scene and the quality of the fit.

    Attributes
    ----------
    scene : Scene
        With `sensor.gain`, or with the fitted modes in `tail_beam.modes`.
    gain : float
        Recorded over synthesised; 1 for fitted modes, whose participation includes it.
    explained : ndarray, (n_blows,)
        Share of each recording's energy about its mean that the scene explains.
    delays : ndarray, (n_blows,)
        For a hammer, delay of the motion's channel to the force's; for a drop, time of touch in the recording [s].
    """

    scene: Scene
    gain: float
    explained: Floats
    delays: Floats


def calibrated(
    scene: Scene | str | Path,
    blows: Sequence[Blow],
    *,
    modes: int | None = None,
    band: tuple[float, float] | None = None,
) -> Calibration:
    """Fit the gain or the modes of a scene to recorded blows: a tap test, or drops of known mass.

    Without `modes` and `band` only `sensor.gain` is fitted: the factor between the recordings and the synthesised
    motion of the same blows, by least squares over all samples. Each recording is scaled by its largest sample, so all
    have the same weight. Offsets and delays are fitted as well. Noise in a hammer's channel biases the gain: by some
    0.7 % per blow where it is 1 % of the peak of a contact of 5 to 10 samples.

    With `modes` or `band` the modes are fitted. Initial poles come from the free ringing of all blows together. Least
    squares over the whole recordings, including contact and sensor chain, then give frequencies, damping ratios, delays
    and real participations. All blows must fall on one point.

    Such blows determine only the participation `shape_impact shape_sensor / modal_mass`. It is stored as `shape_impact`
    1, `shape_sensor` 1 or -1 and `modal_mass` the inverse of its size. Signals of taps do not depend on this split, but
    the compliance of the beam under a rock does: it follows `shape_impact^2 / modal_mass`, here the size of the
    participation. This is right for blows next to the sensor. Elsewhere it assumes the compliance at the sensor: on
    average over modes as good a guess as any, but too stiff for a mode with a node near the sensor. With blows at both
    points, take the masses from those at the impact point and adjust `shape_sensor` to keep the participation. A scale
    error of the recorder changes the masses by its factor.

    Parameters
    ----------
    scene : Scene, str or Path
        With a beam and a sensor of motion: that of the recordings except for the gain.
    blows : sequence of Blow
    modes : int, optional
        Number of modes, the loudest ones. Omitted modes shift those near them.
    band : tuple of float, optional
        Frequency range of the modes to keep [Hz]; without `modes` all that stand out of the noise.

    Returns
    -------
    Calibration

    Raises
    ------
    InvalidValue
        No blows, blows on several points for modes, or a quantity, rate or band that does not fit the scene.
    BadData
        A recording is too short, too noisy, clipped or starts too late, or the blows do not explain it.

    Examples
    --------
    A tap test with an instrumented hammer, simulated with a scene of two modes and its force:

    >>> from cgid.scene import Blow, calibrated, load_scene, parse_scene, synthesise, varied
    >>> from cgid.signals import Signal
    >>> mode = {"damping_ratio": 0.02, "modal_mass": "300 kg", "shape_impact": 0.8, "shape_sensor": 0.6}
    >>> beam = parse_scene(
    ...     {
    ...         "name": "beam",
    ...         "impact": {"stiffness": "hertz", "dissipation": "elastic", "target": {"youngs_modulus": "210 GPa"}
    ...             | {"poisson_ratio": 0.3}},
    ...         "tail_beam": {"modes": [mode | {"frequency": "150 Hz"}, mode | {"frequency": "410 Hz"}]},
    ...         "sampling": {"sampling_rate": "10 kHz", "samples": 1500, "pre_trigger": 100},
    ...         "sensor": {"quantity": "acceleration", "anti_alias": {"frequency": "4 kHz"}, "relative_noise": "1 %"},
    ...         "taps": [{"label": "hammer", "shape": "haversine", "peak_force": "2 kN", "contact_duration": "1 ms"}],
    ...     }
    ... )
    >>> taps = {}
    >>> for unit, rig in {"m/s^2": beam, "N": varied(beam, quantity="force")}.items():
    ...     batch = next(synthesise(rig, 3, seed=1))
    ...     taps[unit] = [Signal(samples=row, sampling_rate=10e3, unit=unit) for row in batch.signals]
    >>> blows = [Blow(motion=motion, force=force) for motion, force in zip(taps["m/s^2"], taps["N"])]
    >>> found = calibrated(beam, blows, modes=2)
    >>> for row in found.scene.tail_beam.modes:
    ...     print(f"{row.frequency:.0f} Hz, {row.damping_ratio:.3f}, {1e3 * row.shape_sensor / row.modal_mass:.1f}/t")
    150 Hz, 0.020, 1.6/t
    410 Hz, 0.020, 1.6/t
    >>> bool((found.explained > 0.98).all())
    True
    """
    scene = load_scene(scene)
    blows = _checked(scene, blows)
    if modes is not None:
        validation.count("modes", modes)
    _require_band(scene, band)
    struck = [prepared(scene, blow) for blow in blows]
    # Many small matrices: more threads would only wait for each other.
    with threadpool_limits(1):
        if modes is None and band is None:
            return _with_gain(scene, blows, struck)
        return _with_modes(scene, blows, struck, modes, band)


def _checked(scene: Scene, blows: Sequence[Blow]) -> list[Blow]:
    blows = list(blows)
    if not blows:
        raise InvalidValue("blows must be at least 1, got none")
    for blow in blows:
        if not isinstance(blow, Blow):
            raise InvalidValue(f"blows must be of Blow, got {type(blow).__name__}")
    if scene.sensor.quantity == "force":
        raise InvalidValue(
            f"scene {scene.name} must have a sensor of motion on a tail beam to be calibrated, its sensor feels force"
        )
    return blows


def _highest(scene: Scene) -> float:
    """Return the highest frequency that the recorder passes [Hz]."""
    sensor = scene.sensor
    edges = [_HEARD * scene.sampling.sampling_rate]
    edges += [] if sensor.anti_alias is None else [sensor.anti_alias.frequency]
    edges += [] if sensor.bandwidth is None else [sensor.bandwidth]
    return min(edges)


def _require_band(scene: Scene, band: tuple[float, float] | None) -> None:
    if band is None:
        return
    edges = validation.not_negative("band", band, "Hz")
    if edges.shape != (2,) or not edges[0] < min(edges[1], _highest(scene)):
        raise InvalidValue(
            f"band must be a lower and a higher frequency and begin below {_highest(scene):g} Hz, up to where the "
            f"recorder of scene {scene.name} hears, got {band!r}"
        )


def _with_gain(scene: Scene, blows: list[Blow], struck: list[PreparedBlow]) -> Calibration:
    assert scene.tail_beam is not None
    points = np.array([_point(scene.tail_beam, blow) for blow in blows])
    heard = beam_modes(scene)
    rows = heard.participation({"impact_x": points[:, 0], "impact_y": points[:, 1]})
    fit = fitted(scene, struck, heard, list(rows[:, None]))
    gain = float(fit.amounts[0])
    found = _changed(scene, {"gain": gain}, None)
    return _calibration(found, gain, blows, struck, fit.delays, fit.remains)


def _point(beam: TailBeamSection, blow: Blow) -> tuple[float, float]:
    """Return the point of a blow; measured modes have only one."""
    if blow.impact_point is not None:
        place = blow.impact_point
        for axis, at, size in (("x", place[0], beam.length), ("y", place[1], beam.width)):
            if size is not None and not 0 <= at <= size:
                raise InvalidValue(f"impact_point must lie on the beam, {axis} between 0 and {size:g} m, got {at:g} m")
        return place
    if beam.impact_point is None:
        return (0.0, 0.0)
    extremes = [getattr(beam.impact_point, axis).extremes for axis in ("x", "y")]
    if any(low != high for low, high in extremes):
        raise InvalidValue(
            f"{blow.motion.name}: impact_point must be given, the scene's rocks fall on more than one place"
        )
    return extremes[0][0], extremes[1][0]


def _with_modes(
    scene: Scene, blows: list[Blow], struck: list[PreparedBlow], n_modes: int | None, band: tuple[float, float] | None
) -> Calibration:
    if len({blow.impact_point for blow in blows}) > 1:
        raise InvalidValue("impact_point must be the same for all blows where modes are measured; calibrate each place")
    # Modes outside the band are fitted as well, so that they do not disturb those inside.
    fit = _identified(scene, struck, n_modes if band is None else None)
    kept = _kept(fit, n_modes, band)
    each = np.eye(fit.amounts.size)
    remains = [
        blow.samples - fit.amounts[kept] @ columns(scene, blow, fit.modes, each[kept], np.array([delay]))[0]
        for blow, delay in zip(struck, fit.delays, strict=True)
    ]
    rows = [
        {
            "frequency": float(fit.modes.frequency[mode]),
            "damping_ratio": float(fit.modes.damping_ratio[mode]),
            "modal_mass": float(1 / abs(fit.amounts[mode])),
            "shape_impact": 1.0,
            "shape_sensor": float(np.sign(fit.amounts[mode])),
        }
        for mode in kept
    ]
    return _calibration(_changed(scene, {"gain": None}, rows), 1.0, blows, struck, fit.delays, remains)


def _identified(scene: Scene, struck: list[PreparedBlow], n_modes: int | None) -> Fit:
    """Return the least-squares fit of this many modes, or of all that stand out of the noise.

    Close modes look like one at first, so the residual is searched again.
    """
    _require_length(scene, struck, n_modes)
    most = MOST_MODES if n_modes is None else n_modes + _SPARE
    first = _ringing(scene, struck, [blow.samples for blow in struck], most)
    if not first.frequency.size:
        raise BadData("recordings must ring after the blows, no mode stands out of the noise; tap harder or more often")
    fit = fitted(scene, struck, first)
    before = sum(float((blow.samples**2).sum()) for blow in struck)
    for _ in range(_ROUNDS):
        known = fit.only(fit.significant)
        missing = most - known.frequency.size
        if not missing or fit.energy < NOTHING_LEFT * before:
            break
        more = _ringing(scene, struck, fit.remains, min(missing, _MODES_A_ROUND))
        if not more.frequency.size:
            break
        fit = fitted(scene, struck, known.joined(more), delays=fit.delays)
    return fit if fit.significant.all() else fitted(scene, struck, fit.only(fit.significant), delays=fit.delays)


def _require_length(scene: Scene, struck: list[PreparedBlow], n_modes: int | None) -> None:
    shortest = min(blow.samples.size - blow.decay for blow in struck)
    needed = max(_LEAST_SAMPLES, _SAMPLES_A_MODE * (n_modes or 1))
    if shortest < needed:
        raise BadData(
            f"recordings must ring freely for {needed} samples after the blow, "
            f"{1e3 * needed / scene.sampling.sampling_rate:.3g} ms, for this many modes, got {max(shortest, 0)}; "
            "record longer, or ask for fewer modes"
        )


def _ringing(scene: Scene, struck: list[PreparedBlow], samples: list[Floats], most: int) -> Ringing:
    """Return a first guess of the modes in recordings or residuals."""
    decays = [part[blow.decay :] for part, blow in zip(samples, struck, strict=True)]
    filters = np.concatenate([np.empty(0, complex), *(part.poles for part in scene.sensor.filters)])
    return ringing_modes(decays, scene.sampling.sampling_rate, most, _highest(scene), filters)


def _kept(fit: Fit, n_modes: int | None, band: tuple[float, float] | None) -> list[int]:
    """Return the indices of the modes that explain most, in order of frequency."""
    low, high = band or (0.0, np.inf)
    frequency = fit.modes.frequency
    inside = np.flatnonzero((frequency >= low) & (frequency <= high) & (fit.amounts != 0))
    if inside.size < (n_modes or 1):
        where = "" if band is None else f" from {low:g} to {high:g} Hz"
        raise BadData(
            f"recordings must be quiet and long enough for the modes asked for, {n_modes or 'at least 1'}{where}: only "
            f"{inside.size} stand out of the noise; ask for fewer, tap harder or more often"
        )
    loudest = inside[np.argsort(-fit.losses[inside], kind="stable")][:n_modes]
    return [int(mode) for mode in loudest[np.argsort(frequency[loudest])]]


def _changed(scene: Scene, sensor: dict[str, Any], modes: list[dict[str, float]] | None) -> Scene:
    content = json.loads(scene.text)
    content["sensor"] = {key: value for key, value in (content["sensor"] | sensor).items() if value is not None}
    if modes is not None:
        coupling = content["tail_beam"].get("coupling", "auto")
        content["tail_beam"] = {"modes": modes, "coupling": "auto" if coupling == "impedance" else coupling}
    return parse_scene(content, source=f"calibration of {scene.name}")


def _calibration(
    scene: Scene, gain: float, blows: list[Blow], struck: list[PreparedBlow], delays: Floats, remains: list[Floats]
) -> Calibration:
    energies = [
        (float((rest**2).sum()), float((blow.samples**2).sum())) for rest, blow in zip(remains, struck, strict=True)
    ]
    explained = np.array([1 - rest / whole for rest, whole in energies])
    worst = int(np.argmin(explained))
    if explained[worst] < _LEAST_EXPLAINED:
        raise BadData(
            f"{blows[worst].motion.name}: motion must come from the blow, which explains "
            f"{100 * explained[worst]:.1f} % of it; check that force and motion are of one blow, and where it fell"
        )
    seen = [0.0 if blow.force is not None else cut.first + cut.onset for blow, cut in zip(blows, struck, strict=True)]
    delays = (delays + seen) / scene.sampling.sampling_rate
    return Calibration(scene=scene, gain=gain, explained=explained, delays=delays)
