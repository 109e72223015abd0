"""The same scene and seed give the same impacts on every processor: samples to rounding, labels and rocks exactly."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.portable import TIME_TOLERANCE, signals

ROOT = Path(__file__).parents[1]
#: Written by `python -m tests.portable tests/golden/portable.npz` on a processor with AVX-512.
GOLDEN = ROOT / "tests" / "golden" / "portable.npz"
#: numpy's own loops for newer processors; those that one does not have are left out with a warning only.
_NEWER = "X86_V3 X86_V4 AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"


def require_alike(found: dict[str, NDArray[Any]]) -> None:
    with np.load(GOLDEN) as golden:
        assert set(golden) == set(found)
        for name, expected in golden.items():
            kind = name.split("/")[1]
            if kind == "signals":
                np.testing.assert_allclose(found[name], expected, rtol=0, atol=1e-6, err_msg=name)
            elif kind == "time":
                np.testing.assert_allclose(found[name], expected, rtol=0, atol=TIME_TOLERANCE, err_msg=name)
            elif kind == "peak":
                np.testing.assert_allclose(found[name], expected, rtol=1e-6, err_msg=name)
            else:
                np.testing.assert_array_equal(found[name], expected, err_msg=name)


def test_signals_are_those_of_another_processor() -> None:
    require_alike(signals())


@pytest.mark.long
@pytest.mark.parametrize(
    "environment",
    [
        {"NPY_DISABLE_CPU_FEATURES": _NEWER},
        {"NUMBA_CPU_NAME": "generic"},
        {"OPENBLAS_CORETYPE": "Nehalem"},
        {"OPENBLAS_NUM_THREADS": "2"},
        {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F"},
    ],
    ids=lambda environment: next(iter(environment)),
)
def test_settings_of_a_processor_change_only_last_digits(environment: dict[str, str], tmp_path: Path) -> None:
    path = tmp_path / "found.npz"
    subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "tests.portable", str(path)],
        env=os.environ | environment,
        cwd=ROOT,
        check=True,
    )
    with np.load(path) as found:
        require_alike(dict(found))
