"""From a recording to answers, fractions and decisions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.identification.prediction.answers import Answer as Answer
    from cgid.identification.prediction.answers import identify as identify
    from cgid.identification.prediction.answers import identify_frames as identify_frames
    from cgid.identification.prediction.answers import suited as suited
    from cgid.identification.prediction.fraction import Share as Share
    from cgid.identification.prediction.pipeline import identify_recording as identify_recording
    from cgid.identification.prediction.prediction import load_model as load_model
    from cgid.identification.prediction.prediction import predict as predict
    from cgid.identification.prediction.settings import PredictionSettings as PredictionSettings

#: Module -> the public names that it defines.
_NAMES = {
    "answers": ("Answer", "identify", "identify_frames", "suited"),
    "fraction": ("Share",),
    "pipeline": ("identify_recording",),
    "prediction": ("load_model", "predict"),
    "settings": ("PredictionSettings",),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)
