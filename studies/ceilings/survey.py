"""The survey of a rig: the Bayes limit against noise, sampling rate and spread of sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgid.errors import BadData
from cgid.plots.figure import png, require_matplotlib
from cgid.scene import Scene, varied
from cgid.scene.file.sections import Population
from cgid.scene.synthesis.impacts import draws
from studies.ceilings.coloured import check_covered, limits
from studies.ceilings.limit import untrusted

#: Settings of a survey: signal over noise [dB], sampling rate [Hz], largest over smallest radius.
SNRS = (15.0, 20.0, 25.0, 30.0, 40.0, 50.0)
RATES = (10e3, 20e3, 50e3, 100e3, 200e3, 500e3, 1e6)
SPREADS = (1.1, 1.5, 2.0, 4.0, 8.0, 16.0)
#: Nodes along the shape: the error of the accuracy, up to .0005, is below the standard error of a survey.
_NODES = 17
#: Blocks of 256 impacts from which to estimate noise and contacts.
_BLOCKS = 8


@dataclass(frozen=True)
class Point:
    """The ceiling at one setting.

    Attributes
    ----------
    axis : str
        "present", "snr" [dB], "sampling_rate" [Hz] or "size_spread" [1].
    value : float
    accuracy, accuracy_error : float
        With unknown drop height; nan if the point is left out.
    accuracy_known, accuracy_known_error : float
        With known drop height.
    left_out : str
        Reason for a missing ceiling, else empty.
    """

    axis: str
    value: float
    accuracy: float = float("nan")
    accuracy_error: float = float("nan")
    accuracy_known: float = float("nan")
    accuracy_known_error: float = float("nan")
    left_out: str = ""


@dataclass(frozen=True)
class Survey:
    """The ceiling of a scene with one setting changed at a time.

    Attributes
    ----------
    scene : str
        Name of the scene.
    n_signals : int
        Signals at each point.
    present : dict of float
        Value of the scene on each axis.
    here : Point
        The unchanged scene; its axis is "present".
    points : tuple of Point
    """

    scene: str
    n_signals: int
    present: dict[str, float]
    here: Point
    points: tuple[Point, ...]

    def along(self, axis: str) -> tuple[Point, ...]:
        """Return the points of one axis that have a limit."""
        return tuple(p for p in self.points if p.axis == axis and not p.left_out)


def survey(
    scene: Scene,
    n_signals: int = 2000,
    seed: int = 1_000_003,
    *,
    snrs: tuple[float, ...] = SNRS,
    sampling_rates: tuple[float, ...] = RATES,
    size_spreads: tuple[float, ...] = SPREADS,
    progress: Callable[[int], object] | None = None,
) -> Survey:
    """Return the ceiling of a scene at other noise levels, sampling rates and size spreads.

    All points have the same rocks as far as possible, so that differences are more precise than the points. `snrs` are
    in dB, `sampling_rates` in Hz with frames of the same duration, `size_spreads` largest over smallest radius,
    log-uniform about the geometric mean of each population.
    """
    check_covered(scene)
    settings = [("present", 0.0), *(("snr", v) for v in snrs), *(("sampling_rate", v) for v in sampling_rates)]
    settings += [("size_spread", v) for v in size_spreads]
    points = [_point(scene, axis, value, n_signals, seed, progress) for axis, value in settings]
    return Survey(scene.name, n_signals, _present(scene), points[0], tuple(points[1:]))


def changed(scene: Scene, axis: str, value: float) -> Scene:
    """Return the scene with another setting on one axis."""
    if axis == "snr":
        return varied(scene, relative_noise=10 ** (-value / 20), absolute_noise=0.0)
    if axis == "sampling_rate":
        if np.isclose(value, scene.sampling.sampling_rate):
            return scene
        return varied(scene, sampling_rate=value, keep_frame=True)
    if axis == "size_spread":
        return _resized(scene, value)
    return scene


def _resized(scene: Scene, spread: float) -> Scene:
    """Return the scene with radii log-uniform about the geometric mean of each population."""
    populations: list[Population] = []
    for population in scene.populations:
        middle = _middle_radius(population)
        law = {"distribution": "log-uniform", "lowest": middle / spread**0.5, "highest": middle * spread**0.5}
        one = varied(scene.model_copy(update={"populations": (population,)}), radius=law)
        populations += one.populations
    return scene.model_copy(update={"populations": tuple(populations)})


def _middle_radius(population: Population) -> float:
    quantiles = population.laws["radius"].quantile((np.arange(512) + 0.5) / 512)
    return float(np.exp(np.log(quantiles).mean()))


def _point(
    scene: Scene, axis: str, value: float, n_signals: int, seed: int, progress: Callable[[int], object] | None
) -> Point:
    try:
        here = changed(scene, axis, value)
    except BadData as error:  # such as a bandwidth above half the sampling rate
        return Point(axis, value, left_out=str(error).splitlines()[0])
    if problem := untrusted(here):
        return Point(axis, value, left_out=problem)
    unknown, known = limits(here, n_signals, seed, (False, True), n_nodes=_NODES, progress=progress)
    return Point(axis, value, unknown.accuracy, unknown.accuracy_error, known.accuracy, known.accuracy_error)


def _present(scene: Scene) -> dict[str, float]:
    peaks = np.concatenate([one.parameters["peak_force"] for one in draws(scene, 0, _BLOCKS)])
    noise = scene.sensor.noise_level(peaks, scene.sampling.sampling_rate)
    radii = [law.extremes for law in (p.laws["radius"] for p in scene.populations)]
    spread = float(np.mean([high / low for low, high in radii]))
    return {
        "snr": float(np.median(20 * np.log10(peaks / noise))),
        "sampling_rate": scene.sampling.sampling_rate,
        "size_spread": spread if np.isfinite(spread) else float("nan"),
    }


def survey_picture(points: Mapping[str, Sequence[Any]], present: Mapping[str, float], here: Any) -> bytes:
    """Return the ceiling against noise, sampling rate and spread of sizes as PNG."""
    titles = {
        "snr": "peak over noise [dB]",
        "sampling_rate": "sampling rate [Hz]",
        "size_spread": "largest over smallest rock",
    }
    figure = require_matplotlib()(figsize=(10, 3.6), layout="constrained")
    for axes, (axis, title) in zip(figure.subplots(1, 3, sharey=True), titles.items(), strict=True):
        held = sorted((p for p in points[axis] if np.isfinite(p.accuracy)), key=lambda p: p.value)
        for suffix, colour, name in (("", "C0", "drop height not known"), ("_known", "C1", "drop height known")):
            heights = [getattr(p, f"accuracy{suffix}") for p in held]
            errors = [2 * getattr(p, f"accuracy{suffix}_error") for p in held]
            axes.errorbar([p.value for p in held], heights, errors, fmt="o-", color=colour, capsize=2, label=name)
            if np.isfinite(present[axis]):
                axes.plot(present[axis], getattr(here, f"accuracy{suffix}"), "D", color=colour, mec="k", ms=8, zorder=3)
        if np.isfinite(present[axis]):
            axes.axvline(present[axis], color="0.7", zorder=0, label="now")
        if axis != "snr":
            axes.set_xscale("log")
        axes.set(xlabel=title)
        axes.grid(alpha=0.3)
    figure.axes[0].set(ylabel="highest accuracy possible (2 std. errors)")
    figure.axes[0].legend(fontsize="small")
    return png(figure)
