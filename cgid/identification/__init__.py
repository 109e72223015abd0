"""From a signal to a material: detect impacts, measure features, predict labels, and train models for this.

All but `training`, which needs scikit-learn, is the predict path: numpy alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.identification import detection as detection
    from cgid.identification import inversion as inversion
    from cgid.identification import model as model
    from cgid.identification import prediction as prediction
    from cgid.identification import training as training
else:  # a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(
        __name__, {}, modules=("detection", "inversion", "model", "prediction", "training")
    )
