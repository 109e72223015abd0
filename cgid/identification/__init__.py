"""From a signal to a material: detect impacts, measure features, predict labels, and train models for this.

Prediction (`events`, `model`, `answers`) needs numpy alone, training (`training`, `classifier`) scikit-learn.
"""

__all__ = [  # the modules with public names
    "answers",
    "card",
    "estimation",
    "events",
    "prediction_settings",
    "rows",
    "share",
    "training",
]
