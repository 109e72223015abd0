"""The same scene and seed give the same bytes on every processor."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import few, portable

ROOT = Path(__file__).parents[1]
#: Of the first version whose bytes do not depend on the processor. What changes them is a new version of the generator.
DIGESTS = json.loads((Path(__file__).parent / "portable.json").read_text())
#: numpy's own loops for newer processors; those that one does not have are left out with a warning only.
_ALL_NEWER = "X86_V3 X86_V4 AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
_NO_AVX512 = "X86_V4 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
OLDEST = {"NPY_DISABLE_CPU_FEATURES": _ALL_NEWER, "NUMBA_CPU_NAME": "generic", "OPENBLAS_CORETYPE": "Prescott"}
#: Some of the varied scenes.
SOME = [
    "thornton",
    "walton-braun",
    "thornton and viscous",
    "walton-braun and viscous",
    "lognormal radius",
    "rosin-rammler radius",
    "haversine tap",
    "hum",
    "coloured noise",
    "pink noise",
    "spectrum of noise",
    "drawn rigs",
    "bandwidth",
]
#: A C library whose functions return the neighbouring double, but for whole numbers, which every library gets right.
_NEIGHBOURS = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <math.h>
static double next(double y) {
    union { double number; long bits; } one = { .number = y };
    if (y == rint(y) || !isfinite(y)) return y;
    one.bits += 1;
    return one.number;
}
#define ONE(name) double name(double x) { \
    static double (*true_one)(double); \
    if (!true_one) true_one = dlsym(RTLD_NEXT, #name); \
    return next(true_one(x)); }
#define TWO(name) double name(double x, double y) { \
    static double (*true_one)(double, double); \
    if (!true_one) true_one = dlsym(RTLD_NEXT, #name); \
    return next(true_one(x, y)); }
ONE(exp) ONE(exp2) ONE(expm1) ONE(log) ONE(log2) ONE(log10) ONE(log1p) ONE(sin) ONE(cos) ONE(tan) ONE(asin) ONE(acos)
ONE(atan) ONE(sinh) ONE(cosh) ONE(tanh) ONE(cbrt) ONE(erf) ONE(erfc) ONE(lgamma) ONE(tgamma) TWO(pow) TWO(hypot)
TWO(atan2)
void sincos(double x, double *s, double *c) { *s = sin(x); *c = cos(x); }
"""
#: The same for the functions of numpy and math, where Python code calls them by name.
_PATCH = """
import math, runpy, sys
import numba, numpy as np, pandas, scipy.interpolate, scipy.signal, scipy.special, pydantic, h5py

numba.njit(lambda x: x)(1.0)  # which makes numba look at numpy's functions

def neighbour(function):
    def nudged(*given, **more):
        value = function(*given, **more)
        return np.nextafter(value, np.inf) if np.asarray(value).dtype == np.float64 else value * (1 + 2.0**-52)
    return nudged

for name in "exp expm1 exp2 log log2 log10 log1p sin cos tan arcsin arccos arctan sinh cosh tanh cbrt hypot".split():
    setattr(np, name, neighbour(getattr(np, name)))
    if hasattr(math, name):
        setattr(math, name, neighbour(getattr(math, name)))
sys.argv = ["portable", *sys.argv[1:]]
runpy.run_module("tests.portable", run_name="__main__")
"""


def made(*arguments: str, code: str | None = None, **environment: str) -> dict[str, dict[str, str]]:
    """Return the digests that a process with these variables makes."""
    start = ["-m", "tests.portable"] if code is None else ["-c", code]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", *start, *arguments],
        env=os.environ | environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, dict[str, str]] = json.loads(done.stdout)
    return found


def digests(names: list[str]) -> dict[str, dict[str, str]]:
    """Return those of varied scenes, of all for no names."""
    varied: dict[str, dict[str, str]] = DIGESTS["varied"]
    return {name: varied[name] for name in names} or varied


def test_the_bytes_of_the_shipped_scenes() -> None:
    assert portable.of_shipped() == DIGESTS["shipped"]


#: Compiling for another processor takes as long as all else, and is left to the long run.
_CASES = few([(SOME, {key: value for key, value in OLDEST.items() if key != "NUMBA_CPU_NAME"}), ([], OLDEST)])


@pytest.mark.long
@pytest.mark.parametrize(("names", "environment"), _CASES)
def test_another_processor_makes_the_same_bytes_of_every_kind_of_scene(
    names: list[str], environment: dict[str, str]
) -> None:
    assert made("varied", *names, **environment) == digests(names)


@pytest.mark.long
@pytest.mark.parametrize("names", few([[*SOME, "clamped panel"], []]))
def test_nudged_functions_of_numpy_and_math_change_nothing(names: list[str]) -> None:
    assert made("varied", *names, code=_PATCH) == digests(names)


