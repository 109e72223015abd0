"""Train a model: select features, fit, calibrate, and test on unseen specimens or groups.

Scenes and datasets have thousands of specimens: `train_on_specimens` holds out some for the test, some to calibrate
prediction sets. A manifest has a few groups of recordings: `train_on_groups` leaves out one group at a time in a nested
cross-validation (`cgid.identification.training.grouped`).
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import ClassifierMixin
from threadpoolctl import threadpool_limits

from cgid import __version__
from cgid._lib import validation
from cgid._lib.notebook import facts_table
from cgid._lib.validation import Floats
from cgid._lib.workers import SERIAL, Workers
from cgid.errors import BadData, InvalidValue
from cgid.identification.model.conformal import Conformal
from cgid.identification.model.families import Neighbourhood
from cgid.identification.model.model import Model, StoredModel
from cgid.identification.model.model_file import CONTROL, LEVEL_RANGE, MENDED, UNEXPLAINED, VOTE_CORRELATION
from cgid.identification.training.classifier import ImpactClassifier, Weights, contrast_of
from cgid.identification.training.control import TOTALS, odd_sources
from cgid.identification.training.control import judged as controlled
from cgid.identification.training.grouped import (
    Candidate,
    Selection,
    TrainingSet,
    candidates_for,
    choose_candidate,
    cross_validate,
    final,
    groups_of_labels,
    in_blocks_of_time,
    in_stretches,
    level_range,
    noise_guard,
    require_groups,
    warnings_of_few,
)
from cgid.identification.training.metrics import evaluate, evaluate_recordings, evaluate_sets
from cgid.identification.training.rows import (
    BEAM_GUARDS,
    DEFAULT_FEATURES,
    FEW_FEATURES,
    Rows,
    default_guards,
    features_for,
    linear_columns,
    measure,
    sets_for,
)
from cgid.measure.features.extraction import Named, any_through_beam, choose, name_of
from cgid.measure.features.pulses import MAX_UNEXPLAINED
from cgid.measure.modal.beam import Beam
from cgid.recordings.site import Site
from cgid.signals import Batch
from cgid.store.reading import Dataset
from cgid.units import quantity_of

__all__ = ["Training", "train_on_groups", "train_on_specimens"]

#: Fraction of the specimens in the test.
TEST_SHARE = 0.25
#: Fraction of the specimens that only calibrate the prediction sets.
CALIBRATION_SHARE = 0.1
#: Number of impacts from which a model of pulses always uses the features that distinguish laws of loss: for rocks of
#: one law they are noise, which costs .006 of the accuracy at 1,500 impacts and .0003 at 15,000.
MANY_FEATURES = 5_000
#: Impacts from which a network is larger and trains longer.
MANY = 100_000
#: Lower bounds for the limits of guards that may be 0 in all of the training: 5 % of clipping is accepted, and 1 % of
#: the energy if the beam differs slightly from the learned one.
MIN_LIMITS = {"overload": 0.05, "beam_surely_unexplained": 1.0}
#: Upper bounds: a pulse with a larger residual is not a single impact, whatever the training contains. Rock that breaks
#: leaves such residuals, too: where a contrast with strangers knows better, so many times as much is left to it.
MAX_LIMITS, LEFT_TO_CONTRAST = {"unexplained": MAX_UNEXPLAINED}, 4.0
#: Minimum number of calibration specimens of a label; below it all of them train. A coverage of .95 takes 19.
MIN_CALIBRATION_SPECIMENS = 20


@dataclass(frozen=True, eq=False)
class Training:
    """A trained model, its metrics, and its predictions for the test rows.

    Attributes
    ----------
    model : Model
        Ready for prediction.
    metrics : dict
        Results of `cgid.identification.training.metrics.evaluate` on the test rows, such as "accuracy" and
        "accuracy_interval_95"; under "prediction_sets" the coverage of prediction sets.
    test_labels : ndarray of str, (n_test,)
        The truth of the test rows.
    test_probabilities : ndarray, (n_test, n_labels)
        The model's probabilities, in the order of `model.labels`.
    classifier : ImpactClassifier or None
        The scikit-learn estimator of the model; None for a corrected model.
    rows : Rows or None
        The test rows, in the order of `test_labels`, with the recording, time and channel of each; only these of the
        rows that trained if a model was tested on all that it was trained on, group by group.
    unmended : Training or None
        The training whose answers followed what sounds between the rocks, if this one was made instead.
    """

    model: Model
    metrics: dict[str, Any]
    test_labels: NDArray[np.str_]
    test_probabilities: Floats
    classifier: ImpactClassifier | None
    rows: Rows | None = None
    unmended: Training | None = None

    @property
    def control(self) -> Mapping[str, Any] | None:
        """Whether the answers follow what sounds between the rocks; None if that was not asked.

        "told" says by what ("background", "path"; "" if they do not), "own" the accuracy as recorded, "same" and
        "other" with silence of its own label and of another added, "expected" the accuracy if the machines' states were
        swapped, "why" why it was not tried, "before" that of the model before it was mended.
        """
        return self.model.training.get(CONTROL)

    def __repr__(self) -> str:
        model, accuracy = f"{self.model.family}: {', '.join(self.model.labels)}", self.metrics["accuracy"]
        return f"Training({model}; accuracy {accuracy:.3f} on {len(self.test_labels)} test rows)"

    def _repr_html_(self) -> str:
        low, high = self.metrics["accuracy_interval_95"]
        facts = {
            "labels": ", ".join(self.model.labels),
            "inputs": len(self.model.inputs),
            "accuracy": f"{self.metrics['accuracy']:.3f} ({low:.3f} to {high:.3f})",
            "test rows": len(self.test_labels),
        }
        return facts_table(f"Training ({self.model.family})", facts)

    def save(self, path: str | Path, *, plots: bool = False, overwrite: bool = False) -> list[Path]:
        """Write the model and its card, and pictures if asked, all or nothing.

        Parameters
        ----------
        path : str or Path
            Name of the model, which ends in .npz; the card has the ending .md.
        plots : bool
            Whether to write pictures of confusion, reliability and ROC beside it (extra `plot`).
        overwrite : bool
            Whether to replace files of these names.

        Returns
        -------
        list of Path
            The files written.

        Raises
        ------
        CannotCreate
            A file exists, the name ends otherwise, or there is no such folder.
        WriteFailed
            The disk is full, for example; nothing is left behind.
        """
        from cgid.identification.training.card import check_model_output, write_model

        checked = check_model_output(Path(path), plots=plots, overwrite=overwrite)
        return write_model(self, checked, plots=plots, overwrite=overwrite)


def train_on_specimens(  # noqa: PLR0913
    data: Batch | Dataset | Iterable[Batch] | Rows | str | Path,
    *,
    features: Iterable[Named] | None = None,
    guards: Iterable[str] | None = None,
    family: str | ClassifierMixin = "logistic",
    test_share: float = TEST_SHARE,
    calibration_share: float = CALIBRATION_SHARE,
    judged_on: str | None = None,
    out_of_distribution: Rows | None = None,
    beam: Beam | None = None,
    class_weights: Weights = None,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
    workers: Workers = SERIAL,
) -> Training:
    """Train a model on labelled impacts of datasets or scenes, and test it on unseen specimens.

    Each fit uses one thread, so that the same data give the same model to the last digit on every machine.

    Parameters
    ----------
    data : Batch, Dataset, iterable of Batch, str, Path, or Rows
        Batches of a dataset or scene, or the path of a dataset; or rows, measured from batches
        (`cgid.identification.training.measure`).
    features : iterable of str, function or Feature, optional
        Also features of one's own, as in `cgid.extract`. Default: those in `cgid.identification.training.rows` for the
        quantity.
    guards : iterable of str, optional
        Features that only measure novelty (larger is more novel) and are left out of `features`. Default:
        `DEFAULT_GUARDS` for batches of pulses, else none.
    family : {"logistic", "network", "linear"} or classifier
        A classifier of scikit-learn's kind may stand here, as in `cgid.ImpactClassifier`. Linear scores can
        be saved as a model file, any other is for this Python.
    test_share : float
        Share of the specimens held out, in (0, 1).
    calibration_share : float
        Share of the specimens that only calibrate prediction sets, in [0, 1); 0 for none.
    judged_on : str, optional
        `source` of the batches for test and calibration; the others only train. Default: every source does all.
    out_of_distribution : Rows, optional
        Impacts of anything else, with the features and guards of the model; their labels do not matter. The model
        learns to distinguish them, which sharpens its novelty.
    beam : Beam, optional
        The beam whose vibrations the signals are, as from `cgid.scene.synthesis.through_beam.beam_of`; its modes lead
        to the contact force. Rows have their own.
    class_weights : dict or "balanced", optional
        Weights of the labels, as in `cgid.identification.training.ImpactClassifier`.
    seed : int
        Seed of splits and network.
    progress : callable, optional
        Called with the number of signals measured.
    workers : Workers
        Measures signals: see `cgid._lib.workers.workers`.

    Returns
    -------
    Training

    Raises
    ------
    BadData
        Fewer than two labels, too few specimens, or nothing to train on.
    InvalidValue
        An unknown choice, a label with a single specimen, a guard that is not positive, or rows of recordings.
    """
    seed = validation.whole("seed", seed, 0, 2**32 - 1)
    if isinstance(data, Rows):
        if data.slicing is not None:
            raise InvalidValue(
                "data must be of datasets or scenes, got rows of recordings; give them to train_on_groups"
            )
        rows, names, limiting = data, _named_in(data, features), _named_in(data, guards)
    else:
        data = Dataset(data) if isinstance(data, str | Path) else data
        batches = data.batches() if isinstance(data, Dataset) else [data] if isinstance(data, Batch) else data
        _refuse_others("data", batches, Iterable)
        rows, names, limiting = _measured(batches, features, guards, beam, progress, workers)
    rows = _in_one_spelling(rows)
    _require_labels(rows, class_weights)
    names = names or tuple(name for name in rows.names if name not in limiting)
    parts = _split(rows, judged_on, test_share, calibration_share, seed)
    record = {"seed": seed, "sources": [*rows.digests]}
    record |= {"test_share": test_share, "calibration_share": calibration_share, "judged_on": judged_on}
    is_open = features is None and names == DEFAULT_FEATURES and not isinstance(data, Rows)
    open_sets = pulse_sets(len(rows.labels)) if is_open else (names,)
    fitted = (open_sets, limiting, family, class_weights, seed, workers, record)
    return _tried_on_left_out(rows, parts, out_of_distribution, *fitted)


def train_on_groups(
    rows: Rows | str | Path,
    *,
    features: Iterable[Named] | None = None,
    family: str | ClassifierMixin = "linear",
    class_weights: Weights = None,
    site: Site | str | Path | None = None,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
    workers: Workers = SERIAL,
) -> Training:
    """Train a model on the impacts or windows of labelled recordings, and test it on unseen groups of recordings.

    Parameters
    ----------
    rows : Rows, str or Path
        The manifest of labelled recordings, as for `cgid train`: a table with the columns path and label, or a folder
        with a subfolder for each label. Or rows, measured with other settings than the usual ones by
        `cgid.identification.training.recordings.record(read_manifest(path), ...)`.
    features : iterable of str, function or Feature, optional
        Default: the best of the sets of `cgid.identification.training.rows`.
    family : {"logistic", "network", "linear"} or classifier
        A classifier of scikit-learn's kind may stand here, as in `cgid.ImpactClassifier`. Linear scores can
        be saved as a model file, any other is for this Python.
    class_weights : dict or "balanced", optional
        Weights of the labels, as in `cgid.identification.training.ImpactClassifier`.
    site : Site, str or Path, optional
        A site, or its file, which states what a manifest and its recordings do not.
    seed : int
        Seed of folds and network.
    progress : callable, optional
        Called with 1 for each tested group.
    workers : Workers
        Fits folds: see `cgid._lib.workers.workers`.

    Returns
    -------
    Training

    Raises
    ------
    BadData
        Fewer than two labels, or too few groups, or a recording that cannot be read.
    InvalidValue
        An unknown choice, rows of datasets or scenes, or a site for rows that are measured already.
    """
    seed = validation.whole("seed", seed, 0, 2**32 - 1)
    if site is not None and not isinstance(rows, str | Path):
        raise InvalidValue("site must be left out, rows are measured already; give the path of their manifest")
    if isinstance(rows, str | Path):
        from cgid.identification.training import recordings
        from cgid.identification.training.manifest import folder_manifest, read_manifest

        manifest = folder_manifest(rows) if Path(rows).is_dir() else read_manifest(rows)
        features = None if features is None else choose(features)
        reading = recordings.Reading(strict=True, site=Site.of(site))
        rows = recordings.record(manifest, features, reading=reading, augment=True)
    _refuse_others("rows", rows, Rows)
    if rows.slicing is None:
        raise InvalidValue(
            "rows must be of recordings, got those of a dataset or scene; give them to train_on_specimens"
        )
    names = _named_in(rows, features)
    is_of_one = len(set(rows.digests)) == 1 and len(rows.groups) == 1
    if is_of_one:
        stretched = in_stretches(rows)
        rows = in_blocks_of_time(rows) if stretched is None else stretched
        if stretched is not None and class_weights is None:
            # How long each material was labelled says nothing of how often it falls.
            class_weights = "balanced"
    rows = _in_one_spelling(rows)
    _require_labels(rows, class_weights)
    record = {"seed": seed, "sources": [*rows.digests]}
    record |= {"one_recording": is_of_one, **({"same_beam": [*rows.same_beam]} if rows.same_beam else {})}
    sets = {"asked for": names} if names else sets_for(rows.kind, rows.sampling_rates[0])
    candidates = candidates_for(sets, rows.names, family)
    again, rows = rows.again, replace(rows, again=None)
    training_set = TrainingSet(rows=rows, candidates=candidates, weights=class_weights, seed=seed)
    training = _left_out(training_set, progress, workers, record)
    # Another gain or filter cannot be taken out.
    if again is None or is_of_one or told(training) != "background":
        return training
    with suppress(BadData):  # nothing may be left without the tones
        mended = _left_out(_mended(training_set, again()), None, workers, record | {MENDED: True})
        if not told(mended):
            control = {**mended.model.training[CONTROL], "before": training.model.training[CONTROL]}
            model = replace(mended.model, training={**mended.model.training, CONTROL: control})
            return replace(mended, model=model, unmended=training)
    return training


def told(training: Training) -> str:
    """Return by what a training is told to follow what sounds between the rocks; empty if it does not."""
    return str((training.control or {}).get("told", ""))


def _mended(training_set: TrainingSet, rows: Rows) -> TrainingSet:
    """Return a training on rows without tones, levels from a floor on, and copies with another label's background."""
    rows = _in_one_spelling(rows)
    floor = np.tile(rows.floor, rows.n_channels)
    rows = replace(
        rows, features=np.maximum(rows.features, floor), background=np.maximum(rows.background, floor), again=None
    )

    def levels(name: str) -> tuple[str, ...]:
        """Return the level of a relative one, which has a floor."""
        plain, total = name.replace("relative_", ""), TOTALS.get(rows.kind, "")
        return (plain, total) if plain != name and {plain, total} <= set(rows.names) else (name,)

    candidates = {
        names: replace(one, name=f"{one.name}, from a floor", features=names)
        for one in training_set.candidates
        for names in [tuple(dict.fromkeys(level for name in one.features for level in levels(name)))]
    }
    return replace(training_set, rows=rows, candidates=tuple(candidates.values()), copies=True)


