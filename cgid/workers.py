"""One executor for work that consists of parts: this process, several processes, or those of a cluster.

joblib distributes the parts on this machine, dask.distributed on a cluster. A part is a function of what all parts have
in common and of what is its own, so its result does not depend on who computes it. No process is forked: joblib starts
new ones, on Windows, too (not tested).
"""

from __future__ import annotations

import logging
import math
import platform
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from itertools import islice
from typing import Any, TypeVar

from cgid.errors import ClusterFailed, InvalidValue, MissingExtra

#: The scheduler must answer and have a worker within this time [s].
PATIENCE = 10.0
#: A run waits this long without any worker [s]: a dead one may be started again.
DESERTED = 60.0
#: The workers are counted again after this time [s]: a cluster may grow.
_RECOUNT = 1.0
#: What all parts have in common is sent with each part up to this size, and survives every worker; else to each worker.
_SMALL = 1 << 20
#: Libraries that the last digits of a result depend on, or whether it arrives.
_LIBRARIES = ("cgid", "numpy", "scipy", "numba", "h5py", "scikit-learn", "joblib", "distributed")
_ADDRESS = re.compile(r"(tcp|tls)://.+:[0-9]+")

Common = TypeVar("Common")
Part = TypeVar("Part")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """The executor; see `workers`.

    Attributes
    ----------
    jobs : int
        Processes on this machine; 1: this one.
    client : distributed.Client or None
        The connection to a cluster.
    """

    jobs: int = 1
    client: Any = None

    @property
    def alone(self) -> bool:
        """Whether this process does everything itself."""
        return self.jobs == 1 and self.client is None

    @property
    def elsewhere(self) -> bool:
        """Whether other machines do the work, which share one folder."""
        return self.client is not None

    def each(
        self,
        function: Callable[[Common, Part], Result],
        common: Common,
        parts: Iterable[Part],
        *,
        ordered: bool = True,
    ) -> Generator[Result, None, None]:
        """Yield `function(common, part)` for each part; closing the generator cancels the rest.

        What is running on a cluster then cannot be stopped: it ends, and its result is not used.

        Parameters
        ----------
        function : callable
            Of a module that the workers have as well.
        common, parts
            Can be pickled.
        ordered : bool
            Whether results come in the order of the parts, or when they are done.

        Raises
        ------
        ClusterFailed
            The scheduler is lost, no worker is left, or a part has ended several workers; a process of this machine
            was ended from outside.
        CgidError
            What the function raises, whoever runs it.

        Examples
        --------
        >>> list(Workers().each(pow, 2, [1, 2, 3]))
        [2, 4, 8]
        """
        if self.alone:
            for part in parts:
                yield function(common, part)
            return
        with closing(
            (self._here if self.client is None else self._on_cluster)(function, common, parts, ordered)
        ) as made:
            yield from made

    def _here(self, function: Any, common: Any, parts: Iterable[Any], ordered: bool) -> Generator[Any, None, None]:
        """Have processes of this machine do the parts."""
        from concurrent.futures import BrokenExecutor

        import joblib

        failures: list[BaseException] = []
        tasks = (joblib.delayed(_do)(function, common, part) for part in _until_failure(parts, failures))
        way = "generator" if ordered else "generator_unordered"
        results = joblib.Parallel(n_jobs=self.jobs, batch_size=1, return_as=way)(tasks)
        try:
            for result in results:  # noqa: UP028 - `yield from` would pass an interruption on before the warning is off
                yield result
            if failures:
                raise failures[0]
        except BrokenExecutor as error:
            raise ClusterFailed(
                "jobs: a worker process was ended from outside, as they are where memory is short; take fewer jobs"
            ) from error
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # cancelled work is what an interruption is for
                results.close()

    def _on_cluster(
        self, function: Any, common: Any, parts: Iterable[Any], ordered: bool
    ) -> Generator[Any, None, None]:
        """Have the workers of the cluster do the parts, a few more at once than they have threads."""
        import asyncio
        from concurrent.futures import CancelledError

        import cloudpickle
        from distributed.scheduler import KilledWorker

        given = common
        if len(cloudpickle.dumps(common)) > _SMALL:
            # Not by its hash: dask would confuse it with the same data of a run before that it is just deleting.
            given = self.client.scatter(common, broadcast=True, hash=False)
        versions, rest, running = _versions(), iter(parts), list[Any]()
        most, counted = 2, -math.inf
        try:
            while True:
                if time.monotonic() - counted > _RECOUNT:
                    most, counted = max(2, 2 * self._threads()), time.monotonic()
                for part in islice(rest, most - len(running)):
                    running.append(self.client.submit(_do_alike, versions, function, given, part, pure=False))
                if not running:
                    return
                done = self._first_done(running[:1] if ordered else running)
                running.remove(done)
                yield done.result()
        except KilledWorker as error:
            raise ClusterFailed(
                "cluster: several workers have died of the same part, as they do where memory is short; give them more "
                "of it, fewer threads, or ask for smaller shards"
            ) from error
        except (CancelledError, asyncio.CancelledError) as error:
            raise ClusterFailed(
                "cluster: the scheduler is lost, or has dropped the work; start it, and go on (--resume)"
            ) from error
        finally:
            with suppress(OSError, TimeoutError, RuntimeError):
                self.client.cancel(running)

    def _threads(self) -> int:
        """Return the number of threads of all workers of the cluster; a lost connection is reported elsewhere."""
        with suppress(OSError, RuntimeError, TimeoutError):
            return sum(self.client.ncores().values())
        return 0

    def _first_done(self, running: list[Any]) -> Any:
        """Return the first part that has ended, however it did; raises `ClusterFailed` where no worker is left."""
        from distributed import wait

        seen = time.monotonic()
        while True:
            with suppress(TimeoutError), self.client.as_current():
                wait(running, timeout=min(1.0, DESERTED / 4), return_when="FIRST_COMPLETED")
            done = next((part for part in running if part.done()), None)
            if done is not None:
                return done
            if self._threads():
                seen = time.monotonic()
            if time.monotonic() - seen > DESERTED:
                raise ClusterFailed(
                    f"cluster: no worker is left since {DESERTED:g} s; start some, and go on with --resume"
                )


