"""One executor for parallel work: in this process, in several processes, or on a cluster, by joblib.

Each result depends only on the common data and its part, not on the worker. Processes are started anew, never forked.
"""

from __future__ import annotations

import logging
import os
import platform
import re
import signal
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import Any, TypeVar

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid.errors import INTERRUPTIONS, ClusterFailed, InvalidValue, Stopped, optional

#: The scheduler must answer and have a worker within this time [s].
TIMEOUT = 10.0
#: Wait this long without any worker [s]: a dead one may be restarted.
DESERTED = 60.0
#: Maximum number of processes on this machine.
MAX_JOBS = 1024
#: Up to this size, the common data are sent with each part and survive the loss of any worker; larger data are sent
#: once to each worker [bytes].
_SMALL = 1 << 20
#: Libraries that affect the last digits of a result or its transport.
_LIBRARIES = ("cgid", "numpy", "scipy", "numba", "h5py", "scikit-learn", "joblib", "distributed")
#: With this, Python imports nothing from the folder in which it starts; then it is told the path of its parent.
_SAFE = {"PYTHONSAFEPATH": "1"}
_ADDRESS = re.compile(r"(tcp|tls)://.+:[0-9]+")

Common = TypeVar("Common")
Part = TypeVar("Part")
Result = TypeVar("Result")


def _never() -> bool:
    return False


@dataclass(frozen=True)
class Workers:
    """The executor; made by `workers`."""

    jobs: int = 1  # number of processes on this machine; 1 is this process
    client: Any = None  # `distributed.Client` of a cluster, or None
    stopped: Callable[[], bool] = _never  # asked before each part; once true, work ends with `Stopped`

    @property
    def is_serial(self) -> bool:
        """Whether this process does all the work itself."""
        return self.jobs == 1 and self.client is None

    def each(
        self,
        function: Callable[[Common, Part], Result],
        common: Common,
        parts: Iterable[Part],
        *,
        ordered: bool = True,
    ) -> Generator[Result, None, None]:
        """Yield `function(common, part)` for each part, in order or as they finish; arguments are pickled.

        >>> list(Workers().each(pow, 2, [1, 2, 3]))
        [2, 4, 8]
        """
        # Closing the generator cancels the other parts; those running on a cluster finish, and their results are
        # dropped.
        if self.is_serial:
            for part in parts:
                self._go_on()
                yield function(common, part)
            return
        import joblib

        executor: dict[str, Any] = {"n_jobs": self.jobs}
        versions, given = None, common
        if self.client is not None:
            executor = {"backend": _cluster_backend(self.client)}
            versions, given = _versions(), self._sent(common)
        failures: list[BaseException] = []
        # A list is sent with its part; joblib may leave other arguments on one worker, with which they would be lost.
        tasks = (joblib.delayed(_do)([versions, function, given, part]) for part in _until_failure(parts, failures))
        way = "generator" if ordered else "generator_unordered"
        results: Any = None
        hook, threading.excepthook = threading.excepthook, _hook_for_executors(threading.excepthook)
        try:
            with _safe_paths():  # to the end: a process that dies is replaced
                with _deaf_children():
                    results = joblib.Parallel(batch_size=1, return_as=way, **executor)(tasks)
                for result in results:
                    self._go_on()
                    yield result
            if failures:
                raise failures[0]
        except Exception as error:
            if failed := _cluster_failed(error):
                raise failed from error
            raise
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # joblib warns of cancelled work, which is intended
                if results is not None:
                    results.close()
            threading.excepthook = hook

    def all(
        self,
        function: Callable[[Common, Part], Result],
        common: Common,
        parts: Iterable[Part],
        progress: Callable[[int], object] | None = None,
    ) -> list[Result]:
        """Return what `each` yields, and count it in `progress`."""
        found = []
        with closing(self.each(function, common, parts)) as results:
            for one in results:
                found.append(one)
                if progress is not None:
                    progress(1)
        return found

    def _go_on(self) -> None:
        if self.stopped():
            raise Stopped("the work was stopped; start it again")

    def _sent(self, common: Any) -> Any:
        """Return a reference to the common data for each part of a cluster's work."""
        import cloudpickle

        if len(cloudpickle.dumps(common)) <= _SMALL:
            return common
        # With a hash as key, dask would confuse the data with those of an earlier run that it is deleting.
        return self.client.scatter(common, broadcast=True, hash=False)

    def each_in_step(
        self, function: Callable[[Common, Part], Result], common: Common, parts: Iterable[Part]
    ) -> Generator[Result, None, None]:
        """Yield as `each` does, in order, but start at most two parts a process ahead of the reader; local only."""
        # So `parts` may be unlimited, and a slow reader does not fill the memory.
        if self.is_serial:
            yield from self.each(function, common, parts)
            return
        from concurrent.futures import Future

        from joblib.externals.loky.process_executor import ProcessPoolExecutor

        with _safe_paths():  # its queues start a process, too
            executor = ProcessPoolExecutor(self.jobs, timeout=300, env=_SAFE)
        running: deque[Future[Result]] = deque()
        try:
            for part in parts:
                with _safe_paths(), _deaf_children():
                    running.append(executor.submit(_do, [None, function, common, part]))
                if len(running) > 2 * self.jobs:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
        except Exception as error:
            if failed := _cluster_failed(error):
                raise failed from error
            raise
        finally:
            # Killing the workers instead would race with the thread that hands out the parts.
            for future in running:
                future.cancel()
            executor.shutdown(wait=True)


