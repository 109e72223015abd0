"""Compilation of kernels: the same options for all, and a cache on disk.

numba's own cache breaks when two processes compile at once, misses edits in other files, and unpickles files that other
users may have written; it is not faster. This one uses names that numba may change, so pyproject.toml bounds numba.
Here every compiled kernel is one file of the user's cache (`user_cache`). It depends on sources in cgid and on the
versions of Python, numpy, numba and llvmlite. The folder is `kernels-<digest>` in `NUMBA_CACHE_DIR` or the user's cache
folder (`XDG_CACHE_HOME`).
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import logging
import pickle
import shutil
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba
import numpy as np
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature

from cgid._lib.user_cache import PACKAGE, is_private, private_folder, read_payload, write_payload
from cgid._lib.user_cache import digest as digest_of

Function = TypeVar("Function", bound=Callable[..., Any])

#: Files whose text is in the compiled kernels: those with kernels, and those they take constants from.
SOURCES = (
    "_lib/compiled.py",
    "_lib/user_cache.py",
    "measure/fit/family.py",
    "physics/contact/_contact.py",
    "physics/contact/_dop853.py",
    "physics/contact/_kernels.py",
    "physics/contact/_modal_step.py",
    "physics/contact/_modes.py",
    "physics/contact/_step.py",
    "physics/contact/laws.py",
    "physics/structure/_coupled.py",
    "physics/structure/_response.py",
    "scene/synthesis/_noise.py",
    "store/_packing.py",
)
#: Folders of other sources or versions are removed after this time without a new kernel [s]: 30 days.
_FORGOTTEN = 30 * 86400.0
#: NUMBA_... variables that change the kernel compiled from the same source.
_SETTINGS = (
    "BOUNDSCHECK",
    "DEBUGINFO_DEFAULT",
    "DEBUG_NRT",
    "EXTEND_VARIABLE_LIFETIMES",
    "LLVM_REFPRUNE_FLAGS",
    "LLVM_REFPRUNE_PASS",
    "LOOP_VECTORIZE",
    "OPT",
    "SLP_VECTORIZE",
    "USING_SVML",
)
#: What is compiled is told here; a command shows it on a terminal.
_LOG, _COUNT = logging.getLogger("cgid.kernels"), itertools.count(1)
_OPTIONS = {"nogil": True, "error_model": "numpy"}


def jit(function: Function) -> Function:
    """Return the function, compiled or read from the cache at its first call; it releases Python's lock."""
    return _compiled(function, _OPTIONS)


def inner_jit(function: Function) -> Function:
    """Return the same for a function that only kernels call, which compiles a fifth faster."""
    return _compiled(function, _OPTIONS | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True})


def bare_jit(function: Function) -> Function:
    """Return the same for a function that makes no array: it counts no references, which took half of the time."""
    return _compiled(function, _OPTIONS | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "_nrt": False})


def _compiled(function: Function, options: dict[str, Any]) -> Function:
    dispatcher: Any = numba.njit(**options)(function)
    dispatcher._cache = KernelCache(function, kernel_folder)
    result: Function = dispatcher
    return result


#: The types of arrays of one and two axes.
FLOATS, ROWS = (numba.types.Array(numba.types.float64, n_axes, "C") for n_axes in (1, 2))
_NUMBER = numba.types.float64
#: The signatures of force, corner and turn of a contact law.
VERBS = (
    numba.types.UniTuple(_NUMBER, 2)(FLOATS, FLOATS, _NUMBER),
    _NUMBER(FLOATS, FLOATS),
    _NUMBER(FLOATS, FLOATS, _NUMBER),
)
#: The types of these functions where they are arguments.
LAW = tuple(map(numba.types.FunctionType, VERBS))


def constants(*values: int) -> tuple[int, ...]:
    """Return integers of numpy: numba compiles a function anew for each integer of Python that it is given."""
    return tuple(np.array(values))


