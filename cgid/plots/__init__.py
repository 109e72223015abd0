"""All pictures. matplotlib (extra `plot`) is imported only here, and only on use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.plots.answers import share_figure as share_figure
    from cgid.plots.figure import picture as picture
    from cgid.plots.recording import recording_picture as recording_picture

#: Module -> the public names that it defines.
_NAMES = {"answers": ("share_figure",), "figure": ("picture",), "recording": ("recording_picture",)}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)
