"""Signals of shipped scenes, as a script for any settings of the environment: `python -m tests.portable FILE.npz`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.scene import load_scene, synthesise
from tests.impact_truth import caving

SEED, N_SIGNALS = 3, 12
SCENES = ("reference", "peers", "rock", "randomised", "plate", "tail_beam")
#: The last column of a recording's truth that is a time of a rock is exact to this [s].
TIME_TOLERANCE = 1e-12


def signals() -> dict[str, NDArray[Any]]:
    """Return samples, labels and specimens of some impacts of each scene, and of a stretch of `caving`."""
    from cgid.scene import record

    found: dict[str, NDArray[Any]] = {}
    for name in SCENES:
        (batch,) = synthesise(load_scene(name), N_SIGNALS, seed=SEED, dtype="float64")
        peak = np.abs(batch.signals).max(axis=1)
        found |= {f"{name}/signals": batch.signals[:, ::64] / peak[:, None], f"{name}/peak": peak}
        found |= {f"{name}/labels": batch.labels, f"{name}/specimen": batch.specimen}
    signal, truth = record(caving(4.0, noise=True), SEED, dtype="float64")
    found["caving/signals"] = signal.samples[None, ::64] / np.abs(signal.samples).max()
    return found | {f"caving/{name}": truth[name] for name in ("time", "label", "specimen", "bounce")}


def main() -> None:
    np.savez_compressed(Path(sys.argv[1]), **signals())


if __name__ == "__main__":
    main()
