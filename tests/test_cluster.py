"""Work handed out to processes and to a dask cluster of two real workers: the same results, and every failure told."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from distributed import Client, LocalCluster
from joblib.externals.loky.process_executor import _ExecutorManagerThread

from cgid._lib import workers as cluster
from cgid._lib.validation import positive
from cgid._lib.workers import SERIAL, Workers, workers
from cgid.cli.main import run
from cgid.errors import CannotCreate, ClusterFailed, InvalidValue
from cgid.identification.training import Rows
from cgid.identification.training.grouped import Candidate, TrainingSet, choose_candidate, cross_validate, final
from cgid.scene import Scene, generate
from cgid.scene.output import generation as shards
from cgid.store import Dataset
from tests.mortal import fatal

ROOT = Path(__file__).parents[1]

#: Quick to measure, and with a signal's share of the folds that calibrate.
FEATURES = "peak_force,impulse"


@pytest.fixture(scope="module")
def two_workers() -> Iterator[Any]:
    """Yield a scheduler and two worker processes, which find this folder of tests, too."""
    root = str(Path(__file__).parents[1])
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([root, *([before] if before else [])])
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
    ) as made:
        yield made
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


@pytest.fixture
def address(two_workers: Any) -> str:
    return str(two_workers.scheduler_address)


@pytest.fixture
def nobody() -> Iterator[str]:
    """Yield the address of a scheduler without workers."""
    with LocalCluster(n_workers=0, dashboard_address=":0", host="127.0.0.1") as made:
        yield str(made.scheduler_address)


def sums(folder: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(folder.iterdir())}


# ---- the same results ------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_dataset_is_the_same_whoever_makes_it(
    reference_scene: Scene, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where the workers are not
    told: list[int] = []
    asked = {"n_signals": 150, "seed": 4, "shard_signals": 32}
    generate(reference_scene, "one", **asked)
    generate(reference_scene, "two", **asked, jobs=2)
    generate(reference_scene, "dask", **asked, scheduler=address, progress=told.append)
    generate(reference_scene, "one.h5", 32, 4)
    generate(reference_scene, "dask.h5", 32, 4, scheduler=address)
    assert sums(Path("one")) == sums(Path("two")) == sums(Path("dask"))
    assert Path("dask.h5").read_bytes() == Path("one.h5").read_bytes()
    assert len(sums(Path("dask"))) == 8  # five shards, the description, the sums and the lock
    assert sorted(told) == [22, *[32] * 4]


@pytest.mark.long
def test_groups_are_judged_alike_whoever_leaves_them_out(address: str) -> None:
    generator, group = np.random.default_rng(8), np.repeat(np.arange(4), 15)
    labels = np.where(group % 2, "a", "b")
    rows = Rows(
        names=("window_level", "window_crest_factor"),
        features=generator.normal(size=(60, 2)) + np.where(group % 2, 1.0, 0.0)[:, None],
        labels=labels,
        group=group,
    )
    candidates = [Candidate(name=name, features=(name,), family="linear") for name in rows.names]
    training_set = TrainingSet(rows=rows, candidates=candidates, weights=None, seed=0)

    def learned(crew: Workers) -> list[Any]:
        judged, choice = cross_validate(training_set, workers=crew), choose_candidate(training_set, crew)
        limit = final(training_set, choice, crew)[0].neighbourhood_.limit
        return [judged.probabilities.tolist(), judged.chosen, choice, limit]

    with workers(scheduler=address) as far:
        assert learned(SERIAL) == learned(far)


@pytest.mark.long
def test_a_command_does_its_work_on_a_cluster(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, models = str(tmp_path / "data"), [tmp_path / name for name in ("far.npz", "two.npz", "one.npz")]
    assert (
        run(
            [
                "generate",
                "reference",
                "-n",
                "400",
                "-o",
                data,
                "--set",
                "shard_signals=256",
                "--set",
                f"scheduler={address}",
            ]
        )
        == 0
    )
    for model, way in zip(models, (["--set", f"scheduler={address}"], ["--jobs", "2"], []), strict=True):
        assert run(["train", data, "-o", str(model), "--family", "linear", "--features", FEATURES, *way]) == 0
    assert len({model.read_bytes() for model in models}) == 1
    assert "Traceback" not in capsys.readouterr().err


def test_processes_that_are_kept_stand_in_another_folder(
    reference_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        generate(reference_scene, "data", 8, shard_signals=4, jobs=2)
        assert len(Dataset(tmp_path / name / "data")) == 8


# ---- what can go wrong -----------------------------------------------------------------------------------------------


WAYS = ["alone", "jobs", "cluster"]


def crew_of(way: str, address: str) -> AbstractContextManager[Workers]:
    return workers(2 if way == "jobs" else 1, address if way == "cluster" else None)


@pytest.mark.long
@pytest.mark.parametrize("way", WAYS)
def test_what_a_part_raises_is_raised(way: str, address: str) -> None:
    with crew_of(way, address) as crew:
        assert list(crew.each(positive, "radius", [3, 4, 5])) == [3, 4, 5]
        with pytest.raises(InvalidValue, match=r"^radius must be above 0, got -2"):
            list(crew.each(positive, "radius", [1, -2, 3]))
        assert sorted(crew.each(positive, "radius", [3, 4, 5], ordered=False)) == [3, 4, 5]  # the crew goes on


@pytest.mark.long
def test_a_folder_that_is_not_shared_is_told(
    reference_scene: Scene, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shards, "_anywhere", lambda asked: moved(asked, tmp_path / "empty"))
    with pytest.raises(CannotCreate, match="all machines share"):
        generate(reference_scene, tmp_path / "other", 64, shard_signals=16, scheduler=address)
    assert not (tmp_path / "other").exists()
    assert not list((tmp_path / "empty").iterdir())


def moved(asked: Any, folder: Path) -> Any:
    """Return what workers are asked as it is on a machine whose folder of that name is another one."""
    folder.mkdir()
    return dataclasses.replace(asked, place=folder)


@pytest.mark.long
def test_other_versions_are_refused_before_anything_is_written(
    reference_scene: Scene, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = {**cluster._versions(), "numpy": "1.0"}
    monkeypatch.setattr(cluster, "_versions", lambda: versions)
    with pytest.raises(ClusterFailed, match=r"must have numpy 1\.0 like this process, for equal results, got \d"):
        generate(reference_scene, tmp_path / "data", 512, scheduler=address)
    assert not (tmp_path / "data").exists()


def test_a_scheduler_without_workers(nobody: str, monkeypatch: pytest.MonkeyPatch) -> None:
    wait = Client.wait_for_workers
    monkeypatch.setattr(Client, "wait_for_workers", lambda client, n, timeout: wait(client, n, timeout=0.1))
    with pytest.raises(ClusterFailed, match=r"must have workers, none came within 10 s"), workers(scheduler=nobody):
        pass


def test_no_scheduler_at_all(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(cluster, "TIMEOUT", 0.5)
    assert run(["generate", "reference", "-o", str(tmp_path / "d"), "--set", "scheduler=tcp://127.0.0.1:9"]) == 69
    error = capsys.readouterr().err
    assert re.fullmatch(r"cgid: error: tcp://127\.0\.0\.1:9: a dask scheduler must answer there within .*\n", error)
    assert not (tmp_path / "d").exists()


def test_workers_that_never_come_back_are_told(nobody: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Client, "wait_for_workers", lambda *_, **__: None)
    monkeypatch.setattr(cluster, "DESERTED", 0.2)
    with workers(scheduler=nobody) as crew, pytest.raises(ClusterFailed):
        list(crew.each(positive, "radius", range(3, 9)))


@pytest.mark.long
def test_ctrl_c_on_a_cluster_leaves_whole_shards_alone(reference_scene: Scene, address: str, tmp_path: Path) -> None:
    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    asked: dict[str, Any] = {"n_signals": 400, "seed": 4, "shard_signals": 20}
    with pytest.raises(KeyboardInterrupt):
        generate(reference_scene, tmp_path / "data", **asked, scheduler=address, progress=interrupt)
    n_shards = len(list((tmp_path / "data").glob("shard-*.h5")))
    assert 1 <= n_shards < 20
    generate(reference_scene, tmp_path / "data", **asked, resume=True)
    generate(reference_scene, tmp_path / "whole", **asked)
    assert sums(tmp_path / "data") == sums(tmp_path / "whole")


# ---- last, for the processes that take the place of dead ones must load everything anew ------------------------------


def blocked(_common: None, _part: int) -> set[int]:
    return set(signal.pthread_sigmask(signal.SIG_BLOCK, []))


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="Windows has no masks of signals")
@pytest.mark.parametrize("each", ["each", "each_in_step"])
def test_ctrl_c_never_reaches_a_worker(each: str) -> None:
    """The mask is inherited: it holds from the first instruction of the process, before it imports anything."""
    with workers(2) as crew:
        assert all(signal.SIGINT in mask for mask in getattr(crew, each)(blocked, None, range(4)))
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_shutdown_that_fails_in_the_executor_prints_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loky's thread may look for a part that the shutdown has cancelled; any other error of a thread is printed."""
    failed, printed = [], []
    add = _ExecutorManagerThread.add_call_item_to_queue

    def add_or_fail(thread: Any) -> None:
        if thread.executor_flags.shutdown:
            failed.append(thread)
            raise KeyError(1)
        add(thread)

    monkeypatch.setattr(_ExecutorManagerThread, "add_call_item_to_queue", add_or_fail)
    monkeypatch.setattr(threading, "excepthook", printed.append)
    results = Workers(jobs=2).each(positive, "radius", range(1, 100))
    assert next(results) == 1
    results.close()
    assert failed
    assert not printed
    thread = threading.Thread(target=dict[str, int]().__getitem__, args=("missing",))
    thread.start()
    thread.join()
    assert len(printed) == 1


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="a process group")
@pytest.mark.parametrize("command", ["generate reference -n 300000 -o {}/data", "train caving -n 300000 -o {}/m.npz"])
def test_ctrl_c_while_workers_start_is_one_line(command: str, tmp_path: Path) -> None:
    """Sent to the group, as a terminal does, soon after the first worker is there."""
    arguments = [sys.executable, "-m", "cgid", *command.format(tmp_path).split(), "--jobs", "2", "--overwrite"]
    process = subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        while process.poll() is None and not psutil.Process(process.pid).children():
            time.sleep(0.005)
        time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)
        err = process.communicate(timeout=300)[1]
    finally:
        process.kill()
        process.communicate()
    # Python ends by the signal itself if it came within `exec`, as of a dataclass that is being imported.
    assert process.returncode in (128 + signal.SIGINT, -signal.SIGINT), err
    assert err.split() == ["cgid:", "interrupted;", "no", "partial", "files", "remain"], err


@pytest.mark.long
def test_a_process_that_dies_is_told(tmp_path: Path) -> None:
    with workers(2) as crew:
        with pytest.raises(ClusterFailed, match=r"^jobs: a worker process was killed"):
            list(crew.each(fatal, f"{tmp_path}|1", range(6)))
        assert list(crew.each(fatal, f"{tmp_path}|1", range(3))) == [0, 1, 2]  # others have taken its place


@pytest.mark.long
def test_a_worker_that_dies_is_made_up_for(address: str, tmp_path: Path) -> None:
    with workers(scheduler=address) as crew:
        assert sorted(crew.each(fatal, f"{tmp_path}|1", range(6), ordered=False)) == list(range(6))
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.long
def test_a_part_that_kills_its_workers_is_given_up(two_workers: Any, address: str, tmp_path: Path) -> None:
    two_workers.scheduler.allowed_failures = 0
    with (
        workers(scheduler=address) as crew,
        pytest.raises(ClusterFailed, match="several workers died on the same"),
    ):
        list(crew.each(fatal, f"{tmp_path}|99", range(6)))
    two_workers.scheduler.allowed_failures = 3
