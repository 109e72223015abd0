"""Scenes, data and models that several tests share."""

from __future__ import annotations

import os
import signal
from pathlib import Path

# Set before numpy and scikit-learn are imported: waiting threads spin, so small fits take minutes on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests started in the background, or by nohup, may inherit an ignored signal and pass it on to their child processes.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

import pytest

from cgid.identification.training import Training, train_on_specimens
from cgid.identification.training.classifier import FAMILIES
from cgid.identification.training.rows import DEFAULT_FEATURES, DEFAULT_GUARDS, measure
from cgid.scene import Scene, load_scene, synthesise
from tests.beside import SHARED

ROOT = Path(__file__).parents[1]
REAL_DATA = SHARED / "realdata"

#: Most processes for the whole suite: each of them makes the session's fixtures anew.
MAX_WORKERS = 8


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Distribute the whole suite over the cores (pytest-xdist) without long tests, unless -m or -k selects.

    Tests named on the command line run in one process, including long ones.
    """
    options, whole = config.option, config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if whole and not (options.markexpr or options.keyword):
        options.markexpr = "not long"
    if "PYTEST_XDIST_WORKER" in os.environ:  # a worker also runs this hook, and has no workers of its own
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    unasked = config.pluginmanager.hasplugin("xdist") and options.numprocesses is None and options.dist == "no"
    if whole and unasked and cores > 1 and not (options.usepdb or options.collectonly):
        # Neighbours stay together, so that the shared fixtures of a file are made once.
        options.numprocesses, options.dist = min(cores, MAX_WORKERS), "worksteal"


@pytest.fixture(scope="session")
def reference_scene() -> Scene:
    return load_scene(ROOT / "datasets" / "reference.toml")


@pytest.fixture(scope="session")
def trained(reference_scene: Scene) -> dict[str, Training]:
    """One small model of each family, all from the same impacts, which are measured once."""
    rows = measure(synthesise(reference_scene, 3000, seed=5), (*DEFAULT_FEATURES, *DEFAULT_GUARDS))
    return {family: train_on_specimens(rows, guards=DEFAULT_GUARDS, family=family) for family in FAMILIES}


@pytest.fixture(scope="session")
def real_data() -> Path:
    if not REAL_DATA.is_dir():
        pytest.skip("the real recordings are not beside this checkout (../shared/realdata)")
    return REAL_DATA
