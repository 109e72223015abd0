"""JSON that says its own SHA-256, so that a flipped bit in it is found."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

_DIGEST = "digest"


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content with its SHA-256 as one more field, `digest`."""
    return {**content, _DIGEST: _sha256(content)}


def is_sound(content: Mapping[str, Any]) -> bool:
    """Return whether content that was read back is what was sealed.

    Examples
    --------
    >>> content = sealed({"seed": 7})
    >>> is_sound(content), is_sound({**content, "seed": 6}), is_sound({"seed": 7})
    (True, False, False)
    """
    try:
        return content.get(_DIGEST) == _sha256({name: value for name, value in content.items() if name != _DIGEST})
    except RecursionError:  # what can just be read may be too deep to be written
        return False


def _sha256(content: Mapping[str, Any]) -> str:
    # Sorted and without spaces: the same text however the file is laid out.
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
