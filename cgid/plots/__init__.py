"""Every picture; matplotlib (extra `plot`) is loaded only here and only when asked."""

from cgid.plots.figure import COLOURS, FORMATS, colours_of, picture, plain, png, require_matplotlib
from cgid.plots.judgement import judgement_pictures
from cgid.plots.overview import MOST_CHANNELS, Mark, hertz, overview_figure, written
from cgid.plots.recording import recording_picture
from cgid.plots.response import frequency_response_picture
from cgid.plots.share import share_figure
from cgid.plots.survey import survey_picture

__all__ = [
    "COLOURS",
    "FORMATS",
    "MOST_CHANNELS",
    "Mark",
    "colours_of",
    "frequency_response_picture",
    "hertz",
    "judgement_pictures",
    "overview_figure",
    "picture",
    "plain",
    "png",
    "recording_picture",
    "require_matplotlib",
    "share_figure",
    "survey_picture",
    "written",
]
