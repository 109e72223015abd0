"""What the sensor gives of the impacts of a recording, before noise: forces, or what rings after them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cgid.elementary import log
from cgid.physics import Impact
from cgid.physics.coupled import ModalImpact
from cgid.scene._fourier import transformable
from cgid.scene.background_noise import Background
from cgid.scene.impacts import impact_of, impacts_by_coupling
from cgid.scene.range_warnings import unwarned
from cgid.scene.response import TOLERANCE, Hearing
from cgid.scene.scene import Scene
from cgid.scene.stream.axis import TimeAxis, samples_of
from cgid.scene.stream.rocks import Rocks
from cgid.scene.stream.truth import DELIVERED
from cgid.validation import Floats

#: The low-pass of a pulse is followed for so many periods of its edge to either side; what is left of it there is
#: under 1e-5 of the peak (`tests/test_stream.py`).
_FILTER_PERIODS = 64


def strike(scene: Scene, axis: TimeAxis, rocks: Rocks, heard: Hearing | None) -> dict[str, Floats]:
    """Add what the sensor gives of the impacts of some rocks to the time axis, and return what they deliver.

    What overlaps adds up. heard is what responds to the forces, None where the sensor has them as they are.

    Returns
    -------
    dict of ndarray, each (n,)
        `DELIVERED`: restitution, peak force [N], contact duration [s].
    """
    delivered = {name: np.empty(len(rocks)) for name in DELIVERED}
    if not len(rocks):
        return delivered
    everyone = np.arange(len(rocks))
    with unwarned():
        impact = impact_of(scene, rocks.columns, everyone)
        parts = list(impacts_by_coupling(scene, impact, rocks.columns, everyone))
    for rows, pulses, _ in parts:
        own = rocks.taken(rows)
        if heard is None:
            _add_forces(scene, axis, pulses, own["time"])
        else:
            _add_response(scene, axis, heard, pulses, own.columns)
        for name in DELIVERED:
            delivered[name][rows] = getattr(pulses, name)
    return delivered


def _add_forces(scene: Scene, axis: TimeAxis, pulses: Impact | ModalImpact, times: Floats) -> None:
    rate, guard = scene.sampling.sampling_rate, lead(scene)
    first = np.floor(times * rate).astype(np.int64) - guard
    width = int(np.ceil(pulses.end_of_contact.max() * rate)) + 2 + 2 * guard
    while scene.sensor.bandwidth is not None and not transformable(width):
        width += 1
    windows = np.zeros((times.size, width))
    pulses.add_to_frames(windows, rate, (times * rate - first) / rate)
    inside = first < samples_of(scene)
    if inside.any():
        axis.add(first[inside], scene.sensor.limit_band(windows, rate)[inside])


def _add_response(
    scene: Scene,
    axis: TimeAxis,
    heard: Hearing,
    pulses: Impact | ModalImpact,
    columns: Mapping[str, Floats],
) -> None:
    """Run the poles of beam and sensor from the first touch until the last ringing, or the recording, is over."""
    rate = scene.sampling.sampling_rate
    first, last = int(np.floor(columns["time"].min() * rate)), samples_of(scene)
    if first >= last:
        return
    # The slowest of the poles falls to its share of the response's tolerance in this time.
    poles = heard.response.poles
    ringing = float(log(poles.size / TOLERANCE) / -poles.real.max())
    end = columns["time"].max() + pulses.end_of_contact.max() + ringing
    stop = int(min(np.ceil(end * rate), last))
    frames = axis.until(stop)[None, first - axis.first :]
    onset = (columns["time"] * rate - first) / rate
    rows = np.zeros(onset.size, np.intp)
    heard.response.add_to_frames(frames, pulses, onset, heard.participation(columns), rows=rows)


def lead(scene: Scene) -> int:
    """Return how many samples before touch an impact may be in the recording: the low-pass has zero phase."""
    bandwidth = scene.sensor.bandwidth
    return 0 if bandwidth is None else int(np.ceil(_FILTER_PERIODS * scene.sampling.sampling_rate / bandwidth))


def hearing_limit(scene: Scene, background: Background | None) -> float:
    """Return the peak force below which an impact drowns in noise and background [N], and its rock is let go.

    0 where the sensor feels a motion, of which no force alone says how large it is.
    """
    if scene.sensor.quantity != "force":
        return 0.0
    noise = float(scene.sensor.noise_level(np.zeros(()), scene.sampling.sampling_rate))
    return float(np.sqrt(noise * noise + (0.0 if background is None else background.rms * background.rms)))
