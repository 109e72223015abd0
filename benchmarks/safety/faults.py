"""Disk faults: for every command that writes, each of its calls fails in turn.

    python benchmarks/safety/faults.py                       # k = 1..50, ENOSPC and EACCES: half an hour
    python benchmarks/safety/faults.py --most 5 --only table # some of it

In each run, the k-th writing call (open, write, fsync, rename, ...; `failing_calls.c`) fails: with ENOSPC as on a disk
that is full from then on, with EACCES once. The command runs in an empty folder, and with --overwrite over older files.
It must end with exit code 73 or 74 and one line on stderr and leave the old files, byte for byte, and no others; in a
folder that is being overwritten each file is old or new. If it
can do without the call, it must make everything that an undisturbed run makes. Signals at the k-th call are judged
likewise: Ctrl-C (130) keeps the old files; kill -9 leaves under every name either the old bytes or the new.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
#: Exit codes of `CannotCreate` and `WriteFailed`.
CANNOT_CREATE, WRITE_FAILED, INTERRUPTED = 73, 74, 130
Files = dict[str, bytes]


@dataclass(frozen=True)
class Command:
    """A command that writes.

    arguments : {here} is the folder for the output, {inputs} that of the input
    older : arguments of the run that makes the files to overwrite
    unfinished : pattern of the files that a failed run may leave
    """

    name: str
    arguments: tuple[str, ...]
    older: tuple[str, ...]
    unfinished: str = "(?!)"


def _command(name: str, arguments: str, *, older: str = "", **rest: Any) -> Command:
    words = arguments.split()
    return Command(name, tuple(words), tuple((older or arguments).split()), **rest)


#: An unfinished folder: its description, its sums, its lock, and whole files.
_SHARDS = r"data/(|shard-\d+\.h5|recording-\d+\.h5|description\.json|SHA256SUMS|\.lock)"
_SIGNALS = "generate {inputs}/short.toml -n 48 --seed"
_TABLE = "generate reference -n 400 --features-only --features peak_force,width_50 --seed"
_STREAM = "generate {inputs}/brief.toml --seed"
#: A stream instead of single signals: 1.6 MB of samples.
_BRIEF = """
[stream]
duration = "2 s"
arrivals = { rate = "8 Hz" }
mixture = { times = ["0 s", "2 s"], gangue = [0.1, 0.9] }
rebounds = { most = 1, least_speed = "0.1 m/s" }
"""
COMMANDS = (
    _command("generate: folder", f"{_SIGNALS} 1 --set shard_signals=16 -o {{here}}/data", unfinished=_SHARDS),
    _command("generate: file", f"{_SIGNALS} 1 -o {{here}}/data.h5"),
    _command("generate: gzip", f"{_SIGNALS} 1 --set compression=gzip -o {{here}}/data.h5"),
    _command("generate: recording", f"{_STREAM} 1 -o {{here}}/data.h5"),
    _command("generate: recordings", f"{_STREAM} 1 -n 3 -o {{here}}/data", unfinished=_SHARDS),
    _command("generate: table, HDF5", f"{_TABLE} 1 -o {{here}}/table.h5"),
    _command("generate: table, CSV", f"{_TABLE} 1 -o {{here}}/table.csv"),
    _command("generate: table, Parquet", f"{_TABLE} 1 -o {{here}}/table.parquet"),
    _command("export", "export {inputs}/data.h5 -o {here}/one.h5"),
    _command("train", "train {inputs}/data.h5 --plots -o {here}/m.npz"),
    _command("plot: PNG", "plot {inputs}/sample.csv -o {here}/p.png"),
    _command("plot: SVG", "plot {inputs}/sample.csv -o {here}/p.svg"),
    _command("plot: PDF", "plot {inputs}/sample.csv -o {here}/p.pdf"),
    _command("predict: report", "predict {inputs}/sample.csv --report {here}/r.html"),
)


@dataclass(frozen=True)
class Ending:
    """The end of a command.

    code : exit code; minus the signal that ended it
    calls : number of writing calls
    err : text on stderr
    """

    code: int
    calls: int
    err: str


class Server:
    """Runs commands with faults, in copies of one process.

    folder : for printed text and the library that makes calls fail
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "default"}
        environment["LD_PRELOAD"] = str(_built(folder))
        command = [sys.executable, str(HERE / "fault_server.py")]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, cwd=folder, text=True
        )

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.wait()

    def run(self, arguments: Sequence[str], **asked: Any) -> Ending:
        """Run a command and return its end; `fault_server.py` lists the requests."""
        err = self._folder / "err.txt"
        asked = {"arguments": list(arguments), "out": os.devnull, "err": str(err), **asked}
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(asked) + "\n")
        self.process.stdin.flush()
        answer = json.loads(self.process.stdout.readline())
        return Ending(**answer, err=err.read_text())


