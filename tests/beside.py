"""Recordings that lie beside the checkout, in a folder that CGID_SHARED may name; tests skip without them."""

from __future__ import annotations

import os
from pathlib import Path

SHARED = Path(os.environ.get("CGID_SHARED") or Path(__file__).parents[2] / "shared")