def by_address(type_: Any) -> Callable[[Function], Function]:
    """Return the decorator of a function that kernels get as an argument: it is compiled once, not in each of them."""

    def decorated(function: Function) -> Function:
        dispatcher: Any = _compiled(function, _OPTIONS | {"no_cpython_wrapper": True, "_nrt": False})
        dispatcher.by_address = type_ if isinstance(type_, numba.types.Type) else numba.types.FunctionType(type_)
        result: Function = dispatcher
        return result

    return decorated


def with_law(kernel: Any, *arguments: Any) -> None:
    """Call a kernel whose first arguments are the addresses of a law's functions; it is compiled once for all laws."""
    types = (*LAW, *map(_type_of, arguments[len(LAW) :]))
    if types not in kernel.overloads:
        kernel.compile(types)
    kernel.overloads[types].entry_point(*arguments)


def _type_of(argument: Any) -> Any:
    if isinstance(argument, tuple):
        return numba.types.Tuple([_type_of(one) for one in argument])
    return getattr(argument, "by_address", None) or numba.typeof(argument)


class KernelCache(NullCache):
    """Cache of the compiled forms of one function, in the interface that numba expects."""

    def __init__(self, function: Callable[..., Any], folder: Callable[[], Path | None]) -> None:
        self._name = f"{function.__module__}.{function.__qualname__}"
        # The digest in the name of the folder covers cgid alone.
        path = Path(function.__code__.co_filename)
        self._source = "" if PACKAGE in path.parents else hashlib.sha256(path.read_bytes()).hexdigest()
        self._folder = folder

    @property
    def cache_path(self) -> str | None:
        """The folder."""
        folder = self._folder()
        return None if folder is None else str(folder)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the function compiled for these types of arguments, None if it is not in the cache: it is compiled."""
        target_context.refresh()
        # Whatever is wrong with the file or the disk, the kernel is compiled.
        with contextlib.suppress(Exception):
            payload = read_payload(self._file(sig, target_context.codegen()))
            if payload is not None:
                return CompileResult._rebuild(target_context, *pickle.loads(payload))
        _LOG.info("compiling kernels, once: %d", next(_COUNT))
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store a compiled function if possible."""
        with contextlib.suppress(Exception):
            if not data.library.has_dynamic_globals:  # addresses of this process
                write_payload(self._file(sig, data.codegen), dumps(data._reduce()))

    def _file(self, sig: Any, codegen: Any) -> Path:
        folder = self._folder()
        if folder is None:
            raise FileNotFoundError
        types, _ = normalize_signature(sig)
        settings = [str(getattr(numba.config, name, None)) for name in _SETTINGS]
        # Includes the processor: several machines may share a home folder.
        identity = repr((self._name, self._source, [str(one) for one in types], codegen.magic_tuple(), settings))
        return folder / f"{self._name}-{hashlib.sha256(identity.encode()).hexdigest()[:16]}"


@cache
def kernel_folder() -> Path | None:
    """Return the folder of this version's compiled kernels, created if needed; None if it cannot be trusted."""
    try:
        folder = private_folder(f"kernels-{digest(PACKAGE)}", getattr(numba.config, "CACHE_DIR", ""))
        if folder is not None and not any(folder.iterdir()):
            _clear_forgotten(folder)
    except OSError:
        return None
    return folder


def digest(package: Path) -> str:
    """Return a digest of the kernels' sources in a folder and the libraries' versions: 16 hexadecimal digits."""
    versions = (sys.implementation.cache_tag, np.__version__, numba.__version__, llvmlite.__version__)
    return digest_of((package / name for name in SOURCES), *versions)


def _clear_forgotten(folder: Path) -> None:
    """Remove the folders of other sources and versions that are no longer used."""
    for other in folder.parent.glob("kernels-*"):
        with contextlib.suppress(OSError):
            status = other.lstat()
            if other != folder and is_private(status) and time.time() - status.st_mtime > _FORGOTTEN:
                shutil.rmtree(other, ignore_errors=True)
