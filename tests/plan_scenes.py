"""Scenes with requested outputs, for the tests of the plan."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

from cgid.scene import Plan, Scene, parse_scene, plan, synthesise
from cgid.scene.synthesis.draws import BLOCK
from cgid.scene.synthesis.synthesis import columns_of

STEEL = {"density": 7850, "youngs_modulus": "210 GPa", "poisson_ratio": 0.3}
FIT = ("fitted_peak", "fitted_width", "shrunken_restitution", "shrunken_restitution_deviation")
IN_TIME = ("peak_force", "contact_duration", "asymmetry")


def toml(content: dict[str, Any]) -> str:
    """Write a scene as TOML, whose values are JSON's but for the mappings."""

    def value(item: Any) -> str:
        if isinstance(item, dict):
            return "{ " + ", ".join(f"{key} = {value(part)}" for key, part in item.items()) + " }"
        if isinstance(item, list):
            return "[" + ", ".join(map(value, item)) + "]"
        return json.dumps(item)

    return "".join(f"{key} = {value(part)}\n" for key, part in content.items())


def uniform(lowest: Any, highest: Any) -> dict[str, Any]:
    return {"distribution": "uniform", "lowest": lowest, "highest": highest}


POPULATION = {
    "label": "coal",
    "density": uniform(1300, 1500),
    "youngs_modulus": uniform("2 GPa", "5 GPa"),
    "poisson_ratio": 0.3,
    "radius": uniform("15 mm", "40 mm"),
    "velocity": uniform(4, 8),
    "restitution": uniform(0.2, 0.9),
}
TAP = {"label": "tap", "shape": "half-sine", "peak_force": uniform("1 kN", "9 kN"), "contact_duration": "0.5 ms"}
SECOND = {"delay": uniform("2 ms", "3 ms"), "ratio": uniform(0.3, 0.9)}


def scene_of(
    impact: dict[str, Any] | None = None,
    population: dict[str, Any] | None = None,
    sensor: dict[str, Any] | None = None,
    **more: Any,
) -> Scene:
    """Return a small scene; a population value of None removes that key, `population=False` all of it."""
    one = {name: value for name, value in {**POPULATION, **(population or {})}.items() if value is not None}
    content = {
        "name": "small",
        "impact": {"stiffness": "hertz", "dissipation": "hunt-crossley", "target": STEEL, **(impact or {})},
        "sampling": {"sampling_rate": 200e3, "samples": 2048, "pre_trigger": 128},
        "sensor": {"relative_noise": 0.01} if sensor is None else sensor,
        "populations": [one],
    }
    return parse_scene(content | more)


#: A laboratory plate, held along its edges.
PANEL = {
    "length": "458.4 mm",
    "width": "360 mm",
    "thickness": "8 mm",
    "edges": "simply-supported",
    "damping_ratio": 0.01,
    "impact_point": {"x": uniform("0.1 m", "0.3 m"), "y": uniform("0.1 m", "0.2 m")},
    "sensor_point": {"x": "0.1 m", "y": "0.1 m"},
}
#: Modes as from a tap test. The sensor is at a node of the second mode.
TAPPED = [
    {"frequency": f, "damping_ratio": 0.02, "modal_mass": 20, "shape_impact": 1.0, "shape_sensor": shape}
    for f, shape in ((200, 0.8), (500, 0.0), (900, -0.6), (1700, 0.5))
]
FELT = {"quantity": "acceleration", "anti_alias": {"frequency": "5 kHz"}, "absolute_noise": 0.1}
SMALL = {"radius": uniform("5 mm", "10 mm"), "velocity": uniform(1, 3)}


def beam_of(tail_beam: dict[str, Any], sensor: dict[str, Any] | None = None, samples: int = 1024) -> Scene:
    sampling = {"sampling_rate": "25.6 kHz", "samples": samples, "pre_trigger": 64}
    return scene_of(None, SMALL, FELT if sensor is None else sensor, tail_beam=tail_beam, sampling=sampling)


#: Of recorders and noises, those that are plain among them.
RIGS = {
    "relative_noise": {"distribution": "log-uniform", "lowest": 0.003, "highest": 0.03},
    "noise_exponent": {"distribution": "mixed", "parts": [uniform(0.2, 1.2), 0]},
    "hum": {"distribution": "mixed", "parts": [uniform(0.01, 0.05), 0]},
    "relative_range": {"distribution": "mixed", "parts": [uniform(1, 1.2), uniform(0.5, 1)]},
    "bits": uniform(10, 16),
    "anti_alias_frequency": uniform("20 kHz", "150 kHz"),
}


@dataclass(frozen=True)
class Case:
    """A scene and the requested output."""

    name: str
    scene: Scene
    output: str
    which: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def plan(self) -> Plan:
        return plan(self.scene, self.output, **self.which)

    def ask(self) -> None:
        """Make the output for two blocks."""
        asked, n_signals = self.plan, 2 * BLOCK
        made = synthesise(self.scene, n_signals, output=self.output) if asked.kept else columns_of(asked, n_signals)
        for _ in made:
            pass


CASES = (
    Case("parameters alone", scene_of(), "parameters"),
    Case("times alone", scene_of(), "closed-form", {"quantities": ("contact_duration", "time_of_peak", "impulse")}),
    Case("all closed forms", scene_of(), "closed-form"),
    Case(
        "undamped, no sensor",
        scene_of({"dissipation": "elastic"}, {"restitution": None}, {}),
        "frames",
    ),
    Case("features of the fit", scene_of(), "features", {"features": FIT}),
    Case("features in time", scene_of(), "features", {"features": IN_TIME}),
    Case(
        "spectrum, bandwidth, range and bits",
        scene_of(sensor={"relative_noise": 0.01, "bandwidth": "40 kHz", "range": "200 kN", "bits": 16}),
        "features",
        {"features": ("spectral_centroid",)},
    ),
    Case("gravity too weak", scene_of({"gravity": 9.81, "gravity_tolerance": "2 %"}), "frames"),
    Case("gravity and a thin plate", scene_of({"gravity": 9.81, "target": {**STEEL, "thickness": "20 mm"}}), "frames"),
    Case(
        "taps, second hits, drawn noise",
        scene_of(population={"second_hit": SECOND}, taps=[TAP], randomise={"relative_noise": uniform(0.001, 0.02)}),
        "features",
        {"features": FIT},
    ),
    Case("a plate's acceleration", beam_of({**PANEL, "coupling": "impedance"}), "frames"),
    Case("features of measured modes, one silent", beam_of({"modes": TAPPED}), "features"),
    Case("a beam whose sensor feels the force", beam_of({"modes": TAPPED}, {}), "frames"),
    Case("true pulses on a beam", beam_of({"modes": TAPPED}), "pulses"),
)


def named(name: str) -> Case:
    return next(case for case in CASES if case.name == name)
