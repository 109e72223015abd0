"""All pictures. matplotlib (extra `plot`) is imported only here, and only on use."""

from cgid.deprecated import renamed
from cgid.plots.answers import share_figure
from cgid.plots.figure import picture
from cgid.plots.recording import recording_picture

__all__ = ["picture", "recording_picture", "share_figure"]

_MOVED = {
    "answers": "draw_drawn drawn_figure finish_drawn gangue_at",
    "figure": "COLOURS FORMATS colours_of judgement_pictures modes_picture new_picture plain png require_matplotlib "
    "stabilisation_picture",
    "recording": "Mark hertz overview_figure written",
}
__getattr__ = renamed(
    __name__,
    {name: f"cgid.plots.{home}.{name}" for home, names in _MOVED.items() for name in names.split()}
    | {"MOST_CHANNELS": "cgid.plots.recording.MAX_CHANNELS"},
)
