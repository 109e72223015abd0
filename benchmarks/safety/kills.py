"""Remains of `cgid generate` after kill -9, and whether `--resume` completes it to the byte.

    python benchmarks/safety/kills.py [--kills 200] [--with-workers 20] [--seed 1] [--folder DIR]

A trial starts a generation in a separate process, kills it, and continues with `resume`, which is also killed every
other time. Half of the moments are anywhere in the time of a whole run. The others are just before or just after a
name changes: the process kills itself, by a hook of the interpreter (sys.addaudithook) that sees system calls on files
before they run. With two workers only their parent is killed, as soon as a name has changed in the folder; the workers
outlive it for a while, and the run is resumed in parallel to them.

After each kill, every file under its final name must equal that of an uninterrupted run, or of the older data to be
overwritten, and what can be read must be one of the two. After the last resume nothing may differ from an uninterrupted
run, and nothing may be left over. With `--overwrite` at once, a run with two workers is killed, and one of another seed
replaces it while the workers are still writing.
"""

import argparse
import contextlib
import hashlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cgid.errors import BadData
from cgid.scene import generate, generate_recordings, parse_scene
from cgid.store.folder import LOCK, SUMS
from cgid.store.reading import Dataset
from cgid.store.verification import verify

#: Audit events that change names.
RENAMES = ("os.rename", "os.link", "os.remove", "os.mkdir", "os.rmdir")
EVENTS = (*RENAMES, "open")

ROCKS = {
    "density": {"distribution": "uniform", "lowest": 1400, "highest": 1500},
    "youngs_modulus": "3 GPa",
    "poisson_ratio": 0.3,
    "radius": {"distribution": "uniform", "lowest": "20 mm", "highest": "30 mm"},
    "restitution": 0.5,
    "drop_height": "1 m",
}
SIGNALS: dict[str, Any] = {
    "name": "kills",
    "impact": {"stiffness": "hertz", "dissipation": "hunt-crossley", "target": "rigid"},
    "sampling": {"sampling_rate": "100 kHz", "samples": 64, "pre_trigger": 16},
    "sensor": {"relative_noise": 0.01},
    "populations": [{"label": "coal", **ROCKS}, {"label": "gangue", **ROCKS}],
}
STREAM: dict[str, Any] = {
    **SIGNALS,
    "sampling": {"sampling_rate": "100 kHz"},
    "sensor": {"absolute_noise": "10 N"},
    "stream": {"duration": "0.2 s", "arrivals": {"rate": "20 Hz"}},
    "populations": [{"label": "coal", "weight": 3, **ROCKS}, {"label": "gangue", **ROCKS}],
}


@dataclass(frozen=True)
class Kind:
    """A kind of run: its function (folder, whether to resume), and whether older data exist."""

    name: str
    make: Callable[[Path, bool], object]
    older: Callable[[Path], object] | None = None
    workers: bool = False
    last: Callable[[Path, bool], object] | None = None


def kinds() -> tuple[Kind, ...]:
    """Return all kinds; those with workers come last."""
    scene, stream = parse_scene(SIGNALS), parse_scene(STREAM)

    def dataset(path: Path, resume: bool, **options: Any) -> object:
        return generate(scene, path, 600, 1, shard_signals=50, resume=resume, **options)

    def older(path: Path) -> object:
        return generate(scene, path, 300, 2, shard_signals=60)

    def recordings(path: Path, resume: bool, seed: int = 1, **options: Any) -> object:
        return generate_recordings(stream, path, 6, seed, resume=resume, **options)

    return (
        Kind("a new dataset", dataset),
        Kind("a dataset over an older one", lambda path, resume: dataset(path, resume, overwrite=True), older),
        Kind("recordings", recordings),
        Kind(
            "recordings over older ones",
            lambda path, resume: recordings(path, resume, overwrite=True),
            lambda path: recordings(path, False, 2),
        ),
        Kind("two workers", lambda path, resume: dataset(path, resume, jobs=2), workers=True),
        Kind(
            "two workers, then another seed",
            lambda path, resume: dataset(path, resume, jobs=2),
            workers=True,
            last=lambda path, _: generate(scene, path, 600, 2, shard_signals=50, overwrite=True),
        ),
    )


def content(folder: Path) -> dict[str, str]:
    files = [path for path in folder.iterdir() if path.suffix != ".part" and path.name != LOCK]
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def started(work: Callable[[], object], moment: int | None = None, events: Path | None = None) -> int:
    """Start work in a forked process and return its id.

    The process kills itself at its event number `moment`. If given, the file `events` receives the names of all events.
    """
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        os.setsid()
        seen: list[str] = []

        def watch(event: str, _: object) -> None:
            if event in EVENTS:
                if len(seen) == moment:
                    os.kill(os.getpid(), signal.SIGKILL)
                seen.append(event)

        sys.addaudithook(watch)
        work()
        if events is not None:
            events.write_text("\n".join(seen))
        code = 0
    finally:
        os._exit(code)


