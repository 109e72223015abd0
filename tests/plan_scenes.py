"""Ten scenes and what is asked of each, for the tests of the plan and `benchmarks/skipping.py`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from cgid.counting import counted
from cgid.features import extract_array
from cgid.scene import Scene, parse_scene, synthesise
from cgid.scene.plan import Plan, plan
from cgid.scene.tables import closed_forms_of, columns_of

STEEL = {"density": 7850, "youngs_modulus": "210 GPa", "poisson_ratio": 0.3}
#: Signals of which it is counted what runs: two blocks.
COUNTED = 512
FIT = ("fitted_peak", "fitted_width", "shrunken_restitution", "shrunken_restitution_deviation")
IN_TIME = ("peak_force", "contact_duration", "asymmetry")


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
    """Return a small scene; a population's value of None takes that key out, `population=False` all of it."""
    one = {name: value for name, value in {**POPULATION, **(population or {})}.items() if value is not None}
    content = {
        "name": "small",
        "impact": {"stiffness": "hertz", "dissipation": "hunt-crossley", "target": STEEL, **(impact or {})},
        "sampling": {"sampling_rate": 200e3, "samples": 2048, "pre_trigger": 128},
        "sensor": {"relative_noise": 0.01} if sensor is None else sensor,
        "populations": [one],
    }
    return parse_scene(content | more)


@dataclass(frozen=True)
class Case:
    """A scene and what is asked of it."""

    name: str
    scene: Scene
    output: str
    which: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def plan(self) -> Plan:
        return plan(self.scene, [self.output], **self.which)

    def ask(self) -> Counter[str]:
        """Return what runs for `COUNTED` signals."""
        with counted() as counts:
            asked = self.plan
            made = synthesise(self.scene, COUNTED) if asked.request.kept else columns_of(asked, COUNTED)
            for _ in made:
                pass
        return counts

    def ask_everything(self) -> Counter[str]:
        """Return what runs for all that can be known of the same signals: closed forms, frames, every feature."""
        with counted() as counts:
            for _ in closed_forms_of(self.scene, COUNTED):
                pass
            for batch in synthesise(self.scene, COUNTED):
                extract_array(batch.signals, batch.sampling_rate, pre_trigger=batch.pre_trigger, invalid="nan")
        return counts


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
)
