"""Predictions for labelled signals of one impact each, as in datasets: no impacts to find."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from cgid._lib.spelling import spelled
from cgid.errors import BadData, InvalidValue
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import Answer, identify_frames
from cgid.identification.prediction.settings import PredictionSettings
from cgid.signals import Batch
from cgid.units import UNITS, quantity_of


def identify_batches(
    batches: Iterable[Batch], model: StoredModel, settings: PredictionSettings, source: str
) -> Iterator[tuple[Batch, list[Answer]]]:
    """Yield each batch with one prediction for each of its signals.

    Parameters
    ----------
    batches : iterable of Batch
    model : Model
    settings : PredictionSettings
        Of the decision, and `invert`.
    source : str
        Name for error messages.

    Yields
    ------
    batch : Batch
    answers : list of Answer

    Raises
    ------
    BadData
        The signals are of another quantity than the model's.
    InvalidValue
        Channels of one beam are given.
    """
    require_one_signal(settings, source)
    for batch in batches:
        quantity = quantity_of(batch.unit)
        if quantity != model.quantity:
            raise BadData(
                f"{source}: the quantity must be {model.quantity} [{model.unit}], got {quantity} "
                f"[{batch.unit}]; train a model on such signals"
            )
        factor = UNITS[quantity][batch.unit] / UNITS[quantity][model.unit] * (-1 if settings.invert else 1)
        answers = identify_frames(
            batch.signals if factor == 1 else batch.signals * factor,
            batch.sampling_rate,
            model,
            settings,
            pre_trigger=batch.pre_trigger,
        )
        yield batch, answers


def require_one_signal(settings: PredictionSettings, source: str) -> None:
    """Raise `InvalidValue` for channels of one beam, which a dataset does not have."""
    if settings.same_beam:
        raise InvalidValue(
            f"{source}: {spelled('same_beam')} is for recordings, a dataset has one signal an impact; leave it out"
        )
