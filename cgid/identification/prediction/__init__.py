"""From a recording to answers, fractions and decisions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.identification.prediction.answers import Answer, identify, identify_frames, suited
    from cgid.identification.prediction.fraction import Share
    from cgid.identification.prediction.pipeline import identify_recording
    from cgid.identification.prediction.prediction import load_model, predict
    from cgid.identification.prediction.settings import PredictionSettings

#: Module -> the public names that it defines.
_NAMES = {
    "answers": ("Answer", "identify", "identify_frames", "suited"),
    "fraction": ("Share",),
    "pipeline": ("identify_recording",),
    "prediction": ("load_model", "predict"),
    "settings": ("PredictionSettings",),
}

__all__ = [
    "Answer",
    "PredictionSettings",
    "Share",
    "identify",
    "identify_frames",
    "identify_recording",
    "load_model",
    "predict",
    "suited",
]

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __getattr__, __dir__ = on_first_use(__name__, _NAMES)
