"""What the labels are worth: a new model and a correction of an old one, each judged on impacts that it did not see."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cgid._lib.spelling import spelled
from cgid._lib.validation import UNKNOWN, Floats
from cgid._lib.workers import Workers
from cgid.errors import BadData, CgidError, InvalidValue, Stopped
from cgid.identification.detection.events import SAME_IMPACT
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.training.rows import Rows
from cgid.labelling.recording import LabelledRecording, rows_of_all

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.training.manifest import Annotation, Manifest
    from cgid.identification.training.training import Training

#: Names of the sets of features: those of the model that is corrected, and those of a new one.
BASE, NEW = "corrected", "new"
#: Labelled impacts of each label from which a new model is tried.
MIN_EACH = 8
#: A control is made anew after so many times as long as the last one took.
_SELDOM = 5.0


@dataclass(eq=False)
class Learning:
    """The models of the labels so far."""

    base: StoredModel | None
    stopped: Callable[[], bool]
    trainings: dict[str, Training] = field(default_factory=dict)
    why: dict[str, str] = field(default_factory=dict)  # why there is no model of a name
    notes: list[str] = field(default_factory=list)
    version: int = 0  # grows with each learning
    n_labelled: int = 0
    control: list[str] = field(default_factory=list)  # whether the answers follow what sounds between the rocks
    _next_control: float = 0.0

    def learn(self, recordings: Sequence[LabelledRecording], manifest: Manifest | None) -> None:
        """Train and correct with the labels of a table; raises `Stopped`."""
        from cgid.identification.training.recordings import labelled

        notes = list[str]()
        for name, learn in ((NEW, self._trained), (BASE, self._corrected)):
            rows = rows_of_all(recordings, name)
            try:
                if manifest is None or rows is None:
                    raise BadData("nothing is labelled yet")
                if any(name in one.cuttings and name not in one.measured and not one.fault for one in recordings):
                    raise BadData("its impacts are still being measured")
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    self.trainings[name] = learn(labelled(rows, manifest))
                notes += [str(one.message) for one in caught if issubclass(one.category, UserWarning)]
                self.why.pop(name, None)
            except Stopped:
                raise
            except CgidError as error:
                self.trainings.pop(name, None)
                self.why[name] = str(error)
        self.notes = list(dict.fromkeys(notes))
        self.version += 1

    def hear(self, recordings: Sequence[LabelledRecording], manifest: Manifest | None, *, now: bool = False) -> None:
        """Train the new model with a control, for which the labelled recordings are read twice; not too often."""
        from cgid.identification.prediction.fraction import followed
        from cgid.identification.training.control import control_notes
        from cgid.identification.training.recordings import controlled
        from cgid.identification.training.training import train_on_groups

        begin = time.monotonic()
        if manifest is None or NEW not in self.trainings or (begin < self._next_control and not now):
            return

        def go_on(_: int) -> None:
            if self.stopped():
                raise Stopped("the page was closed")

        by_file: dict[tuple[str, str], list[Annotation]] = {}
        for row in manifest.annotations:
            by_file.setdefault((str(row.path), str(row.channels)), []).append(row)
        files = [
            replace(one.file, annotations=tuple(sorted(labelled, key=lambda row: row.start)))
            for one in recordings
            for first in one.file.annotations[:1]
            if not one.fault and (labelled := by_file.get((str(first.path), str(first.channels))))
        ]
        try:
            rows = controlled(files, recordings[0].cuttings[NEW], go_on)
            training = train_on_groups(rows, workers=Workers(stopped=self.stopped))
            self.trainings[NEW], record = training, training.model.training
            self.control = [f"{one}" for one in (followed(record), *control_notes(training.control or {})) if one]
            if (training.control or {}).get("told"):
                names: dict[str, list[str]] = {one: [] for one in training.model.labels}
                for source in record["recorded"]["levels_of_sources"]:
                    names[source["label"]].append(source["name"])
                self.control += [
                    f"no {label} is labelled in the state of the machines of "
                    + ", ".join(name for other, of in names.items() if other != label for name in of)
                    for label in names
                ]
        except BadData as error:
            self.control = [str(error)]
        self.version += 1
        self._next_control = time.monotonic() + _SELDOM * (time.monotonic() - begin)

    def _trained(self, rows: Rows) -> Training:
        from cgid.identification.training.training import train_on_groups

        rocks = np.unique(rows.rock, return_index=True)[1]
        self.n_labelled = len(rocks)
        names, counts = np.unique(rows.labels[rocks], return_counts=True)
        if len(names) < 2 or counts.min() < MIN_EACH:
            found = ", ".join(f"{name} {n}" for name, n in zip(names.tolist(), counts.tolist(), strict=True)) or "none"
            raise BadData(f"{MIN_EACH} impacts of each of two labels are needed, got {found}")
        return train_on_groups(rows, workers=Workers(stopped=self.stopped))

    def _corrected(self, rows: Rows) -> Training:
        from cgid.identification.training.correction import correct
        from cgid.identification.training.training import Training

        if self.base is None:
            raise BadData(f"there is no model to correct; give {spelled('model')}")
        made = correct(self.base, rows)
        return Training(made.model, dict(made.after), made.labels, made.probabilities, None, made.rows)

    def model(self, name: str) -> StoredModel | None:
        """Return the model of a name, for another name the one that is corrected."""
        from cgid.identification.model.model import stored

        training = self.trainings.get(name)
        return self.base if training is None else stored(training.model)

    @property
    def best(self) -> str:
        """The name of the model that was more often right, a new one only if it is clearly so."""
        found = {name: one.metrics["accuracy"] for name, one in self.trainings.items()}
        return max(found, key=lambda name: (found[name], name == BASE)) if found else "base"

    def content(self) -> dict[str, Any]:
        """Return the results for the page."""
        from cgid.identification.training.metrics import drawn_text

        results = {}
        for name, training in self.trainings.items():
            metrics = training.metrics
            drawn = metrics.get("drawn") or training.model.training.get("correction", {}).get("drawn")
            text, control = None if drawn is None else drawn_text(drawn), training.control or {}
            if control.get("told"):
                here, elsewhere = f"{metrics['accuracy']:.2f}", f"{control['expected']:.1f}"
                text = f"right on {here} in these recordings, on about {elsewhere} in others' machines"
            results[name] = {
                "labels": list(training.model.labels),
                "n": len(training.test_labels),
                "drawn": drawn,
                "text": text,
                **{key: metrics[key] for key in ("accuracy", "accuracy_interval_95", "confusion", "reliability")},
            }
        return {
            "version": self.version,
            "n_labelled": self.n_labelled,
            "best": self.best,
            "results": results,
            "why": self.why,
            "control": self.control,
            "notes": self.notes,
            "has_base": self.base is not None,
        }

    def save(self, name: str, path: Path, *, overwrite: bool) -> list[Path]:
        """Write a model and its card."""
        from cgid.identification.training.card import correction_section, write_model

        training = self.trainings.get(name)
        if training is None:
            raise InvalidValue(f"there is no {name} model yet: {self.why.get(name, 'label impacts first')}")
        correction = training.model.training.get("correction") if name == BASE else None
        further = [] if correction is None else [correction_section(correction)]
        return write_model(training, path, plots=False, overwrite=overwrite, further=further)


def predictions(recording: LabelledRecording, model: StoredModel, name: str) -> tuple[list[Floats | None], Floats]:
    """Return the mean probabilities of each impact over its channels, None where not measured; and the novelties."""
    rows, impacts = rows_of_all([recording], name), list(recording.impacts)
    found, novelty = list[Floats | None]([None] * len(impacts)), np.full(len(impacts), np.nan)
    if rows is None or not impacts:
        return found, novelty
    probabilities = model.probabilities(rows.columns(model.features))
    novelties = model.novelty(rows.columns(model.features), rows.columns(model.guards))
    order = np.argsort(rows.time, kind="stable")
    times, starts = rows.time[order], np.array([one.time for one in impacts])
    first, last = (np.searchsorted(times, starts + shift) for shift in (-1e-6, 2 * SAME_IMPACT))
    last = np.minimum(last, np.append(first[1:], len(times)))
    for number, (begin, end) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        if begin < end:
            found[number] = probabilities[order[begin:end]].mean(axis=0)
            novelty[number] = novelties[order[begin:end]].min()
    return found, novelty


def fraction(recording: LabelledRecording, model: StoredModel, name: str) -> dict[str, Any]:
    """Return the gangue fraction over time and the decisions, of all channels together."""
    from cgid.identification.prediction.answers import Answer
    from cgid.identification.prediction.support import CavingWatch

    found, novelty = predictions(recording, model, name)
    settings = PredictionSettings()
    try:
        watch = CavingWatch(model, ("all",), settings)
    except CgidError as error:
        return {"shares": [], "turns": [], "threshold": None, "why": str(error)}
    answers = [
        Answer(
            time=impact.time,
            label=UNKNOWN if novelty[k] > 1 else model.labels[int(one.argmax())],
            probabilities=dict(zip(model.labels, one.tolist(), strict=True)),
            novelty=float(novelty[k]),
            in_training_range=bool(novelty[k] <= 1),
            channel="all",
        )
        for k, (impact, one) in enumerate(zip(recording.impacts, found, strict=False))
        if one is not None
    ]
    reports = [*watch.feed(answers, recording.duration), *watch.finish(recording.duration)]
    states = [report.state for report in reports if report.kind == "share"]
    numbers = [(one.time, one.share.share, one.share.low, one.share.high) for one in states]
    return {
        "shares": [[None if x is None or not np.isfinite(x) else float(x) for x in row] for row in numbers],
        "turns": [[one.state.time, one.kind] for one in reports if one.kind in ("shut", "open")],
        "threshold": watch.threshold,
        "why": "",
    }
