"""Write models with their cards: requirements, quality and limits of a model, in Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from cgid._lib.files import check_new, write_together
from cgid._lib.terminal import counted, printable
from cgid.errors import CannotCreate
from cgid.identification.detection.detector import VIBRATION_DEAD_TIME
from cgid.identification.model.model import MIN_GROUPS, Model, StoredModel, stored
from cgid.identification.prediction.fraction import followed
from cgid.identification.training.control import control_notes
from cgid.identification.training.grouped import untold_scale
from cgid.identification.training.metrics import drawn_text
from cgid.measure.features import FEATURES

if TYPE_CHECKING:
    from cgid.identification.training.training import Training

__all__ = ["write_card"]

Record = Mapping[str, Any]
#: Title and lines of a section.
Section = tuple[str, list[str]]
#: The pictures of a model.
PICTURES = ("confusion", "reliability", "roc")
#: Maximum number of features that a card lists.
_MAX_NAMES = 60
_SHAPES = {"pulse": "positive pulses", "vibration": "vibrations of both signs", "window": "recordings in windows"}
#: Characters that Markdown or HTML interprets within a line; an underscore only at the edge of a word.
_MARKS = re.compile(r"[\\`*\[\]<>&|~]|\b_|_\b|(?<=_)_|_(?=_)")


# -- files ------------------------------------------------------------------------------------------------


def check_model_output(path: Path, *, plots: bool = False, overwrite: bool = False) -> Path:
    """Return the path if a model may be written there; call this before any work."""
    if path.suffix != ".npz":
        raise CannotCreate(f"{path}: the name of a model must end in .npz, got {path.suffix or 'no ending'!r}")
    for one in (path, *beside_model(path, plots=plots)):
        check_new(one, "a file beside a model", (one.suffix,), overwrite=overwrite)
    if plots:
        from cgid.plots.figure import require_matplotlib

        require_matplotlib()
    return path


def beside_model(path: Path, *, plots: bool) -> list[Path]:
    """Return the card of a model, and its pictures."""
    pictures = [f"{path.stem}-{name}.png" for name in PICTURES] if plots else []
    return [path.with_name(name) for name in (f"{path.stem}.md", *pictures)]


def write_model(
    training: Training, path: Path, *, plots: bool = False, overwrite: bool = True, further: Sequence[Section] = ()
) -> list[Path]:
    """Write pictures, card and model, all or nothing; return the files written."""
    pictures: dict[str, bytes] = {}
    if plots:
        from cgid.plots.figure import judgement_pictures

        labels, probabilities = training.test_labels, training.test_probabilities
        drawn = judgement_pictures(labels, probabilities, training.model.labels, training.metrics)
        pictures = {f"{path.stem}-{name}.png": picture for name, picture in drawn.items()}
    contents = {
        **pictures,
        f"{path.stem}.md": write_card(training.model, path.name, tuple(pictures), further).encode(),
        path.name: stored(training.model).to_bytes(),
    }
    files = {path.with_name(name): content for name, content in contents.items()}
    write_together(files, overwrite=overwrite)
    return list(files)


# -- the card ---------------------------------------------------------------------------------------------


def write_card(model: Model, name: str, pictures: tuple[str, ...] = (), further: Sequence[Section] = ()) -> str:
    """Return the card of a model in Markdown.

    Parameters
    ----------
    model : Model
    name : str
        Name of the model file.
    pictures : tuple of str
        Paths relative to the card.
    further : sequence of sections
        Titles and lines of sections to add before the limits.

    Returns
    -------
    str
    """
    model = stored(model)
    fields = _fields(model, name, pictures)
    parts = "".join(_part(block, fields) for block in _blocks(model, pictures))
    body, _, limits = parts.rpartition("## Limits\n")
    sections = "".join(f"## {title}\n\n" + "\n".join([*lines, "", ""]) for title, lines in further)
    return f"{body}{sections}## Limits\n{limits}"


@cache
def _template() -> dict[str, str]:
    """Return the blocks of the template by their names."""
    text = (resources.files("cgid.identification.training") / "card.md").read_text(encoding="utf-8")
    return dict(block.split("\n", 1) for block in text.split("%% ")[1:])


def _part(block: str, fields: Record) -> str:
    return _template()[block].format_map(fields)


def _blocks(model: StoredModel, pictures: tuple[str, ...]) -> Iterator[str]:
    """Yield the blocks of the template that apply to a model, in order."""
    recorded, metrics = model.training.get("recorded"), model.training["metrics"]
    shown = {
        "of specimens": recorded is None,
        "by impact": False,
        "by window": False,
        f"by {model.subject}": recorded is not None,
        "of recordings": recorded is not None,
        "beams": model.same_beam,
        "failures": recorded is not None and recorded["failures"],
        "votes": recorded is not None,
        "few": model.is_of_few,
        "voted": "recordings" in metrics,
        "control": "control" in model.training,
        "sources": recorded is not None and recorded.get("levels_of_sources"),
        "pictures": pictures,
        "calibration of specimens": recorded is None,
        "no sets": recorded is None and not metrics["prediction_sets"],
        "sets": metrics["prediction_sets"],
        "calibration of recordings": recorded is not None,
        "correction": False,  # a section of its own
        "limits of specimens": recorded is None,
        "limits of vibrations": recorded is None and model.kind == "vibration",
        "limits of recordings": recorded is not None,
        "limits of noise": recorded is not None and "contrast.limit" in model.arrays,
    }
    return (block for block in _template() if shown.get(block, True))


def _fields(model: StoredModel, name: str, pictures: tuple[str, ...]) -> dict[str, Any]:
    """Return the values of the placeholders of the template."""
    training, labels = model.training, list(map(plain, model.labels))
    metrics = training["metrics"]
    drawn = [metrics["drawn"]] if "drawn" in metrics else []
    guards = zip(model.guards, model.guard_limits, strict=True)
    return {
        "name": plain(name),
        "model": model,
        "training": training,
        "metrics": metrics,
        "labels": ", ".join(labels),
        "beams": ", ".join(map(plain, model.same_beam)),
        "one": {"window": "a window of a recording", "impact": "one impact"}[model.subject],
        "rows": f"{model.subject}s",
        "shape": _SHAPES[model.kind],
        "rates": " to ".join(f"{rate / 1e3:g}" for rate in dict.fromkeys(model.sampling_rates)),
        "features": _features(model),
        "guards": ", ".join(f"{name} (edge {limit:.4g})" for name, limit in guards) or "none",
        "window": model.window_time * 1e3,
        "hop": model.hop_time * 1e3,
        "files": "files" if "recorded" in training else "scene",
        "sources": ", ".join(plain(source or "unknown") for source in training["sources"]),
        "seed": plain(training["seed"]),
        "versions": ", ".join(plain(f"{name} {version}") for name, version in training["versions"].items()),
        "recalls": "".join(f"| of impacts drawn at random | {drawn_text(one)} |\n" for one in drawn)
        + _rows((f"recall of {plain(one)}", f"{value:.4f}") for one, value in metrics["recall"].items()),
        "areas": _rows(
            (f"area under the ROC curve, {plain(one)}", f"{area:.4f}") for one, area in metrics["roc_area"].items()
        ),
        "confusion": _table(
            ("", *labels), ((label, *row) for label, row in zip(labels, metrics["confusion"], strict=True))
        ),
        "pictures": "\n".join(f"![{plain(picture)}]({quote(picture)})" for picture in pictures),
        "sets": _sets(model),
        "min_groups": MIN_GROUPS,
        "dead_time": VIBRATION_DEAD_TIME * 1e3,
        **(_fields_of_recordings(training["recorded"], metrics) if "recorded" in training else {}),
        **_fields_of_control(training),
    }


def _features(model: StoredModel) -> str:
    if len(model.features) <= _MAX_NAMES:
        own = " (name it in `cgid.measure.features.choose([...])` before you load the model)"
        return ", ".join(name + own * FEATURES.is_own(name) for name in model.features)
    selected = [plain(row["name"]) for row in model.training.get("recorded", {}).get("candidates", ()) if row["chosen"]]
    return f"{len(model.features)}: {', '.join(selected) or 'many'} (`cgid info` lists them)"


def _fields_of_recordings(recorded: Record, metrics: Record) -> dict[str, Any]:
    weights, recordings = recorded["class_weights"], metrics.get("recordings", {"rows": ()})
    if isinstance(weights, Mapping):
        weights = ", ".join(f"{plain(label)} {weight:g}" for label, weight in weights.items())
    else:
        weights = plain(weights or "all rows have equal weights")
    measured = [
        (f"one {recorded['by']}", metrics),
        *((f"running vote over {row['time']:g} s", row) for row in metrics.get("running", []) if row["n"]),
        *([("vote of a complete recording", recordings)] if recordings["rows"] else []),
    ]
    shares = (
        (name, f"{row['accuracy']:.4f}", _interval(row), row.get("n", metrics["n_impacts"])) for name, row in measured
    )
    votes = (
        (
            plain(row["name"]),
            plain(row["label"]),
            plain(row["vote"]) if row["vote"] == row["label"] else f"**{plain(row['vote'])}**",
            row["n"],
            f"{row['accuracy']:.4f}",
        )
        for row in recordings["rows"]
    )
    candidates = (
        (
            f"**{plain(row['name'])}**" if row["chosen"] else plain(row["name"]),
            plain(row["family"]),
            row["n_features"],
            f"{row['accuracy']:.4f}",
            row["taken_in_folds"],
        )
        for row in recorded["candidates"]
    )
    return {
        "recorded": recorded,
        "weights": weights,
        "failures": counted(len(recorded["failures"]), "recording"),
        "shares": _table(("decision on", "right", "95 % interval", "number"), shares),
        "votes": _table(("recording", "label", "vote", "rows", "right"), votes),
        "candidates": _table(("features", "family", "number", "accuracy", "taken in folds"), candidates),
    }


def _fields_of_control(training: Record) -> dict[str, str]:
    """Return the control, and the table of rocks and silence of each recording."""
    control = training.get("control", {})
    rows = [
        (name, f"{one['own']:.2f}", f"{one['same']:.2f}", f"{one['other']:.2f}", *(f"{x:.2f}" for x in one["path"]))
        for name, one in (("before it was mended", control.get("before", {})), ("this model", control))
        if "same" in one
    ]
    scale = untold_scale(training.get("level_range", {}))
    told = f"{followed(training)}. Expect {control.get('expected', 0.0):.1f} in others' machines."
    told *= bool(control.get("told"))
    sources = (
        (
            plain(one["name"]),
            plain(one["label"]),
            f"{one['rocks']:.0f}",
            "-" if one["silence"] is None else f"{one['silence']:.0f}",
        )
        for one in training.get("recorded", {}).get("levels_of_sources", ())
    )
    titles = ("right", "as recorded", "own label's silence added", "other's", "own label's recorder", "other's")
    return {
        "control_lines": "\n".join(filter(None, map(plain, [told, *control_notes(control), scale]))),
        "control": _table(titles, rows) if rows else "",
        "levels_of_sources": _table(("recording", "label", "rocks [dB]", "silence [dB]"), sources),
    }


def _sets(model: StoredModel) -> str:
    """Return the table of prediction sets."""
    rows = (
        (
            f"{row['coverage']:g}",
            f"{row['achieved']:.4f}",
            *(f"{row['achieved_of'][label]:.4f}" for label in model.labels),
            *(f"{row[name]:.4f}" for name in ("single", "several", "empty")),
            "-" if row["accuracy_of_single"] is None else f"{row['accuracy_of_single']:.4f}",
        )
        for row in model.training["metrics"]["prediction_sets"]
        if not row.get("class_conditional")  # of an earlier development version: for each label by itself
    )
    titles = ("coverage asked", "achieved", *(f"of {plain(label)}" for label in model.labels))
    return _table((*titles, "single label", "several", "empty", "accuracy of single"), rows)


def correction_section(correction: Record) -> Section:
    """Return the section of a model corrected by labelled impacts."""
    rows = (
        (
            name,
            f"{row['accuracy']:.4f}",
            _interval(row),
            ", ".join(f"{plain(label)} {value:.4f}" for label, value in row["recall"].items()),
        )
        for name, row in (("before", correction["before"]), ("corrected", correction))
    )
    fields = {
        "correction": correction,
        "counts": ", ".join(f"{plain(label)} {n}" for label, n in correction["labels"].items()),
        "biases": ", ".join(f"{bias:+.3f}" for bias in correction["bias"]),
        "compared": _table(("model", "accuracy on the site", "95 % interval", "recall"), rows),
    }
    return "Corrected for a site", _part("correction", fields).splitlines()


def _interval(row: Record) -> str:
    low, high = row["accuracy_interval_95"]
    return f"{low:.4f} to {high:.4f}"


# -- tables, also for `models/*.py` -----------------------------------------------------------------------


def plain(name: object) -> str:
    """Escape a name from a file so that Markdown shows it literally."""
    return _MARKS.sub(r"\\\g<0>", printable(str(name)))


def table(titles: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return _table(titles, rows).splitlines()


def _table(titles: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    head = _rows([titles]) if any(titles) else "|" + " |" * len(titles)
    return "\n".join(filter(None, [head, "|" + "---|" * len(titles), _rows(rows)]))


def _rows(rows: Iterable[Sequence[object]]) -> str:
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in rows)