def _cluster_backend(client: Any) -> Any:
    """Return joblib's backend for dask, which unpatched waits forever for a part that dask has given up."""
    import asyncio
    from concurrent.futures import CancelledError

    from joblib._dask import DaskDistributedBackend

    class Backend(DaskDistributedBackend):  # type: ignore[misc]
        def start_call(self) -> None:
            super().start_call()
            self.waiting = set[Any]()
            self.client.loop.add_callback(self._give_up_without_workers)

        async def _give_up_without_workers(self) -> None:
            seen = time.monotonic()
            while self._continue and time.monotonic() - seen < DESERTED:
                with suppress(OSError, RuntimeError, TimeoutError):
                    seen = time.monotonic() if await self.client.scheduler.ncores() else seen
                await asyncio.sleep(min(1.0, DESERTED / 4))
            for future in list(self.waiting if self._continue else ()):
                future.set_exception(CancelledError(f"no worker is left since {DESERTED:g} s"))

        def effective_n_jobs(self, n_jobs: int) -> int:
            with suppress(OSError, RuntimeError, TimeoutError):
                n_jobs = int(super().effective_n_jobs(n_jobs))
            return max(2, n_jobs)  # for one thread joblib would do the work in this process

        def submit(self, func: Any, callback: Any = None) -> Any:
            future = super().submit(func, callback)
            self.waiting.add(future)
            future.add_done_callback(self.waiting.discard)
            # joblib passes on the result or error of a part, but not that dask has given it up.
            future.add_done_callback(lambda done: callback(done.exception()) if done.exception() else None)
            return future

        def abort_everything(self, ensure_ready: bool = True) -> None:
            left = list(self._results)
            super().abort_everything(ensure_ready)
            with suppress(OSError, RuntimeError, TimeoutError):
                self.client.cancel(left)

    return Backend(client=client, wait_for_workers_timeout=0)


def _cluster_failed(error: Exception) -> ClusterFailed | None:
    """Return the error for a loss of workers or of a scheduler; None for the error of a part."""
    from concurrent.futures import BrokenExecutor, CancelledError

    if isinstance(error, BrokenExecutor):
        reason = "jobs: a worker process was killed, perhaps for lack of memory; use fewer jobs"
    elif type(error).__name__ == "KilledWorker":  # dask is an extra
        reason = (
            "cluster: several workers died on the same part, perhaps for lack of memory; give them more memory, fewer "
            "threads or smaller shards"
        )
    elif isinstance(error, CancelledError):
        reason = (
            f"cluster: the scheduler or all workers are lost ({getattr(error, 'reason', error)}); start some, and "
            f"continue with {spelled('resume', 'true')}"
        )
    else:
        return None
    return ClusterFailed(reason)


#: The executor of this process alone.
SERIAL = Workers()


@contextmanager
def workers(jobs: int = 1, scheduler: str | None = None) -> Iterator[Workers]:
    """Yield the executor: `jobs` local processes, or all workers of the dask `scheduler` (tcp://host:port) instead."""
    jobs = validation.whole("jobs", jobs, 1, MAX_JOBS)
    if scheduler is None:
        yield Workers(jobs)
        return
    if not _ADDRESS.fullmatch(scheduler):
        raise InvalidValue(f"scheduler must be an address such as tcp://192.168.0.7:8786, got {scheduler!r}")
    dask = optional("distributed", "a cluster needs", "cluster", name="dask.distributed")
    if scheduler.startswith("tls") and dask.Security().get_connection_args("client")["ssl_context"] is None:
        raise InvalidValue(
            f"scheduler {scheduler}: tls:// needs certificates in dask's configuration (distributed.comm.tls), there "
            "are none; add them, or give an address tcp://..."
        )
    with _quiet():
        try:
            client = dask.Client(scheduler, timeout=TIMEOUT, set_as_default=False)
        except (OSError, ValueError, RuntimeError):
            raise ClusterFailed(
                f"{scheduler}: a dask scheduler must answer there within {TIMEOUT:g} s, none does; start one "
                "(PYTHONSAFEPATH=1 dask scheduler), or correct the address"
            ) from None
        try:
            _require_workers(client, scheduler)
            yield Workers(jobs, client)
        finally:
            with suppress(OSError, TimeoutError, RuntimeError):
                client.close(timeout=2)