def ended(process: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


class Trials:
    """Trials of one kind, against an uninterrupted run of it; `folder` is used by this kind alone."""

    def __init__(self, kind: Kind, folder: Path, draws: random.Random) -> None:
        self.kind, self.folder, self.draws, self.counts = kind, folder, draws, Counter[str]()
        folder.mkdir()
        self.output, reference, events = folder / "data", folder / "reference", folder / "events"
        # The first run, which imports for all others, is not timed. Pools of workers do not survive a fork, though.
        if kind.workers:
            self._whole_run(lambda: kind.make(reference, False))
        else:
            kind.make(reference, False)
        self.whole = content(reference)
        self._prepare()
        begin = time.perf_counter()
        self._whole_run(lambda: kind.make(self.output, False), events)
        self.seconds = time.perf_counter() - begin
        names = events.read_text().split("\n")
        near = [number for number, name in enumerate(names) if name in RENAMES]
        self.near = sorted({*near, *(number + 1 for number in near)})
        self.older, self.final = {}, self.whole
        if content(self.output) != self.whole:
            raise SystemExit(f"{kind.name}: two uninterrupted runs differ")
        if kind.older is not None:
            kind.older(folder / "older")
            self.older = content(folder / "older")
        if kind.last is not None:
            kind.last(folder / "final", False)
            self.final = content(folder / "final")

    def _whole_run(self, work: Callable[[], object], events: Path | None = None) -> None:
        process = started(work, events=events)
        code = ended(process)
        self._reap(process)
        if code:
            raise SystemExit(f"{self.kind.name}: an uninterrupted run ended with {code}")

    def _prepare(self) -> None:
        shutil.rmtree(self.output, ignore_errors=True)
        if self.kind.older is not None:
            self.kind.older(self.output)

    def run(self) -> list[str]:
        """Kill a run, resume it (killed again every other time), and return the faults."""
        self._prepare()
        wrong, process = [], self._killed(False)
        wrong += self._faults()
        while not wrong and self.kind.last is None and self.draws.random() < 0.5:
            self._reap(process)
            process = self._killed(True)
            wrong += self._faults()
        last = started(lambda: (self.kind.last or self.kind.make)(self.output, True))
        resumed = ended(last)
        time.sleep(1.0 if self.kind.last is not None else 0.0)  # what the workers still write
        for group in (process, last):
            self._reap(group)
        if resumed:
            wrong.append(f"resume ended with {resumed}")
        elif content(self.output) != self.final or verify(self.output).damage:
            wrong.append("what was resumed differs from an uninterrupted run")
        left = [path.name for path in (*self.folder.glob(".data*"), *self.output.glob(".*")) if path.name != LOCK]
        if left and not self.kind.workers:
            wrong.append(f"left over: {left}")
        return wrong

    def _killed(self, resume: bool) -> int:
        """Start a run and kill it; return its process."""
        near = self.counts["near a rename"] <= self.counts["anywhere"]
        moment = self.draws.choice(self.near) if near and not self.kind.workers else None
        process = started(lambda: self.kind.make(self.output, resume), moment)
        if near and self.kind.workers:
            self._await_names(process, self.draws.randrange(1, 20))
        elif not near:
            time.sleep(self.draws.uniform(0, self.seconds))
        if moment is None:
            os.kill(process, signal.SIGKILL)
        code = ended(process)
        self.counts["too late" if code == 0 else "near a rename" if near else "anywhere"] += 1
        return process

    def _await_names(self, process: int, changes: int) -> None:
        """Wait until names in the folder have changed this often, or the process has ended."""
        last: set[str] = set()
        while changes and os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            with contextlib.suppress(OSError):
                names = {path.name for path in self.output.iterdir()}
                changes, last = changes - (names != last), names
            time.sleep(1e-4)

    def _reap(self, process: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process, signal.SIGKILL)

    def _faults(self) -> list[str]:
        if not self.output.exists():
            return []
        there, sound = content(self.output), (self.whole, self.older)
        self.counts["finished files"] += len(there)
        wrong = [
            f"{name} bears its name and is not whole"
            for name, digest in there.items()
            if name != SUMS and digest not in {kind.get(name) for kind in sound}
        ]
        seeds = set()
        with contextlib.suppress(BadData):
            if self.kind.name.endswith("dataset") or "shard-00000.h5" in there:
                dataset = Dataset(self.output)
                seeds = {dataset.header.attributes["seed"]}
                n_read = sum(map(len, dataset.batches()))
                shards = {name: digest for name, digest in content(self.output).items() if name.startswith("shard")}
                if not any(shards.items() <= kind.items() for kind in sound) or n_read != len(dataset):
                    wrong.append(f"a mixture was read, of seed {seeds}")
        return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200, help="at least so many in all")
    parser.add_argument("--with-workers", type=int, default=20, help="of these with two workers")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", help="where the datasets go (by default a temporary folder)")
    arguments = parser.parse_args()
    draws, all_kinds = random.Random(arguments.seed), kinds()
    alone = sum(not kind.workers for kind in all_kinds)
    with_workers = [-(-arguments.with_workers // 2)] * (len(all_kinds) - alone)
    wanted = [-(-(arguments.kills - arguments.with_workers) // alone)] * alone + with_workers
    failed = 0
    print("| run | kills near a rename | anywhere | too late | finished files, all whole | wrong |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        for number, (kind, count) in enumerate(zip(all_kinds, wanted, strict=True)):
            if not count:
                continue
            trials, wrong = Trials(kind, Path(name) / str(number), draws), []
            counts = trials.counts
            while counts["near a rename"] + counts["anywhere"] < count and not wrong:
                wrong += trials.run()
            cells = [counts[cell] for cell in ("near a rename", "anywhere", "too late", "finished files")]
            print(f"| {kind.name} | {' | '.join(map(str, cells))} | {'; '.join(wrong) or 'nothing'} |", flush=True)
            failed += bool(wrong)
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