def _named_in(rows: Rows, features: Iterable[Named] | None) -> tuple[str, ...]:
    """Return the names of features, which must be those of rows."""
    names = tuple(map(name_of, features or ()))
    for name in names:
        validation.choice("feature of rows", name, rows.names)
    return names


def _refuse_others(name: str, given: Any, kind: type) -> None:
    """Raise `InvalidValue` for a table or array of features, which has no signals, and for what is not of a kind."""
    if hasattr(given, "shape") or not isinstance(given, kind):
        raise InvalidValue(
            f"{name} must be signals or rows measured from them, got {type(given).__name__}; a table of features "
            "trains cgid.ImpactClassifier().fit(table, labels), labelled recordings go to "
            "cgid.train_on_groups(path of their table)"
        )


def pulse_sets(n_impacts: int) -> tuple[tuple[str, ...], ...]:
    """Return the candidate sets of features of a model of pulses; only the first if there are too few impacts."""
    return (FEW_FEATURES, DEFAULT_FEATURES) if n_impacts < MANY_FEATURES else (DEFAULT_FEATURES,)


def _measured(
    batches: Iterable[Batch],
    features: Iterable[Named] | None,
    guards: Iterable[str] | None,
    beam: Beam | None,
    progress: Callable[[int], object] | None,
    workers: Workers,
) -> tuple[Rows, tuple[str, ...], tuple[str, ...]]:
    """Return the rows of batches, and the names of their features and of their guards."""
    batches, names = features_for(batches, features, beam)
    guards = default_guards(names) if guards is None else tuple(guards)
    guards = choose(guards) if guards else ()
    names = tuple(name for name in names if name not in guards)
    with threadpool_limits(1):
        rows = measure(batches, names + guards, progress, beam=beam, workers=workers)
    return rows, names, guards


