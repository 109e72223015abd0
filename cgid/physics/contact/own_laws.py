"""Custom contact laws: from entry points or named by the user, never by a scene file."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import warnings
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid.errors import InvalidValue
from cgid.physics.contact.curves import Law

#: Entry points of laws of other packages; each is a module.
GROUP = "cgid.laws"
#: The keys of a population that a law may take.
_KEYS = (
    "restitution",
    "yield_pressure",
    "viscous_restitution",
    "exponent",
    "contact_radius",
    "breaking_force",
    "remaining_force",
)
_VERBS = ("force", "corner", "turn")


def how_to_add() -> str:
    """Return what to do about a law that no scene knows."""
    return f"give the name of a law of your own, and its module with {spelled('laws', 'MODULE')}"


class OwnLaw(NamedTuple):
    """A law, its module (empty for an entry point, which every process finds), and its SHA-256."""

    law: type[Law]
    source: str
    sha256: str


_own: dict[str, OwnLaw] = {}
_sound: list[type[Law]] = []


def add_laws(source: str | Path) -> None:
    """Register the laws of a module for scenes, as `--set laws=MODULE` does; worker processes load the module, too.

    Parameters
    ----------
    source : str or Path
        Name of the module, or the path of its .py file. Scenes then take the names of its laws as their dissipation.

    Raises
    ------
    InvalidValue
        The module cannot be loaded, has no law, or has one that cannot be used; or `source` is the law itself.
    """
    if not isinstance(source, str | Path):
        raise InvalidValue(
            f"source must be the name of a module, or the path of its .py file, so that worker processes load it, too; "
            f"got {validation.shown(source)}; put the law into a file"
        )
    source = str(source)
    try:
        module = _from_file(Path(source).resolve()) if source.endswith(".py") else importlib.import_module(source)
    except KeyboardInterrupt:
        raise
    # The module may fail in any way, and may end the process.
    except BaseException as error:
        cure = f"{source}.py" if Path(f"{source}.py").is_file() else "its name, or the path of its file"
        raise InvalidValue(
            f"laws {source}: must be a module that can be loaded, got {type(error).__name__}: {error}; give {cure}"
        ) from None
    _add(module, str(Path(source).resolve()) if source.endswith(".py") else source)


def _from_file(path: Path) -> ModuleType:
    name = f"cgid_laws_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def _add(module: ModuleType, source: str) -> None:
    found = [one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__]
    laws = [one for one in found if issubclass(one, Law) and one.name]
    if not laws:
        raise InvalidValue(f"laws {source}: must have a class with a name that extends cgid.physics.Law, it has none")
    digest = hashlib.sha256(Path(str(module.__file__)).read_bytes()).hexdigest()
    for law in laws:
        require_sound(law)
        _own[law.name] = OwnLaw(law, source, digest)


def own_law(name: str) -> OwnLaw | None:
    """Return a custom law by its name, from the named modules or else from entry points."""
    if name not in _own:
        _find_entry_points()
    return _own.get(name)


@cache
def _find_entry_points() -> None:
    from importlib.metadata import entry_points

    named = dict(_own)
    for entry in sorted(entry_points(group=GROUP), key=lambda one: one.name):
        try:
            module = entry.load()
        except KeyboardInterrupt:
            raise
        # Another package may fail in any way, and may end the process.
        except BaseException as error:
            said = f"{type(error).__name__}: {error}"
            warnings.warn(f"the laws {entry.name} ({entry.value}) cannot be loaded: {said}", stacklevel=2)
            continue
        _add(module, "")
    _own.update(named)  # modules named by the user take precedence


def sources() -> tuple[str, ...]:
    """Return the modules named by the user, for other processes."""
    return tuple(dict.fromkeys(own.source for own in _own.values() if own.source))


def require_sound(law: type[Law]) -> None:
    """Raise `InvalidValue` unless the functions of a law are compiled, with the signatures of the integrator."""
    if law in _sound:
        return
    from numba.core.errors import NumbaError

    from cgid._lib.compiled import VERBS
    from cgid.physics.contact.laws import LAWS

    if law.name in LAWS:
        raise InvalidValue(f"law {law.name}: must have another name than a built-in law, got {law.name!r}; rename it")
    if not set(law.keys) <= set(_KEYS):
        raise InvalidValue(f"law {law.name}: keys must be of {', '.join(_KEYS)}, got {', '.join(law.keys)}")
    if {"restitution", "yield_pressure"} <= set(law.keys):
        raise InvalidValue(
            f"law {law.name}: keys must have one of restitution and yield_pressure, which share a random number, got "
            "both; leave one out"
        )
    if len({"breaking_force", "remaining_force"} & set(law.keys)) == 1:
        raise InvalidValue(
            f"law {law.name}: keys must have both breaking_force and remaining_force or neither, since a population "
            f"states both, got {', '.join(law.keys)}; add the other, or take contact_radius or exponent"
        )
    for name, signature in zip(_VERBS, VERBS, strict=True):
        verb: Any = getattr(law, name)
        if verb is None and name != "force":
            continue
        place = f"law {law.name or law.__name__}: {name}"
        if not hasattr(verb, "get_compile_result"):
            raise InvalidValue(f"{place} must be compiled, got {type(verb).__name__}; decorate it with numba.njit")
        try:
            returned = verb.get_compile_result(signature).signature.return_type
        except (NumbaError, TypeError) as error:
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            raise InvalidValue(
                f"{place} must compile for {signature.args}, got an error: {' '.join(lines)[:300]}"
            ) from None
        if returned != signature.return_type:
            raise InvalidValue(f"{place} must return {signature.return_type}, got {returned}; return floats")
    _sound.append(law)
