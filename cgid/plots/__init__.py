"""All pictures. matplotlib (extra `plot`) is imported only here, and only on use."""

from cgid.plots.answers import draw_drawn, drawn_figure, finish_drawn, gangue_at, share_figure
from cgid.plots.figure import (
    COLOURS,
    FORMATS,
    colours_of,
    judgement_pictures,
    modes_picture,
    new_picture,
    picture,
    plain,
    png,
    require_matplotlib,
    stabilisation_picture,
)
from cgid.plots.recording import MOST_CHANNELS, Mark, hertz, overview_figure, recording_picture, written

__all__ = [
    "COLOURS",
    "FORMATS",
    "MOST_CHANNELS",
    "Mark",
    "colours_of",
    "draw_drawn",
    "drawn_figure",
    "finish_drawn",
    "gangue_at",
    "hertz",
    "judgement_pictures",
    "modes_picture",
    "new_picture",
    "overview_figure",
    "picture",
    "plain",
    "png",
    "recording_picture",
    "require_matplotlib",
    "share_figure",
    "stabilisation_picture",
    "written",
]