def _in_one_spelling(rows: Rows) -> Rows:
    """Return the rows with one spelling of labels that differ only in case or blanks."""
    used = validation.one_spelling("data", rows.labels.tolist())
    return replace(rows, labels=np.array([used.get(label, label) for label in rows.labels.tolist()], np.str_))


def _require_labels(rows: Rows, class_weights: Weights) -> None:
    """Raise unless there are two labels in enough groups, and the weights are positive and name these labels."""
    labels = np.unique(rows.labels)
    if rows.slicing is not None:
        require_groups(rows.labels, rows.group)
    elif len(labels) < 2:
        raise BadData(
            f"data must have at least 2 labels, got {', '.join(labels) or 'none'}; add data of another material"
        )
    for label, weight in class_weights.items() if isinstance(class_weights, Mapping) else ():
        validation.choice("label of class_weights", label, tuple(labels.tolist()))
        validation.positive(f"class weight of {label}", weight)


def _trained(
    rows: Rows,
    classifier: ImpactClassifier,
    judged: tuple[Rows, Floats],
    metrics: dict[str, Any],
    record: Mapping[str, Any],
    **fields: Any,
) -> Training:
    """Return the model of a classifier, with its `record` for the card and its rows and predictions in the test."""
    slicing = rows.slicing if rows.kind == "window" else None
    model = StoredModel.from_classifier(
        classifier,
        unit=rows.unit,
        sampling_rates=rows.sampling_rates,
        window_time=0.0 if slicing is None else slicing.window_time,
        hop_time=0.0 if slicing is None else slicing.hop_time,
        n_channels=rows.n_channels,
        training={
            **record,
            "quantity": quantity_of(rows.unit),
            "n_left_out": rows.left_out,
            "versions": {"cgid": __version__, "python": platform.python_version()}
            | {name: version(name) for name in ("numpy", "scikit-learn")},
            "metrics": metrics,
        },
        **fields,
    )
    tested, probabilities = judged
    return Training(model, metrics, tested.labels, probabilities, classifier, tested)


