"""What scenes make, as digests: run as a script, under whatever settings of the environment.

`python -m tests.portable` prints one JSON object; `tests/test_portable.py` holds it against literals.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from cgid.scene import load_scene, parse_scene, synthesise
from cgid.scene.scene import Scene
from cgid.scene.stream.synthesis import record

DATASETS = Path(__file__).parents[1] / "datasets"
SEED, N_SIGNALS = 3, 2000
SCENES = ("reference", "tail_beam", "yang2018")


def digest(arrays: dict[str, Any]) -> str:
    """Return the SHA-256 of arrays by name."""
    found = hashlib.sha256()
    for name, values in sorted(arrays.items()):
        values = np.ascontiguousarray(values)
        found.update(f"{name} {values.dtype.str} {values.shape} ".encode() + values.tobytes())
    return found.hexdigest()


def of_signals(scene: Scene, n_signals: int = N_SIGNALS, seed: int = SEED) -> dict[str, str]:
    """Return the digests of the signals, labels and parameters of some impacts."""
    batches = list(synthesise(scene, n_signals, seed=seed))
    names = batches[0].parameters
    return {
        "signals": digest({"signals": np.concatenate([batch.signals for batch in batches])}),
        "labels": digest({"labels": np.concatenate([batch.labels for batch in batches]).astype("S32")}),
        "parameters": digest({name: np.concatenate([batch.parameters[name] for batch in batches]) for name in names}),
    }


def of_recording(scene: Scene, seed: int = SEED) -> dict[str, str]:
    """Return the digests of a recording and of the truth of its impacts."""
    signal, truth = record(scene, seed)
    truth = {name: values.astype("S32") if values.dtype.kind == "U" else values for name, values in truth.items()}
    return {"signals": digest({"signals": signal.samples}), "truth": digest(truth)}


def main() -> None:
    """Print the digests of the shipped scenes."""
    found = {name: of_signals(load_scene(DATASETS / f"{name}.toml")) for name in SCENES}
    found["caving"] = of_recording(load_scene(DATASETS / "caving.toml"))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