@pytest.fixture(scope="module")
def neighbours(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a library to be loaded before that of C."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("needs a C compiler on Linux")
    folder = tmp_path_factory.mktemp("neighbours")
    (folder / "one.c").write_text(_NEIGHBOURS)
    options = ["-O1", "-fno-builtin", "-shared", "-fPIC"]
    library = str(folder / "one.so")
    subprocess.run([compiler, *options, str(folder / "one.c"), "-o", library, "-ldl", "-lm"], check=True)
    return library


@pytest.mark.long
@pytest.mark.parametrize("names", few([SOME, []]))
def test_a_c_library_of_neighbouring_doubles_changes_nothing(neighbours: str, names: list[str]) -> None:
    assert made("varied", *names, LD_PRELOAD=neighbours, NPY_DISABLE_CPU_FEATURES=_ALL_NEWER) == digests(names)


@pytest.mark.long
@pytest.mark.parametrize(
    "environment",
    [
        {"NPY_DISABLE_CPU_FEATURES": _NO_AVX512},
        {"NPY_DISABLE_CPU_FEATURES": _ALL_NEWER},
        {"NUMBA_CPU_NAME": "generic"},
        {"OPENBLAS_CORETYPE": "Haswell"},
        {"OPENBLAS_CORETYPE": "Nehalem"},
        {"OPENBLAS_CORETYPE": "Prescott"},
        {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F"},
    ],
    ids=lambda environment: "=".join(next(iter(environment.items()))),
)
def test_each_setting_by_itself(environment: dict[str, str]) -> None:
    assert made("shipped", **environment) == DIGESTS["shipped"]


#: Folders, modules and functions below `cgid/physics` and `cgid/scene` whose results are in no stored signal, and why.
_NOT_STORED = {
    "physics/sensitivity.py: _sought": "seeks a loss for the user",
    "scene/calibration.py": "from a recording to a scene",
    "scene/calibration_blow.py": "from a recording to a scene",
    "scene/calibration_fit.py": "from a recording to a scene",
    "scene/through_beam.py": "what an inversion looks through",
    "scene/units.py": "words of a message",
}
_FUNCTIONS = {
    "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "logaddexp", "power", "float_power", "pow", "sin", "cos",
    "tan", "arcsin", "arccos", "arctan", "arctan2", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh",
    "arcsinh", "arccosh", "arctanh", "cbrt", "hypot", "sinc", "angle", "gamma", "lgamma", "erf", "erfc", "dot",
    "matmul", "tensordot", "inner", "vdot", "standard_normal", "normal", "exponential",
    "rfft", "irfft", "leggauss", "eigh", "lstsq", "solve",
}  # fmt: skip


def _dependent(path: Path) -> list[str]:
    """Return the calls of one file whose last digits are a library's or a processor's, as `file: function: call`."""
    file = path.relative_to(ROOT / "cgid").as_posix()
    return [
        f"{file}: {owner}: {name}"
        for owner, part in _owners(ast.parse(path.read_text()).body)
        for name in map(_call, ast.walk(part))
        if name is not None
    ]


def _owners(body: list[ast.stmt]) -> Iterator[tuple[str, ast.stmt]]:
    """Return the statements of a module with the function, `Class.method` or (else) "module" that they belong to."""
    for part in body:
        match part:
            case ast.FunctionDef(name=name):
                yield name, part
            case ast.ClassDef(name=name, body=members):
                yield from ((f"{name}.{owner}" if owner != "module" else name, one) for owner, one in _owners(members))
            case _:
                yield "module", part


def _call(node: ast.AST) -> str | None:
    """Return the name of a call whose last digits are a library's or a processor's, None for any other node."""
    match node:
        case ast.Attribute(attr=name):
            bad = name in _FUNCTIONS and ast.unparse(node).split(".")[0] in ("np", "math", "scipy", "special")
        case ast.BinOp(op=ast.MatMult()):
            name, bad = "@", True
        case ast.BinOp(op=ast.Pow(), left=left, right=right):
            # Squares, and powers of 2 and -1, are exact or one product.
            name, bad = "**", ast.unparse(right) != "2" and ast.unparse(left) not in ("2", "2.0", "-1", "10")
        case _:
            return None
    return name if bad else None


#: What is left in these functions, and why it does no harm.
_HARMLESS = {
    "physics/sampled.py: smoothed: lstsq": "smooths a solver's course, which is stored as numbers",
    "physics/sampled.py: SampledPulses.impulse: @": "an impulse for the user",
    "physics/sampled.py: SampledPulses.impulse: leggauss": "an impulse for the user",
}


def test_no_function_of_a_library_is_on_the_way_to_a_stored_signal() -> None:
    package = ROOT / "cgid"
    kept = [package / "family.py", *(package / "physics").rglob("*.py"), *(package / "scene").rglob("*.py")]
    found = {line for path in kept for line in _dependent(path)}
    exempt = tuple(name + sign for name in _NOT_STORED for sign in ":/")
    assert {line for line in found if not line.startswith(exempt)} == set(_HARMLESS)