# -- many specimens: held out -----------------------------------------------------------------------------


def hold_out(
    labels: NDArray[np.str_], specimen: NDArray[np.integer], share: float = TEST_SHARE, seed: int = 0
) -> NDArray[np.bool_]:
    """Return a mask of the impacts to hold out: complete specimens, the same fraction of each label."""
    if not 0 < share < 1:
        raise InvalidValue(f"test share must be between 0 and 1, got {share:g}")
    generator = np.random.default_rng(seed)
    left_out: list[NDArray[np.integer]] = []
    for label in np.unique(labels):
        of_label = np.unique(specimen[labels == label])
        if len(of_label) < 2:
            raise InvalidValue(
                f"label {label} must have at least 2 specimens, for training and test, got {len(of_label)}"
            )
        count = min(max(round(share * len(of_label)), 1), len(of_label) - 1)
        left_out.append(generator.permutation(of_label)[:count])
    return np.isin(specimen, np.concatenate(left_out))


def calibration_mask(
    labels: NDArray[np.str_],
    specimen: NDArray[np.integer],
    test: NDArray[np.bool_],
    share: float = CALIBRATION_SHARE,
    seed: int = 0,
) -> NDArray[np.bool_]:
    """Return a mask of calibration impacts: specimens outside the test, the same fraction of each label."""
    if not 0 <= share < 1:
        raise InvalidValue(f"calibration share must be between 0 and 1, got {share:g}")
    excluded = np.zeros(len(labels), bool)
    counts = [len(np.unique(specimen[labels == label])) for label in np.unique(labels)]
    if share * min(counts) < MIN_CALIBRATION_SPECIMENS:
        return excluded
    left = 1 - len(np.unique(specimen[test])) / sum(counts)
    if share >= left:
        raise InvalidValue(f"test and calibration share must leave some for training, got {1 - left:.3g} and {share:g}")
    # The seed of the test would draw the same ranks of the same specimens.
    excluded[~test] = hold_out(labels[~test], specimen[~test], share / left, seed + 1)
    return excluded


