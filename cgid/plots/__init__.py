"""All pictures. matplotlib (extra `plot`) is imported only here, and only on use."""

from cgid.plots.answers import share_figure
from cgid.plots.figure import picture
from cgid.plots.recording import recording_picture

__all__ = ["picture", "recording_picture", "share_figure"]
