"""The cache of compiled kernels: what it holds is right, or it holds nothing; it never ends a run."""

import ast
import hashlib
import io
import itertools
import json
import logging
import os
import random
import re
import shutil
import stat
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numba
import numpy as np
import pytest
from packaging.requirements import Requirement

from cgid._lib import compiled, user_cache
from cgid.cli import output
from cgid.store._packing import fletcher32

PACKAGE = Path(compiled.__file__).parents[1]


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 8
    path.write_bytes(content)


def swapped(path: Path) -> None:
    """Replace a kernel by another intact kernel."""
    others = sorted(path.parent.iterdir())
    shutil.copyfile(others[(others.index(path) + 1) % len(others)], path)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


#: Damage to a file of a cache, which is repaired afterwards.
DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "garbage": lambda path: path.write_bytes(random.Random(path.name).randbytes(path.stat().st_size)),
    "a flipped bit": flipped,
    "another kernel": swapped,
    "a pipe": pipe,
    "gone": Path.unlink,
}


def add_one(number):
    return number + 1


def add_two(number):
    return number + 2


def add_three(number):
    return number + 3


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "kernels-of-a-test"
    place.mkdir(mode=0o700)
    return place


def fresh(folder: Path | None, function=add_one):
    """The function as another process would have it: not compiled yet, with the cache in a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled, "kernel_folder", lambda: folder)
        return compiled.jit(function)


def from_disk(folder: Path | None, function=add_one) -> bool:
    """Whether calling it, with the right result, found it compiled."""
    kernel = fresh(folder, function)
    assert kernel(41) == function(41)
    return bool(kernel.stats.cache_hits)


def test_what_was_compiled_is_read_in_the_next_process(folder: Path):
    assert [from_disk(folder), from_disk(folder), from_disk(folder, add_two)] == [False, True, False]
    kernel = fresh(folder)
    assert kernel(0.5) == 1.5  # other types are another file
    assert not kernel.stats.cache_hits
    assert len(list(folder.iterdir())) == 3
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in folder.iterdir())


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_files_are_compiled_anew_and_mended(folder: Path, name: str):
    functions = (add_one, add_two, add_three)
    assert not any(from_disk(folder, function) for function in functions)
    for path in sorted(folder.iterdir()):
        DAMAGES[name](path)
    assert not any(from_disk(folder, function) for function in functions)
    assert all(from_disk(folder, function) for function in functions)


def test_every_flipped_bit_is_found(folder: Path):
    from_disk(folder)
    (path,) = folder.iterdir()
    content = path.read_bytes()
    assert user_cache.read_payload(path) is not None
    chance = np.random.default_rng(7)
    for bit in chance.choice(8 * len(content), 300, replace=False):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        assert user_cache.read_payload(path) is None, bit


def test_a_file_whose_checksum_is_right_but_which_is_no_kernel_is_compiled_anew(folder: Path):
    from_disk(folder)
    (path,) = folder.iterdir()
    compiled.write_payload(path, b"no pickle")
    assert [from_disk(folder), from_disk(folder)] == [False, True]


def test_folders_for_files_and_no_folder_at_all_only_cost_time(folder: Path):
    from_disk(folder)
    (path,) = folder.iterdir()
    path.unlink()
    path.mkdir()
    assert [from_disk(folder), from_disk(folder)] == [False, False]
    assert [from_disk(None), from_disk(folder / "missing"), from_disk(Path(os.devnull))] == [False, False, False]
    assert list(folder.iterdir()) == [path]  # no temporary files


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_what_others_may_have_written_is_not_loaded(folder: Path):
    from_disk(folder)
    (path,) = folder.iterdir()
    path.chmod(0o620)
    assert not from_disk(folder)  # and replaced by a private one
    assert from_disk(folder)
    if os.getuid() == 0:
        os.chown(path, 12345, -1)
        assert not from_disk(folder)


def test_what_numba_was_told_to_make_otherwise_is_another_kernel(folder: Path, monkeypatch: pytest.MonkeyPatch):
    from_disk(folder)
    with monkeypatch.context() as patched:
        patched.setattr(numba.config, "BOUNDSCHECK", 1)
        assert [from_disk(folder), from_disk(folder)] == [False, True]
    assert from_disk(folder)


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_terminal_shows_how_many_kernels_are_compiled(
    folder: Path, monkeypatch: pytest.MonkeyPatch, is_terminal: bool
):
    shown = io.StringIO()
    monkeypatch.setattr(shown, "isatty", lambda: is_terminal)
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setattr(logging.getLogger("cgid.kernels"), "handlers", [])
    monkeypatch.setattr(compiled, "_COUNT", itertools.count(1))
    output.show_compilation()
    assert [from_disk(folder), from_disk(folder), from_disk(folder, add_two)] == [False, True, False]
    expected = [f"cgid: compiling kernels, once: {number}" for number in (1, 2)]
    assert shown.getvalue().split("\r") == ["", *expected] if is_terminal else not shown.getvalue()
    output.say("done", err=True)
    assert shown.getvalue().endswith("\rdone\n" if is_terminal else "done\n")


# Where the folder lies


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "asked"))
    return tmp_path / "asked"


def place() -> Path | None:
    return compiled.kernel_folder.__wrapped__()


def test_the_folder_is_private_and_named_by_what_the_kernels_are_made_of(asked: Path):
    found = place()
    assert found == asked / f"kernels-{compiled.digest(PACKAGE)}"
    assert stat.S_IMODE(found.stat().st_mode) == 0o700
    assert place() == found


def test_without_a_wish_it_lies_in_the_users_cache_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = place()
    assert found is not None
    if os.name == "posix" and os.uname().sysname == "Linux":
        assert found.parent == tmp_path / "cgid"


@pytest.mark.parametrize("home", [".", "/proc/nowhere", os.devnull])
def test_no_home_is_no_place(monkeypatch: pytest.MonkeyPatch, home: str):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", home)
    assert place() is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_a_folder_of_others_is_not_used(asked: Path, tmp_path: Path):
    found = place()
    found.chmod(0o770)
    assert place() is None
    found.chmod(0o700)
    assert place() == found
    if os.getuid() == 0:
        os.chown(found, 12345, -1)
        assert place() is None
    shutil.rmtree(found)
    found.symlink_to(tmp_path)
    assert place() is None


def test_folders_of_forgotten_versions_are_cleared_away(asked: Path):
    month = time.time() - 31 * 86400
    for name, written in {"kernels-old": month, "kernels-new": time.time(), "others-old": month}.items():
        (asked / name / "inside").mkdir(parents=True)
        os.utime(asked / name, (written, written))
    found = place()
    assert sorted(path.name for path in asked.iterdir()) == sorted([found.name, "kernels-new", "others-old"])


# What the kernels are made of


def test_an_edit_in_any_source_is_seen(tmp_path: Path):
    for name in compiled.SOURCES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(PACKAGE / name, tmp_path / name)
    digests = {compiled.digest(tmp_path)}
    assert digests == {compiled.digest(PACKAGE)}
    for name in compiled.SOURCES:
        with (tmp_path / name).open("a") as stream:
            stream.write("#")
        digests.add(compiled.digest(tmp_path))
    assert len(digests) == 1 + len(compiled.SOURCES)


def test_an_edited_kernel_outside_the_package_is_compiled_anew(folder: Path, tmp_path: Path):
    """Such as one in studies/, which the digest of the package does not cover."""
    path = tmp_path / "study.py"

    def answer(constant: int) -> tuple[int, int]:
        path.write_text(f"def kernel(number):\n    return number + {constant}\n")
        names: dict[str, object] = {"__name__": "study"}
        exec(compile(path.read_text(), path, "exec"), names)
        kernel = fresh(folder, names["kernel"])
        return kernel(40), sum(kernel.stats.cache_hits.values())

    assert [answer(1), answer(1), answer(2)] == [(41, 0), (41, 1), (42, 0)]


def test_another_numba_is_seen(monkeypatch: pytest.MonkeyPatch):
    before = compiled.digest(PACKAGE)
    monkeypatch.setattr(numba, "__version__", "0.0")
    assert compiled.digest(PACKAGE) != before


def test_numba_is_bounded_because_the_cache_uses_what_it_may_change():
    """Raise the bound with `nox -s constraints`, once these tests pass; a new name of numba's is one more risk."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (bounds,) = (one.specifier for one in map(Requirement, project["dependencies"]) if one.name == "numba")
    tested = re.search(r"(?m)^numba==(\d+)\.(\d+)", (PACKAGE.parent / "constraints.txt").read_text(encoding="utf-8"))
    assert tested is not None
    major, minor = map(int, tested.groups())
    assert f"{major}.{minor}.9" in bounds and f"{major}.{minor + 1}.0" not in bounds
    assert numba.__version__ in bounds
    imports = [node for node in ast.parse(Path(compiled.__file__).read_text()).body if isinstance(node, ast.ImportFrom)]
    private = {f"{one.module}.{name.name}" for one in imports if one.module.startswith("numba.") for name in one.names}
    assert private == {
        "numba.core.caching.NullCache",
        "numba.core.compiler.CompileResult",
        "numba.core.serialize.dumps",
        "numba.core.sigutils.normalize_signature",
    }


