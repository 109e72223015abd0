"""Digests of the output of scenes, as a script for any settings of the environment.

`python -m tests.portable shipped` (or `varied [NAME ...]`) prints one JSON object; `tests/test_portable.py` compares it
with the literals in `portable.json`.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from cgid.physics.laws import HUNT_CROSSLEY_LAWS, STIFFNESS_THEORIES
from cgid.scene import load_scene, synthesise
from cgid.scene.schema import Scene
from cgid.scene.stream import record
from tests.plan_scenes import CASES, PANEL, RIGS, STEEL, TAP, beam_of, scene_of, uniform

DATASETS = Path(__file__).parents[1] / "datasets"
SEED, N_SIGNALS = 3, 2000
SCENES = ("reference", "tail_beam", "yang2018")
CRUSHING = {"distribution": "log-uniform", "lowest": "5 MPa", "highest": "1 GPa"}


def digest(arrays: dict[str, Any]) -> str:
    """Return the SHA-256 of arrays by name."""
    found = hashlib.sha256()
    for name, values in sorted(arrays.items()):
        values = np.ascontiguousarray(values)
        found.update(f"{name} {values.dtype.str} {values.shape} ".encode() + values.tobytes())
    return found.hexdigest()


def of_signals(scene: Scene, n_signals: int = N_SIGNALS, *, dtype: Any = "float32") -> dict[str, str]:
    """Return the digests of the signals, labels and parameters of some impacts."""
    batches = list(synthesise(scene, n_signals, seed=SEED, dtype=dtype))
    names = batches[0].parameters
    return {
        "signals": digest({"signals": np.concatenate([batch.signals for batch in batches])}),
        "labels": digest({"labels": np.concatenate([batch.labels for batch in batches]).astype("S32")}),
        "parameters": digest({name: np.concatenate([batch.parameters[name] for batch in batches]) for name in names}),
    }


def of_recording(scene: Scene, *, dtype: Any = "float32") -> dict[str, str]:
    """Return the digests of a recording and of the truth of its impacts."""
    signal, truth = record(scene, SEED, dtype=dtype)
    truth = {name: values.astype("S32") if values.dtype.kind == "U" else values for name, values in truth.items()}
    return {"signals": digest({"signals": signal.samples}), "truth": digest(truth)}


def of_shipped() -> dict[str, dict[str, str]]:
    """Return the digests of the shipped scenes."""
    found = {name: of_signals(load_scene(DATASETS / f"{name}.toml")) for name in SCENES}
    return found | {"caving": of_recording(load_scene(DATASETS / "caving.toml"))}


def of_varied(names: Collection[str] = ()) -> dict[str, dict[str, str]]:
    """Return the digests of small scenes, in float64, that together have every property of scenes.

    With names, only of these scenes; otherwise of all, and of the recording of `caving`.
    """
    hum = [{"frequency": "50 Hz", "amplitude": "3 N"}, {"frequency": "297.3 Hz", "amplitude": "2 N"}]
    density = ["1 N/sqrt(Hz)", "5 N/sqrt(Hz)", "5 N/sqrt(Hz)", "0.5 N/sqrt(Hz)"]
    coloured = {"frequencies": ["2 Hz", "20 Hz", "200 Hz", "2 kHz"], "density": density}
    spectrum = {"frequencies": [50, 2e3, "100 kHz"], "density": density[:3]}
    plate = {**STEEL, "thickness": "20 mm"}
    odd = {"sampling_rate": 200e3, "samples": 1025, "pre_trigger": 128}
    both = {"viscous_restitution": uniform(0.05, 1.0)}
    bounded = {"lowest": "5 mm", "highest": "90 mm"}
    scenes = {case.name: case.scene for case in CASES}
    scenes |= {name: load_scene(DATASETS / f"{name}.toml") for name in ("peers", "randomised", "strangers")}
    scenes |= {f"{law} law": scene_of({"law": law}) for law in HUNT_CROSSLEY_LAWS}
    scenes |= {f"{theory} theory": scene_of({"stiffness": theory}) for theory in STIFFNESS_THEORIES}
    scenes |= {
        f"{edges} panel": beam_of({**PANEL, "edges": edges, "coupling": "modes"}, samples=512)
        for edges in ("clamped", "cantilever")
    }
    scenes |= {
        f"{shape} tap": scene_of(taps=[{**TAP, "shape": shape}])
        for shape in ("half-sine", "haversine", "triangle", "square")
    }
    scenes |= {
        f"{law['distribution']} radius": scene_of(population={"radius": law | bounded})
        for law in (
            {"distribution": "rosin-rammler", "characteristic": "30 mm", "uniformity": 1.3},
            {"distribution": "lognormal", "median": "20 mm", "sigma": 0.4},
            {"distribution": "truncated-normal", "mean": "20 mm", "deviation": "5 mm"},
            {"distribution": "log-uniform"},
        )
    }
    scenes |= {
        "thornton": scene_of({"dissipation": "thornton"}, {"restitution": None, "yield_pressure": CRUSHING}),
        "walton-braun": scene_of({"dissipation": "walton-braun"}),
        "kuwabara-kono": scene_of({"dissipation": "kuwabara-kono"}),
        "thornton and viscous": scene_of(
            {"dissipation": "thornton"}, {"restitution": None, "yield_pressure": CRUSHING, **both}
        ),
        "walton-braun and viscous": scene_of({"dissipation": "walton-braun"}, both),
        "strength": scene_of({"dissipation": "thornton"}, {"restitution": None, "strength": CRUSHING}),
        "lumps": scene_of(population={"curvature": uniform(0.1, 2.0), "effective_mass": uniform(0.4, 1.0)}),
        "weight": scene_of({"gravity": 9.81, "gravity_tolerance": 1e-7}),
        "weight on a plate": scene_of({"gravity": 9.81, "target": plate}, {"restitution": 0.7}),
        "hum": scene_of(background={"hum": hum}),
        "coloured noise": scene_of(background={"coloured": coloured}),
        "pink noise": scene_of(sensor={"relative_noise": 0.05, "noise_exponent": 1.1}),
        "spectrum of noise": scene_of(sensor={"absolute_noise": 9, "noise_spectrum": spectrum, "relative_range": 0.9}),
        "drawn rigs": scene_of(randomise=RIGS),
        "bandwidth": scene_of(sensor={"bandwidth": "40 kHz"}),
        "bandwidth, odd": scene_of(sensor={"bandwidth": "40 kHz"}, sampling=odd),
    }
    chosen = names or scenes
    found = {name: of_signals(scenes[name], 40, dtype="float64") for name in chosen}
    return found if names else found | {"caving": of_recording(load_scene(DATASETS / "caving.toml"), dtype="float64")}


def main() -> None:
    """Print the digests of the shipped or of varied scenes."""
    kind, *names = sys.argv[1:]
    print(json.dumps(of_shipped() if kind == "shipped" else of_varied(names)))


if __name__ == "__main__":
    main()