def _split(
    rows: Rows, judged_on: str | None, test_share: float, calibration_share: float, seed: int
) -> dict[str, NDArray[np.bool_]]:
    """Return masks of the impacts for training, calibration and test."""
    labels, specimen = rows.labels, rows.group
    home = np.ones(len(labels), bool)
    if judged_on is not None:
        validation.choice("judged_on", judged_on, rows.sources)
        home = np.asarray(rows.source == rows.sources.index(judged_on))
    test, calibration = np.zeros_like(home), np.zeros_like(home)
    test[home] = hold_out(labels[home], specimen[home], test_share, seed)
    calibration[home] = calibration_mask(labels[home], specimen[home], test[home], calibration_share, seed)
    # A specimen of the test or calibration never trains, not even in another source.
    return {"train": ~np.isin(specimen, specimen[test | calibration]), "calibration": calibration, "test": test}


def _tried_on_left_out(
    rows: Rows,
    parts: Mapping[str, NDArray[np.bool_]],
    out_of_distribution: Rows | None,
    open_sets: tuple[tuple[str, ...], ...],
    guards: tuple[str, ...],
    family: str | ClassifierMixin,
    class_weights: Weights,
    seed: int,
    workers: Workers,
    record: Mapping[str, Any],
) -> Training:
    """Fit on some specimens, calibrate on others, test on the rest; select the best features for unseen impacts."""
    labels, specimen = rows.labels, rows.group
    training, calibration, test = parts["train"], parts["calibration"], parts["test"]

    def fitted(names: tuple[str, ...], inputs: Floats) -> ImpactClassifier:
        size = (48, 400) if training.sum() >= MANY else (32, 200)
        classifier = ImpactClassifier(
            family=family,
            linear=linear_columns(names),
            n_units=size[0],
            n_iterations=size[1],
            class_weight=class_weights,
            random_state=seed,
        )
        return classifier.fit(inputs[training], labels[training], specimen[training], workers=workers)

    with threadpool_limits(1):
        tried = {names: np.ascontiguousarray(rows.columns(names)) for names in open_sets}
        classifiers = {names: fitted(names, inputs) for names, inputs in tried.items()}
        names = min(classifiers, key=lambda one: np.nan_to_num(classifiers[one].held_out_loss_, nan=np.inf))
        classifier, inputs = classifiers[names], tried[names]
        conformal = _calibrated(classifier, inputs[calibration], labels[calibration], specimen[calibration], seed)
        probabilities = classifier.predict_proba(inputs[test])
        contrast = None
        if out_of_distribution is not None:
            known, others = rows.columns(names + guards)[training], out_of_distribution.columns(names + guards)
            contrast = contrast_of(known, others, linear_columns(names + guards), seed)
            record = {**record, "n_strangers": len(others)}
    classes = tuple(str(label) for label in classifier.classes_)
    metrics = evaluate(labels[test], probabilities, classes, len(np.unique(specimen[test])))
    sets = [] if conformal is None else evaluate_sets(labels[test], probabilities, classes, conformal)
    record = {
        **record,
        **{f"n_{part}_specimens": len(np.unique(specimen[known])) for part, known in parts.items()},
        "n_train": int(training.sum()),
        **({UNEXPLAINED: float(np.median(rows.columns(BEAM_GUARDS[:1])[training]))} if guards == BEAM_GUARDS else {}),
        **({} if class_weights is None else {"class_weights": class_weights}),
    }
    return _trained(
        rows,
        classifier,
        (rows[test], probabilities),
        metrics | {"prediction_sets": sets},
        record,
        features=names,
        guards=_guard_limits(guards, rows.columns(guards)[training], 1.0 if contrast is None else LEFT_TO_CONTRAST),
        conformal=conformal,
        contrast=contrast,
        beam=rows.beam if any_through_beam(names) else None,
    )