def test_all_files_with_kernels_and_what_they_import_are_among_the_sources():
    def has_kernels(path: Path) -> bool:  # at the top: what imports a decorator on use has no kernel of its own
        top = ast.parse(path.read_text()).body
        return any(isinstance(node, ast.ImportFrom) and node.module == "cgid._lib.compiled" for node in top)

    needed = set(filter(has_kernels, PACKAGE.rglob("*.py")))
    assert len(needed) >= 7
    while more := {other for path in needed for other in imported(path)} - needed:
        needed |= more
    needed.add(PACKAGE / "physics" / "contact" / "laws.py")  # its functions are handed to the kernel of a contact
    assert {path.relative_to(PACKAGE).as_posix() for path in needed} == set(compiled.SOURCES)


def imported(path: Path) -> set[Path]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cgid."):
            found.add(PACKAGE.joinpath(*node.module.split(".")[1:]).with_suffix(".py"))
    return {one for one in found if one.is_file()}


def test_nothing_else_compiles():
    users = [path for path in PACKAGE.rglob("*.py") if re.search(r"import .*\bnjit|numba\.njit\(", path.read_text())]
    assert users == [PACKAGE / "_lib" / "compiled.py"]


# -- whole processes --------------------------------------------------------------------------------------

_PROCESS = """
import hashlib, json, sys
import numpy as np
from cgid.store._packing import fletcher32
print("ready", flush=True)
sys.stdin.readline()
found = np.asarray(fletcher32(np.arange(20_000, dtype="<u2"))).tobytes()
print(json.dumps([hashlib.sha256(found).hexdigest(), sum(fletcher32.stats.cache_misses.values())]))
"""