def _built(folder: Path) -> Path:
    library = folder / "failing_calls.so"
    if not library.exists():
        source = HERE / "failing_calls.c"
        subprocess.run(["gcc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
    return library


def files_in(folder: Path) -> Files:
    """Return the content of every file below a folder by name; folders end in / and have none."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        found[name + "/" * path.is_dir()] = b"" if path.is_dir() else path.read_bytes()
    return found


@dataclass
class Trial:
    """A command, the files that it finds, and the files that an undisturbed run makes.

    inputs, here : folders of input and output
    old, new : files before and after an undisturbed run
    calls : number of writing calls
    """

    command: Command
    server: Server
    inputs: Path
    here: Path
    old: Files = field(default_factory=dict)
    new: Files = field(default_factory=dict)
    calls: int = 0

    def prepare(self, *, overwrite: bool) -> None:
        """Run the command undisturbed to learn what it makes."""
        self._lay({})
        if overwrite:
            # Any bytes will do for a file; a folder must look like one of cgid.
            arguments = [word if word != "1" else "2" for word in self._words(self.command.older)]
            assert self.server.run(arguments).code == 0, self.server.run(arguments).err
            self.old = files_in(self.here)
            self.old = {n: c + b"old" * (not n.endswith("/") and "data/" not in n) for n, c in self.old.items()}
        self._lay(self.old)
        self.overwrite = overwrite
        ended = self.run()
        assert ended.code == 0, ended.err
        self.new, self.calls = files_in(self.here), ended.calls

    def run(self, **faults: Any) -> Ending:
        """Run the command with faults over the old files."""
        self._lay(self.old)
        arguments = [*self._words(self.command.arguments), *(["--overwrite"] if self.overwrite else [])]
        return self.server.run(arguments, below=f"{self.here}/", **faults)

    def _words(self, words: Sequence[str]) -> list[str]:
        return [word.replace("{here}", str(self.here)).replace("{inputs}", str(self.inputs)) for word in words]

    def _lay(self, files: Mapping[str, bytes]) -> None:
        shutil.rmtree(self.here, ignore_errors=True)
        self.here.mkdir()
        for name, content in files.items():
            path = self.here / name
            path.mkdir() if name.endswith("/") else path.write_bytes(content)


def judge_failure(trial: Trial, ended: Ending) -> str:
    """Return the fault in the end of a command with a failed call, or nothing."""
    left = files_in(trial.here)
    code = ended.code
    if code == 0:
        return "" if left == trial.new and "error" not in ended.err else "exit code 0, and not what it should have made"
    if code not in (CANNOT_CREATE, WRITE_FAILED):
        return f"exit code {code}: {ended.err[-300:]}"
    lines = ended.err.splitlines()
    if len([line for line in lines if line.startswith("cgid: error: ")]) != 1 or "Traceback" in ended.err:
        return f"said {ended.err[-300:]!r}"
    return _not_as_before(trial, left)


def judge_interruption(trial: Trial, ended: Ending) -> str:
    left = files_in(trial.here)
    code = ended.code
    if code == 0:
        return "" if left == trial.new else "exit code 0, and not what it should have made"
    if code != INTERRUPTED or "Traceback" in ended.err:
        return f"exit code {code}: {ended.err[-300:]}"
    if left == trial.new:
        return ""  # the signal came too late
    return _not_as_before(trial, left)


def judge_kill(trial: Trial, ended: Ending) -> str:
    if ended.code not in (-signal.SIGKILL, 0):
        return f"exit code {ended.code}: {ended.err[-300:]}"
    for name, content in files_in(trial.here).items():
        known = (trial.old.get(name), trial.new.get(name))
        if content not in known and not name.endswith(".part") and not re.fullmatch(trial.command.unfinished, name):
            return f"{name} is neither old nor new"
    return ""


def _not_as_before(trial: Trial, left: Files) -> str:
    for name, content in trial.old.items():
        if re.fullmatch(trial.command.unfinished, name):
            if left.get(name, content) not in (content, trial.new.get(name)) and not name.endswith("SHA256SUMS"):
                return f"{name} is neither old nor new"
        elif left.get(name) != content:
            return f"old {name} is {'gone' if name not in left else 'changed'}"
    for name in left.keys() - trial.old.keys():
        if name.endswith(".part"):
            return f"temporary {name} is left"
        if not re.fullmatch(trial.command.unfinished, name):
            return f"{name} is left"
    return ""


#: Events at the k-th call: the request to the server, and the judge.
FAULTS = {
    "ENOSPC": ({"errno": errno.ENOSPC, "lasting": 1}, judge_failure),
    "EACCES": ({"errno": errno.EACCES, "lasting": 0}, judge_failure),
    "Ctrl-C": ({"signal": int(signal.SIGINT)}, judge_interruption),
    "kill -9": ({"signal": int(signal.SIGKILL)}, judge_kill),
}


def sweep(trial: Trial, fault: str, calls: Sequence[int]) -> tuple[int, list[str]]:
    """Make each of some calls fail in turn; return their number, and the faults."""
    asked, judge = FAULTS[fault]
    wrong, done = [], 0
    for number in calls:
        if number > trial.calls:
            break
        done += 1
        if problem := judge(trial, trial.run(first=number, **asked)):
            wrong.append(
                f"{trial.command.name}{', --overwrite' * bool(trial.old)}, {fault} at call {number}: {problem}"
            )
    return done, wrong


@contextmanager
def inputs(server: Server, folder: Path) -> Iterator[Path]:
    scenes = ROOT / "datasets"
    folder.mkdir()
    reference = (scenes / "reference.toml").read_text()
    (folder / "short.toml").write_text(re.sub(r"\nsamples = \d+", "\nsamples = 512", reference))
    brief = re.sub(r"\n(samples|pre_trigger|jitter) = .*", "", reference)
    (folder / "brief.toml").write_text(re.sub("relative_noise = .*", 'absolute_noise = "10 N"', brief) + _BRIEF)
    shutil.copy(scenes / "sample.csv", folder)
    made = server.run(["generate", "reference", "-n", "800", "-o", str(folder / "data.h5")])
    assert made.code == 0, made.err
    yield folder


def load(server: Server, command: Command, folder: Path, inputs: Path) -> None:
    here = folder / "load"
    here.mkdir()
    words = [word.replace("{here}", str(here)).replace("{inputs}", str(inputs)) for word in command.arguments]
    loaded = server.run(words, here=True)
    assert loaded.code == 0, loaded.err
    shutil.rmtree(here)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, default=50, help="calls that fail, from the first")
    parser.add_argument("--only", default="", help="commands with this in their name")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    arguments = parser.parse_args()
    print(f"| command | writes by calls, new / old | {' | '.join(arguments.faults)} |")
    print("|" + "---|" * (2 + len(arguments.faults)))
    wrong: list[str] = []
    total = 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with Server(folder) as server, inputs(server, folder / "inputs") as read:
            for command in COMMANDS:
                if arguments.only not in command.name:
                    continue
                load(server, command, folder, read)
                cells, calls = dict.fromkeys(arguments.faults, 0), []
                for overwrite in (False, True):
                    trial = Trial(command, server, read, folder / "here")
                    trial.prepare(overwrite=overwrite)
                    calls.append(trial.calls)
                    for fault in arguments.faults:
                        done, bad = sweep(trial, fault, range(1, arguments.most + 1))
                        cells[fault] += done
                        wrong += bad
                total += sum(cells.values())
                print(
                    f"| {command.name} | {calls[0]} / {calls[1]} | {' | '.join(map(str, cells.values()))} |", flush=True
                )
    print(f"\n{total} disturbed runs, {len(wrong)} went wrong")
    print("\n".join(wrong))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