def _require_workers(client: Any, scheduler: str) -> None:
    """Raise `ClusterFailed` unless there is a worker and all have the library versions of this process."""
    try:
        client.wait_for_workers(1, timeout=TIMEOUT)
    except TimeoutError:
        raise ClusterFailed(
            f"{scheduler}: must have workers, none came within {TIMEOUT:g} s; start some (PYTHONSAFEPATH=1 dask worker "
            f"{scheduler})"
        ) from None
    for worker, found in client.run(_versions, on_error="return").items():
        _require_same_versions(_versions(), found, worker)


def _require_same_versions(expected: dict[str, str], versions: Any, worker: str) -> None:
    if isinstance(versions, Exception):
        raise ClusterFailed(f"worker {worker}: must have cgid {expected['cgid']}, and cannot load it ({versions})")
    for name, expected_version in expected.items():
        got = versions.get(name)
        if got != expected_version:
            raise ClusterFailed(
                f"worker {worker}: must have {name} {expected_version} like this process, for equal results, got "
                f"{got or 'none'}; install the same version"
            )


@cache
def _versions() -> dict[str, str]:
    def of(name: str) -> str:
        with suppress(ImportError):
            return version(name)
        return ""

    return {"Python": ".".join(platform.python_version_tuple()[:2])} | {name: of(name) for name in _LIBRARIES}


def _until_failure(parts: Iterable[Part], failures: list[BaseException]) -> Iterator[Part]:
    """Yield the parts until producing one fails; keep the error, which joblib would lose by iterating in threads."""
    try:
        yield from parts
    except Exception as error:
        failures.append(error)


def _do(task: list[Any]) -> Any:
    """Do a part on a worker of this machine or, given the versions, of a cluster, which may have joined it later."""
    import joblib

    versions, function, common, part = task
    if versions is not None:
        _require_same_versions(versions, _versions(), platform.node())
    # Ctrl-C and a closed terminal reach every process of the group; only the parent handles them.
    if threading.current_thread() is threading.main_thread():
        for number in {*INTERRUPTIONS} - {signal.SIGTERM}:
            signal.signal(number, signal.SIG_IGN)
    with joblib.parallel_config(backend="sequential"):  # a part is not itself spread over the cluster
        return function(common, part)


def _hook_for_executors(hook: Callable[[Any], object]) -> Callable[[Any], object]:
    """Return the hook without the traceback of loky's thread, which while shutting down looks for cancelled parts."""

    def quiet(told: Any) -> None:
        flags = getattr(told.thread, "executor_flags", None)  # None in any other thread
        if not getattr(flags, "shutdown", False):
            hook(told)

    return quiet


@contextmanager
def _safe_paths() -> Iterator[None]:
    """Start processes that import nothing from the folder of the user's recordings, unless this one does."""
    before = {name: os.environ.pop(name) for name in _SAFE if name in os.environ}
    os.environ.update(_SAFE)
    try:
        yield
    finally:
        os.environ.pop("PYTHONSAFEPATH", None)
        os.environ.update(before)


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach, from their first instruction; ours follows at the end."""
    # A process inherits the mask of the thread that starts it. Windows has no masks, and `_do` is what it has.
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # it clears the mask when it starts
    noted: list[int] = []
    # Another thread of this process may take the signal, and Python would act here.
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    if is_main:
        signal.signal(signal.SIGINT, lambda number, _: noted.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if is_main:
            signal.signal(signal.SIGINT, handler)
        if noted:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the logs of dask and its libraries; errors that matter are raised."""
    # Set each logger: dask gives some of them their own levels and handlers.
    pattern = re.compile(r"(distributed|tornado|asyncio)(\..+)?")
    logs = [logging.getLogger(name) for name in list(logging.root.manager.loggerDict) if pattern.fullmatch(name)]
    before = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for log, level in zip(logs, before, strict=True):
            log.setLevel(level)
