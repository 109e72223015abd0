"""Read MATLAB files of version 5 to 7.2: scipy converts them to an NPZ archive, which is read by blocks; 7.3 is HDF5.

scipy trusts its input: nested structs in a damaged file can crash it. So it runs in a separate process (this module as
a program) with limits of time and memory.
"""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
import weakref
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, WriteFailed
from cgid.recordings.arrays import read_npz
from cgid.recordings.formats import temporary_file
from cgid.recordings.recording import Contents

#: Largest file [bytes], as scipy reads files whole.
LARGEST_FILE = 2 << 30

#: Memory limit [bytes]: the first number plus this multiple of the file size, at most the last number.
_LEAST_MEMORY, _TIMES_THE_FILE, _MOST_MEMORY = 512 << 20, 100, 6 << 30
#: Time limit [s], and file size [bytes] for each further second.
_LEAST_TIME, _BYTES_A_SECOND = 60.0, 4 << 20

_DEEPEST, _LONGEST_TEXT = 16, 4096


def read_mat(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of one array of a MATLAB file, or of several arrays of one length.

    The file is as written by ``save -v6`` or ``-v7``; fields of structs are named ``struct/field``. Rate and unit are
    found as by `read_npz`. Raises `BadData` if the file is too large, cut off or damaged, or holds no real array or
    several.
    """
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise BadData(
            f"{source}: a MATLAB file of version 5 to 7.2 must be at most {LARGEST_FILE >> 30} GiB, it has {size} "
            "bytes; save it with -v7.3"
        )
    spool = ExitStack()
    try:
        archive, out = temporary_file(spool)
        _convert(path, out, source, size)
        contents = read_npz(archive, source, variable)
    except BaseException:
        spool.close()
        raise
    weakref.finalize(contents, spool.close)
    return contents


def _convert(path: Path, out: IO[bytes], source: str, size: int) -> None:
    """Write the arrays of a MATLAB file to an NPZ archive, in a separate process."""
    # The process has the import paths of this one, but never the current folder.
    paths = [str(Path(__file__).parents[2]), *(os.path.abspath(entry) for entry in sys.path if entry)]  # noqa: PTH100
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths)), "OPENBLAS_NUM_THREADS": "1"}
    try:
        with path.open("rb") as file:
            child = subprocess.run(
                [sys.executable, "-P", "-m", "cgid.recordings.mat", str(size)],
                stdin=file,
                stdout=out,
                stderr=subprocess.PIPE,
                env=environment,
                timeout=_LEAST_TIME + size / _BYTES_A_SECOND,
                check=False,
            )
    except subprocess.TimeoutExpired:
        raise _damaged(source, "reading it takes too long") from None
    if child.returncode == 0:
        return
    reason = " ".join(child.stderr.decode(errors="replace").strip().rpartition("\n")[2].split())[:120]
    if reason.startswith("OSError: [Errno 28]"):
        raise WriteFailed(f"{source}: the disk must have room for the unpacked file, it is full; set TMPDIR")
    raise _damaged(source, reason if child.returncode == 1 and reason else "scipy crashed on it")


def _damaged(source: str, reason: str) -> BadData:
    return BadData(f"{source}: the MATLAB file is cut off or damaged ({reason}); copy it again, or save it with -v7")


# ---- the process that runs scipy -------------------------------------------------------------------------------------


def _main(size: int) -> None:
    """Read a MATLAB file from the standard input and write an NPZ archive to the standard output."""
    from scipy.io import loadmat

    _limit(min(_LEAST_MEMORY + _TIMES_THE_FILE * size, _MOST_MEMORY))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = stored = loadmat(sys.stdin.buffer, mat_dtype=True)
        # MATLAB types (mat_dtype) distinguish logical arrays, but drop the imaginary part of complex numbers.
        if any(issubclass(one.category, np.exceptions.ComplexWarning) for one in caught):
            stored = loadmat(sys.stdin.buffer, mat_dtype=False)
    with zipfile.ZipFile(sys.stdout.buffer, "w", allowZip64=True) as archive:
        for name, value in found.items():
            for path, array in _arrays(name, value, stored[name], 0):
                with archive.open(f"{path}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)


def _limit(memory: int) -> None:
    """Limit the memory of this process [bytes]; only Unix can, elsewhere time is the only limit."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))


def _arrays(path: str, value: Any, stored: Any, depth: int) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the real arrays and texts in a value with their paths; cells and objects are left out."""
    if type(value) is not np.ndarray or depth > _DEEPEST or not value.size:
        return
    if value.dtype.names:
        for index, (one, its) in enumerate(zip(value.ravel(), stored.ravel(), strict=True)):
            owner = path if value.size == 1 else f"{path}({index + 1})"
            for field in value.dtype.names:
                yield from _arrays(f"{owner}/{field}", one[field], its[field], depth + 1)
    elif value.dtype.kind == "U" and value.size * value.dtype.itemsize <= 4 * _LONGEST_TEXT:
        yield path, np.char.strip(value)
    elif value.dtype.kind in "fiu" and stored.dtype.kind != "c":
        rows = value.squeeze()
        if rows.ndim <= 2:
            # Sample by sample, as archives are read from beginning to end.
            yield path, np.ascontiguousarray(rows if rows.ndim < 2 or rows.shape[0] >= rows.shape[1] else rows.T)


if __name__ == "__main__":
    try:
        _main(int(sys.argv[1]))
    # The parent process receives one line for any failure of scipy on a damaged file.
    except BaseException as error:
        sys.exit(f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": "))
