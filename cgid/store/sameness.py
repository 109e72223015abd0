"""Whether two runs make the same: by their plans, which say all that the bytes depend on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cgid.errors import CannotCreate


def require_same(output: Path, there: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise `CannotCreate`, naming the first option that differs, unless a run makes what is there, too."""
    name = first_difference(there, asked)
    if name is not None:
        values = [flat.get(name, "nothing") for flat in (_flat(there), _flat(asked))]
        raise CannotCreate(
            f"{output}: {name} must be that of the run to be resumed, {values[0]!s:.80}, got {values[1]!s:.80}; give "
            "the options of the first run, or start again with --overwrite"
        )


def first_difference(there: Mapping[str, Any], asked: Mapping[str, Any]) -> str | None:
    """Return the name of the first option in which two plans differ; what one of them leaves open does not count.

    Examples
    --------
    >>> first_difference({"n_signals": 9, "attributes": {"seed": 1}}, {"n_signals": 9, "attributes": {"seed": 2}})
    'seed'
    >>> first_difference({"n_signals": 9, "dtype": None}, {"n_signals": 9, "dtype": "float32"})
    """
    here, other = _flat(asked), _flat(there)
    # The text of a scene comes last: its name and its SHA-256 say it shorter.
    names = sorted({*here, *other}, key=lambda name: (name == "scene", list(here).index(name) if name in here else 0))
    pairs = ((name, here.get(name), other.get(name)) for name in names)
    return next((name for name, one, two in pairs if None not in (one, two) and one != two), None)


def _flat(plan: Mapping[str, Any]) -> dict[str, Any]:
    attributes = plan.get("attributes")
    found = {**plan, **(attributes if isinstance(attributes, dict) else {})}
    return {name: value for name, value in found.items() if name != "attributes"}
