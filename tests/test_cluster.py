"""Work handed out to processes and to a dask cluster of two real workers: the same results, and every failure told."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
import re
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client, LocalCluster
from distributed.scheduler import KilledWorker
from joblib._dask import DaskDistributedBackend
from joblib.parallel import BatchedCalls

from cgid import workers as cluster
from cgid.cli.main import run
from cgid.errors import BadData, CannotCreate, ClusterFailed, InvalidValue, MissingExtra
from cgid.identification.grouped import Candidate, TrainingSet, choose_candidate, cross_validate, final
from cgid.identification.rows import Rows, measure
from cgid.scene import Scene, generate, synthesise
from cgid.scene import generation as shards
from cgid.store import Dataset
from cgid.validation import positive
from cgid.workers import ALONE, Workers, workers
from models.selection import FAMILIES, select
from tests.mortal import fatal

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
def test_what_all_have_in_common_may_be_large(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    common = np.arange(200_000.0)
    assert common.nbytes > cluster._SMALL
    with workers(scheduler=address) as crew:
        for _ in range(2):  # the second time just after the first is forgotten
            assert list(crew.each(np.take, common, range(7))) == list(range(7))


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
        limit = final(training_set, choice, crew).neighbourhood_.limit
        return [judged.probabilities.tolist(), judged.chosen, choice, limit]

    with workers(scheduler=address) as far:
        assert learned(ALONE) == learned(far)


@pytest.mark.long
def test_families_are_compared_alike_whoever_does_the_folds(reference_scene: Scene) -> None:
    measured = measure(synthesise(reference_scene, 300, 3), FEATURES.split(","))

    def compared(crew: Workers) -> list[dict[str, Any]]:
        rows = select(measured, families=FAMILIES[:2], n_folds=2, crew=crew)
        return [{name: value for name, value in row.items() if name not in ("fit_s", "predict_us")} for row in rows]

    with workers(2) as two:
        assert compared(ALONE) == compared(two)


@pytest.mark.long
def test_a_command_does_its_work_on_a_cluster(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, models = str(tmp_path / "data"), [tmp_path / name for name in ("far.npz", "two.npz", "one.npz")]
    assert (
        run(["generate", "reference", "-n", "400", "-o", data, "--shard-signals", "256", "--scheduler", address]) == 0
    )
    for model, way in zip(models, (["--scheduler", address], ["--jobs", "2"], []), strict=True):
        assert run(["train", data, "-o", str(model), "--family", "linear", "--features", FEATURES, *way]) == 0
    assert len({model.read_bytes() for model in models}) == 1
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.long
def test_what_dask_logs_is_kept_off_the_terminal(address: str) -> None:
    logs = [logging.getLogger(name) for name in ("distributed.client", "distributed.scheduler", "tornado.application")]
    before = [log.level for log in logs]
    with workers(scheduler=address):
        assert not any(log.isEnabledFor(logging.CRITICAL) for log in logs)
    assert [log.level for log in logs] == before


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
@pytest.mark.parametrize("way", WAYS)
def test_parts_that_cannot_be_made_are_told(way: str, address: str) -> None:
    def parts() -> Iterator[int]:
        yield from range(3, 30)
        raise BadData("shard 5 is damaged")

    with crew_of(way, address) as crew, pytest.raises(BadData, match="shard 5 is damaged"):
        list(crew.each(positive, "radius", parts()))


@pytest.mark.long
def test_a_folder_that_is_not_shared_is_told(
    reference_scene: Scene, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shards, "_anywhere", lambda asked: moved(asked, tmp_path / "empty"))
    with pytest.raises(CannotCreate, match="other"):
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
    with pytest.raises(ClusterFailed, match=r"must have numpy 1\.0 as this process, for the same results, got \d"):
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
    monkeypatch.setattr(cluster, "PATIENCE", 0.5)
    assert run(["generate", "reference", "-o", str(tmp_path / "d"), "--scheduler", "tcp://127.0.0.1:9"]) == 69
    error = capsys.readouterr().err
    assert re.fullmatch(r"cgid: error: tcp://127\.0\.0\.1:9: a dask scheduler must answer there within .*\n", error)
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize("scheduler", ["", "127.0.0.1:8786", "tcp://host", "http://host:1", "tcp://host:eight"])
def test_what_is_no_address_is_refused(scheduler: str) -> None:
    with pytest.raises(InvalidValue, match="scheduler must be an address such as"), workers(scheduler=scheduler):
        pass


def test_tls_without_certificates_is_refused() -> None:
    with pytest.raises(InvalidValue, match=r"certificates.*tcp://"), workers(scheduler="tls://127.0.0.1:9"):
        pass


def test_dask_is_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"pip install 'cgid\[cluster\]'"), workers(scheduler="tcp://host:1"):
        pass


def test_jobs_and_a_scheduler_exclude_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    way = ["--jobs", "2", "--scheduler", "tcp://host:1"]
    for command in (["generate", "reference", "-o", "d"], ["train", "reference", "-o", "m.npz"]):
        assert run([*command, *way]) == 2
        assert "--jobs is for this machine, --scheduler for a cluster" in capsys.readouterr().err
    assert run(["generate", "caving", "-o", "d.h5", "--scheduler", "tcp://host:1"]) == 65
    assert "--scheduler is for datasets" in capsys.readouterr().err
    with pytest.raises(InvalidValue, match="jobs"), workers(0):
        pass


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


@pytest.mark.long
def test_a_process_that_dies_is_told(tmp_path: Path) -> None:
    with workers(2) as crew:
        with pytest.raises(ClusterFailed, match=r"^jobs: a worker process was ended from outside"):
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
        pytest.raises(ClusterFailed, match="several workers have died of the same"),
    ):
        list(crew.each(fatal, f"{tmp_path}|99", range(6)))
    two_workers.scheduler.allowed_failures = 3


@pytest.mark.long
@pytest.mark.parametrize("mended", [False, True])
def test_joblib_alone_does_not_hear_of_a_part_that_is_given_up(
    two_workers: Any, address: str, tmp_path: Path, mended: bool
) -> None:
    """So it waits for ever. When this fails joblib does, and our own backend can go."""
    two_workers.scheduler.allowed_failures = 0
    told: list[Any] = []
    with Client(address, set_as_default=False) as client:
        backend = cluster._cluster_backend(client) if mended else DaskDistributedBackend(client=client)
        backend.start_call()
        batch = BatchedCalls([(fatal, (f"{tmp_path}|99", 1), {})], (None, 1))
        assert isinstance(backend.submit(batch, told.append).exception(timeout=60), KilledWorker)
        backend.stop_call()
    assert [type(one) for one in told] == [KilledWorker] * mended
    two_workers.scheduler.allowed_failures = 3
