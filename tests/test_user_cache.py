"""Tables in the user's cache: what is read is what would be made, or it is made again; nothing ever fails."""

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cgid._lib import user_cache
from cgid.identification.inversion.inversion import Inversion, Observations
from tests.test_compiled import DAMAGES
from tests.test_inversion import eight_modes
from tests.test_inversion import with_errors as beam_with_errors

TABLES = [np.arange(6.0).reshape(2, 3), np.zeros((0, 4), np.float32), np.array([True, False]), np.array(3, np.int32)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    place = tmp_path / "tables"
    place.mkdir(mode=0o700)
    monkeypatch.setattr(user_cache, "_table_folder", lambda: place)
    return place


def is_made(name: str = "a") -> bool:
    """Whether tables were made, which are right in any case."""
    calls = []

    def make() -> list[np.ndarray]:
        calls.append(name)
        return TABLES

    for found, made in zip(user_cache.kept(name, make), TABLES, strict=True):
        assert (found.dtype, found.shape) == (made.dtype, made.shape) and (found == made).all()
    return bool(calls)


def test_tables_are_made_once(folder: Path) -> None:
    assert [is_made(), is_made(), is_made("b"), is_made("b")] == [True, False, True, False]
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in folder.iterdir())


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_tables_are_made_again_and_mended(folder: Path, name: str) -> None:
    assert all(is_made(one) for one in "abc")
    for path in sorted(folder.iterdir()):
        DAMAGES[name](path)
    assert all(is_made(one) for one in "abc")
    assert not any(is_made(one) for one in "abc")


def test_tables_of_another_version_or_user_are_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_made() and not is_made()
    (path,) = folder.iterdir()
    path.chmod(0o666)
    assert is_made() and not is_made()
    monkeypatch.setattr(user_cache, "_table_sources", lambda: "another")
    assert is_made() and not is_made()


def test_without_a_place_to_write_tables_are_made_each_time(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(folder)
    assert is_made() and is_made()
    folder.write_text("a file")
    assert is_made() and is_made()
    monkeypatch.setattr(user_cache, "_table_folder", lambda: None)
    assert is_made() and is_made()


def test_the_oldest_tables_give_room(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for age, name in enumerate("abcd"):
        is_made(name)
        (path,) = folder.glob(f"{name}-*")
        os.utime(path, (1e9 - age, 1e9 - age))
    monkeypatch.setattr(user_cache, "_MAX_TABLES", 2 * path.stat().st_size)
    assert is_made("e")
    assert sorted(path.name[0] for path in folder.iterdir()) == ["a", "b", "e"]


@pytest.mark.parametrize("errors", [None, 1e-3])
def test_inversions_by_kept_tables_are_equal_to_the_bit(folder: Path, errors: float | None) -> None:
    beam = eight_modes().beam
    if errors is not None:
        beam = beam_with_errors(beam, np.full((3, len(beam.poles)), errors))
    frames = np.random.default_rng(5).normal(0, 1, (3, 1, beam.n_samples + 40))
    frames[:, :, 20:] += 30 * np.exp(-np.arange(frames.shape[2] - 20) / 50)
    observations = Observations(frames, np.ones((3, 1)))
    found = []
    for lasting in (False, True, True):
        estimate = Inversion(beam, lasting=lasting).invert(observations, np.full((3, 2), [10, 25]))
        found.append(np.column_stack([estimate.x, estimate.y, estimate.coefficients, estimate.misfit]))
    assert np.isfinite(found[0]).all()
    assert (found[1] == found[0]).all() and (found[2] == found[0]).all()
    assert len(list(folder.iterdir())) >= 5


def test_another_beam_has_tables_of_its_own(folder: Path) -> None:
    beam = eight_modes().beam
    other = beam.with_shapes(beam.participation * (1 + 1e-12))
    one, two = (Inversion(each, lasting=True).table(2, 1e-3) for each in (beam, other))
    assert len(list(folder.iterdir())) == 2
    assert one.beam.participation.shape == two.beam.participation.shape


_PROCESS = """
import sys
from cgid.identification.prediction import load_model
from cgid.identification.inversion.inversion import Inversion
print("ready", flush=True)
sys.stdin.readline()
beam = load_model("default-acceleration").beam
print(beam.inversion.grid.low.at.tobytes().hex()[:80])
"""


@pytest.mark.long
def test_processes_make_tables_at_once(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(user_cache.PACKAGE.parent)}
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    command = [sys.executable, "-c", _PROCESS]
    started = [subprocess.Popen(command, **pipes, text=True, env=environment) for _ in range(3)]
    for process in started:
        process.stdout.readline()
    for process in started:
        process.stdin.write("\n")
        process.stdin.flush()
    ended = [process.communicate() for process in started]
    assert [(process.returncode, told) for process, (_, told) in zip(started, ended, strict=True)] == [(0, "")] * 3
    assert len({out for out, _ in ended}) == 1
    assert not [path for path in (tmp_path / "tables").iterdir() if path.name.startswith(".")]
