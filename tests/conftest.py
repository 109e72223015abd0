"""Scenes, data and models that several tests share."""

from __future__ import annotations

import os
from pathlib import Path

# Before scikit-learn is loaded: OpenMP threads that wait spin, and on a busy machine small fits then take minutes.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

from cgid.identification.classifier import FAMILIES
from cgid.identification.training import Training, train
from cgid.scene import Scene, load_scene, synthesise

ROOT = Path(__file__).parents[1]
REAL_DATA = ROOT.parent / "shared" / "realdata"


@pytest.fixture(scope="session")
def reference_scene() -> Scene:
    return load_scene(ROOT / "datasets" / "reference.toml")


@pytest.fixture(scope="session")
def trained(reference_scene: Scene) -> dict[str, Training]:
    """One small model of each family."""
    return {family: train(synthesise(reference_scene, 3000, seed=5), family=family) for family in FAMILIES}


@pytest.fixture(scope="session")
def real_data() -> Path:
    if not REAL_DATA.is_dir():
        pytest.skip("the real recordings are not beside this checkout (../shared/realdata)")
    return REAL_DATA