#: This process does everything itself.
ALONE = Workers()


@contextmanager
def workers(jobs: int = 1, scheduler: str | None = None) -> Iterator[Workers]:
    """Yield the executor, for this context.

    Parameters
    ----------
    jobs : int
        Processes on this machine; ignored with a scheduler.
    scheduler : str, optional
        Address of a dask scheduler, such as tcp://192.168.0.7:8786: all workers it has, or gets, do the work.

    Raises
    ------
    ClusterFailed
        The scheduler does not answer, has no workers, or a worker has other versions of what decides on the results.
    InvalidValue
        This is no address, or `jobs` is below 1.
    MissingExtra
        dask.distributed is not installed.
    """
    if jobs < 1:
        raise InvalidValue(f"jobs must be 1 or more, got {jobs}")
    if scheduler is None:
        yield Workers(jobs)
        return
    if not _ADDRESS.fullmatch(scheduler):
        raise InvalidValue(f"scheduler must be an address such as tcp://192.168.0.7:8786, got {scheduler!r}")
    try:
        from distributed import Client, Security
    except ImportError:
        raise MissingExtra(
            "a cluster needs dask.distributed, which is not installed: pip install 'cgid[cluster]'"
        ) from None
    if scheduler.startswith("tls") and Security().get_connection_args("client")["ssl_context"] is None:
        raise InvalidValue(
            f"scheduler {scheduler}: tls:// needs certificates, which dask's configuration must name "
            "(distributed.comm.tls), and does not; give them, or an address tcp://..."
        )
    with _quiet():
        try:
            client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, RuntimeError):
            raise ClusterFailed(
                f"{scheduler}: a dask scheduler must answer there within {PATIENCE:g} s, none does; start one (dask "
                "scheduler), or correct the address"
            ) from None
        try:
            _require_workers(client, scheduler)
            yield Workers(jobs, client)
        finally:
            with suppress(OSError, TimeoutError, RuntimeError):
                client.close(timeout=2)


def _require_workers(client: Any, scheduler: str) -> None:
    """Raise `ClusterFailed` unless there is a worker, and all have what this process has."""
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError:
        raise ClusterFailed(
            f"{scheduler}: must have workers, none came within {PATIENCE:g} s; start some (dask worker {scheduler})"
        ) from None
    for worker, found in client.run(_versions, on_error="return").items():
        _require_alike(_versions(), found, worker)


def _require_alike(expected: dict[str, str], found: Any, worker: str) -> None:
    if isinstance(found, Exception):
        raise ClusterFailed(f"worker {worker}: must have cgid {expected['cgid']}, and cannot load it ({found})")
    for name, here in expected.items():
        there = found.get(name)
        if there != here:
            raise ClusterFailed(
                f"worker {worker}: must have {name} {here} as this process, for the same results, got "
                f"{there or 'none'}; install alike"
            )


@cache
def _versions() -> dict[str, str]:
    def of(name: str) -> str:
        with suppress(ImportError):
            return version(name)
        return ""

    return {"Python": ".".join(platform.python_version_tuple()[:2])} | {name: of(name) for name in _LIBRARIES}


def _until_failure(parts: Iterable[Part], failures: list[BaseException]) -> Iterator[Part]:
    """Yield the parts until making one fails; the failure is kept, since joblib asks in threads and would lose it."""
    try:
        yield from parts
    except Exception as error:
        failures.append(error)


def _do_alike(expected: dict[str, str], function: Any, common: Any, part: Any) -> Any:
    """Do a part on a worker, which may have joined after the versions were compared."""
    _require_alike(expected, _versions(), platform.node())
    return _do(function, common, part)


def _do(function: Any, common: Any, part: Any) -> Any:
    # Ctrl-C reaches every process of the group; the one that waits for the workers answers it.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return function(common, part)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the log of dask and its libraries off the terminal: what matters is raised."""
    # Each by its name: dask gives some of them levels and handlers of their own.
    chosen = re.compile(r"(distributed|tornado|asyncio)(\..+)?")
    logs = [logging.getLogger(name) for name in list(logging.root.manager.loggerDict) if chosen.fullmatch(name)]
    before = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for log, level in zip(logs, before, strict=True):
            log.setLevel(level)
