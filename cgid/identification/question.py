"""The former name of `cgid.identification.prediction_settings`."""

from cgid.deprecated import renamed

__getattr__ = renamed(__name__, {"Question": "cgid.identification.prediction_settings.PredictionSettings"})