def results_of(folder: Path, number: int, before: str = "") -> list[tuple[str, int]]:
    """Start processes at once; return their results, and how many kernels each has compiled."""
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": str(PACKAGE.parent)}
    command = [sys.executable, "-c", before + _PROCESS]
    started = [subprocess.Popen(command, **pipes, text=True, env=environment) for _ in range(number)]
    for process in started:
        process.stdout.readline()  # all are ready
    for process in started:
        process.stdin.write("\n")
        process.stdin.flush()
    ended = [process.communicate() for process in started]
    assert [(process.returncode, told) for process, (_, told) in zip(started, ended, strict=True)] == [(0, "")] * number
    return [tuple(json.loads(out)) for out, _ in ended]


@pytest.fixture(scope="module")
def expected() -> str:
    """What the processes must find: by the interpreter."""
    with np.errstate(all="ignore"):
        checksum = fletcher32.py_func(np.arange(20_000, dtype="<u2"))
    return hashlib.sha256(np.asarray(checksum, np.uint64).tobytes()).hexdigest()


@pytest.mark.long
def test_processes_start_at_once_with_an_empty_cache(tmp_path: Path, expected: str):
    found = results_of(tmp_path, 4)
    assert {result for result, _ in found} == {expected}
    assert sum(compiled for _, compiled in found) >= 1  # the cache was empty
    assert results_of(tmp_path, 1) == [(expected, 0)]


def test_a_full_disk_keeps_nothing_and_fails_nobody(tmp_path: Path, expected: str):
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
    ((result, _),) = results_of(tmp_path, 1, limit)
    assert result == expected
    assert list(tmp_path.rglob("kernels-*/*")) == []
