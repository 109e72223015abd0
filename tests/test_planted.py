"""A folder of recordings may hold anything: no process that cgid starts imports a module from it."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: Every module of the standard library, and what a worker, a page or a cluster imports besides.
NAMES = (*sys.stdlib_module_names, "numpy", "scipy", "numba", "h5py", "joblib", "sklearn", "pandas", "click", "dask")
#: The modules that start processes, each with a test below; the commands of `monitor` are the user's own programs.
STARTERS = {"_lib/workers.py", "plant/commands.py"}
#: What such a module says.
STARTS = re.compile(r"subprocess|multiprocessing|ProcessPool|joblib\.Parallel|os\.(system|spawn|exec|popen)|webbrowser")
FROM_PYTHON = {
    "generate": "cgid.scene.generate('reference', 'made', 8, shard_signals=4, jobs=2)",
    "stream": "list(cgid.stream('reference', batch_size=4, n_signals=8, workers=2))",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of modules that tell when they are run, each in a file `ran-NAME` of its own."""
    data = tmp_path / "data"
    (data / "cgid").mkdir(parents=True)
    for name in NAMES:
        (data / f"{name}.py").write_text(f"open({str(tmp_path / f'ran-{name}')!r}, 'w')\n")
    for name in ("__init__", "__main__"):
        (data / "cgid" / f"{name}.py").write_text(f"open({str(tmp_path / 'ran-cgid')!r}, 'w')\n")
    return data


@pytest.fixture
def program(tmp_path: Path) -> list[str]:
    """The `cgid` that pip installs: its first path is its own folder."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "run").write_text("import sys\nfrom cgid.cli import main\nsys.exit(main())\n")
    return [sys.executable, str(tmp_path / "bin" / "run")]


def ran(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.parent.glob("ran-*"))


def do(command: list[str], folder: Path) -> None:
    done = subprocess.run(
        command, cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert ran(folder) == []
    assert done.returncode == 0, done.stderr


def test_the_trap_closes(folder: Path) -> None:
    """With `python -c`, which does import from the folder where it starts."""
    subprocess.run([sys.executable, "-c", "import random, numpy, cgid"], cwd=folder)
    assert ran(folder) == ["ran-cgid", "ran-numpy", "ran-random"]


@pytest.mark.parametrize(
    "command",
    [
        "generate reference -n 8 --set shard_signals=4 --jobs 2 -o data",
        pytest.param("train reference -n 40 --jobs 2 -o model.npz", marks=pytest.mark.long),
    ],
)
def test_workers_do_not_import_from_the_folder(command: str, folder: Path, program: list[str]) -> None:
    do([*program, *command.split()], folder)


@pytest.mark.parametrize("name", FROM_PYTHON)
def test_workers_of_a_script_have_its_path(name: str, folder: Path, tmp_path: Path) -> None:
    """The folder of the script, not the one where it is started; nor is the environment of the user changed."""
    (tmp_path / "own.py").write_text(
        f"import os, cgid.scene\nif __name__ == '__main__':\n    {FROM_PYTHON[name]}\n"
        "    assert 'PYTHONSAFEPATH' not in os.environ\n"
    )
    do([sys.executable, str(tmp_path / "own.py")], folder)


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """Yield the address of a scheduler, which is started as the guide says."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    command = [str(shutil.which("dask", path=Path(sys.executable).parent)), "scheduler", "--no-dashboard"]
    process = subprocess.Popen([*command, "--host", "127.0.0.1", "--port", str(port)], cwd=tmp_path, **quiet)
    yield f"tcp://127.0.0.1:{port}"
    process.terminate()
    process.wait()


@pytest.mark.long
def test_a_worker_of_a_cluster_does_not_import_from_the_folder(
    folder: Path, program: list[str], scheduler: str
) -> None:
    guide = (ROOT / "docs" / "how-to" / "clusters.md").read_text(encoding="utf-8")
    (setting,) = re.findall(r"(\S+)=1 dask worker tcp", guide)
    command = [str(shutil.which("dask", path=Path(sys.executable).parent)), "worker", scheduler, "--no-dashboard"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), setting: "1"}
    worker = subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.DEVNULL)
    try:
        do(
            [*program, *f"generate reference -n 8 --set shard_signals=4 -o x --set scheduler={scheduler}".split()],
            folder,
        )
    finally:
        worker.terminate()
        worker.wait()


def test_every_module_that_starts_processes_is_tried_here() -> None:
    """A module of the package that can start one belongs into `STARTERS`, and to a test."""
    files = {str(file.relative_to(ROOT / "cgid")): file for file in (ROOT / "cgid").rglob("*.py")}
    assert {name for name, file in files.items() if STARTS.search(file.read_text(encoding="utf-8"))} == STARTERS