def _calibrated(
    classifier: ImpactClassifier, inputs: Floats, labels: NDArray[np.str_], specimen: NDArray[np.integer], seed: int
) -> Conformal | None:
    """Calibrate on one impact of each specimen, because impacts of one specimen are not independent."""
    if not len(labels):
        return None
    order = np.random.default_rng(seed).permutation(len(labels))
    one = order[np.unique(specimen[order], return_index=True)[1]]
    return Conformal.fit(classifier.predict_proba(inputs[one]), np.searchsorted(classifier.classes_, labels[one]))


def _guard_limits(guards: tuple[str, ...], values: Floats, widened: float) -> dict[str, float]:
    limits = {
        name: min(
            max(float(np.quantile(column, Neighbourhood.INSIDE)), MIN_LIMITS.get(name, 0.0)),
            widened * MAX_LIMITS.get(name, np.inf),
        )
        for name, column in zip(guards, values.T, strict=True)
    }
    for name, limit in limits.items():
        if limit <= 0:
            raise InvalidValue(
                f"guard {name} must be above 0 for out-of-distribution impacts, {Neighbourhood.INSIDE:.1%} of the "
                f"training have at most {limit:g}; use it as a feature"
            )
    return limits


# -- few groups of recordings: left out one by one --------------------------------------------------------


