"""From a signal to a material: detect impacts, measure features, predict labels, and train models for this.

All but `training`, which needs scikit-learn, is the predict path: numpy alone.
"""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)