def _left_out(
    training_set: TrainingSet,
    progress: Callable[[int], object] | None,
    workers: Workers,
    record: Mapping[str, Any],
) -> Training:
    """Fit on all rows; each group tests the candidate selected and trained on the others."""
    rows = training_set.rows
    assert rows.slicing is not None
    judged = cross_validate(training_set, progress, workers)
    selection = choose_candidate(training_set, workers)
    recorded_rows, counts = rows[rows.is_recorded], groups_of_labels(rows)
    answers = np.unique(recorded_rows.labels)[np.argmax(judged.probabilities, axis=1)]
    control = controlled(recorded_rows, answers, judged.again)
    classifier, levels = final(training_set, selection, workers)
    features = training_set.candidates[selection.best].features
    guards = tuple(name for name in default_guards(features) if name in rows.names and name not in features)
    # Few rows do not show their 99.9 % quantile, and what was labelled is an impact.
    limits = {
        name: max(float(np.quantile(column, Neighbourhood.INSIDE)), MAX_LIMITS[name])
        for name, column in zip(guards, recorded_rows.columns(guards).T, strict=True)
    }
    recorded = {
        "by": rows.slicing.by,
        "n_groups": len(np.unique(rows.group)),
        "fewest_groups": min(counts.values()),
        "n_recordings": len(rows.sources),
        "class_weights": training_set.weights,
        "candidates": _comparison(training_set.candidates, selection, judged.chosen),
        "failures": [str(error) for error in rows.failures],
        "warnings": [*rows.warnings, *warnings_of_few(recorded_rows), *odd_sources(rows.levels_of_sources)],
        "levels_of_sources": [*rows.levels_of_sources],
    }
    return _trained(
        rows,
        classifier,
        (recorded_rows, judged.probabilities),
        evaluate_recordings(recorded_rows, judged.probabilities),
        {
            **record,
            "n_train": len(recorded_rows.labels),
            "recorded": recorded,
            **({CONTROL: control} if len(rows.background) else {}),
            LEVEL_RANGE: level_range(rows, levels),
            **({VOTE_CORRELATION: selection.vote_correlation} if rows.kind == "window" else {}),
        },
        features=features,
        guards=limits,
        contrast=noise_guard(training_set, selection, workers),
        floor=rows.floor[[rows.names.index(name) for name in features]] if len(rows.floor) else None,
    )


def _comparison(candidates: Sequence[Candidate], selection: Selection, selected: Sequence[int]) -> list[dict[str, Any]]:
    return [
        {
            "name": candidate.name,
            "family": candidate.family if isinstance(candidate.family, str) else type(candidate.family).__name__,
            "n_features": len(candidate.features),
            "accuracy": accuracy,
            "taken_in_folds": selected.count(k),
            "chosen": k == selection.best,
        }
        for k, (candidate, accuracy) in enumerate(zip(candidates, selection.accuracies, strict=True))
    ]
