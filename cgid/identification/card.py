"""Write models with their cards: the needs, the quality and the limits of a model, in Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from cgid.errors import CannotCreate
from cgid.files import check_new, write_together
from cgid.identification.detection import VIBRATION_DEAD_TIME
from cgid.identification.model import MIN_GROUPS, Model
from cgid.signals import KNOWN
from cgid.terminal import counted, printable

if TYPE_CHECKING:
    from cgid.identification.training import Training

__all__ = ["write_card"]

Record = Mapping[str, Any]
#: Title and lines of a section.
Section = tuple[str, list[str]]
#: The pictures that belong to a model.
PICTURES = ("confusion", "reliability", "roc")
#: Maximum number of features that a card lists.
_MAX_NAMES = 60
_SHAPES = {"pulse": "positive pulses", "vibration": "vibrations of both signs", "window": "recordings in windows"}
_FEW = f"With fewer than {MIN_GROUPS} groups of a label the next day may be much worse than the intervals say."
#: Characters that Markdown or HTML interprets within a line; an underscore only at the edge of a word.
_MARKS = re.compile(r"[\\`*\[\]<>&|~]|\b_|_\b|(?<=_)_|_(?=_)")


# -- files ------------------------------------------------------------------------------------------------


def check_model_output(path: Path, *, plots: bool = False, overwrite: bool = False) -> Path:
    """Return the path if a model may be written there; call this before any work."""
    if path.suffix != ".npz":
        raise CannotCreate(f"{path}: the name of a model must end in .npz, got {path.suffix or 'no ending'!r}")
    pictures = [f"{path.stem}-{name}.png" for name in PICTURES] if plots else []
    for name in (path.name, f"{path.stem}.md", *pictures):
        check_new(path.with_name(name), "a file beside a model", (Path(name).suffix,), overwrite=overwrite)
    if plots:
        from cgid.plots.figure import require_matplotlib

        require_matplotlib()
    return path


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
        path.name: training.model.to_bytes(),
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
    lines = [f"# Model card: {plain(name)}", ""]
    if model.training["labels_shuffled"]:
        lines += ["**Trained on shuffled labels: a check of the method, of no other use.**", ""]
    of = "a window of a recording" if model.kind == "window" else "one impact"
    lines += [f"Identifies {', '.join(map(plain, model.labels))} from the {model.quantity} of {of}.", ""]
    lines += [*table(("", ""), _identity(model)), ""]
    for title, body in _sections(model, pictures, further):
        lines += [f"## {title}", "", *body, ""]
    return "\n".join(lines)


def _sections(model: Model, pictures: tuple[str, ...], further: Sequence[Section]) -> Iterator[Section]:
    training = model.training
    recorded = training.get("recorded")
    judgement = _judgement(model) + ([] if recorded is None else ["", *_votes(model)])
    if pictures:
        judgement += ["", *(f"![{plain(picture)}]({quote(picture)})" for picture in pictures)]
    yield f"On {'windows' if model.kind == 'window' else 'impacts'} it has not seen", judgement
    yield "Calibration and reject option", _calibration(model)
    if recorded is not None:
        yield "Selection", _choice(recorded["candidates"])
        if "synthetic" in recorded:
            yield "Adaptation", _adaptation(recorded["synthetic"], training["metrics"]["accuracy"])
    yield from further
    yield "Limits", _limits(model) if recorded is None else _limits_of_recordings(model)


def _identity(model: Model) -> list[tuple[str, str]]:
    training = model.training
    recorded = training.get("recorded")
    rates = " to ".join(f"{rate / 1e3:g}" for rate in dict.fromkeys(model.sampling_rates))
    guards = zip(model.guards, model.guard_limits, strict=True)
    return [
        ("family", f"{model.family}, probabilities calibrated by temperature {model.temperature:.4g}"),
        ("expects", f"{model.quantity} [{model.unit}], {_SHAPES[model.kind]}, trained at {rates} kHz"),
        ("must be known, too", ", ".join(f"{name} [{KNOWN[name]}]" for name in model.known) or "nothing"),
        ("features", _features(model)),
        ("novelty only", ", ".join(f"{name} (edge {limit:.4g})" for name, limit in guards) or "none"),
        *(_of_specimens(training) if recorded is None else _of_recordings(model, recorded)),
        (
            "left out",
            f"{training['n_left_out']} {'windows' if model.kind == 'window' else 'impacts'} that could not be measured",
        ),
        (
            f"data (SHA-256 of the {'scene' if recorded is None else 'files'})",
            ", ".join(plain(source or "unknown") for source in training["sources"]),
        ),
        ("seed", plain(training["seed"])),
        ("versions", ", ".join(plain(f"{name} {version}") for name, version in training["versions"].items())),
    ]


def _features(model: Model) -> str:
    if len(model.features) <= _MAX_NAMES:
        return ", ".join(model.features)
    selected = [plain(row["name"]) for row in model.training.get("recorded", {}).get("candidates", ()) if row["chosen"]]
    return f"{len(model.features)}: {', '.join(selected) or 'many'} (`cgid info` lists them)"


def _of_specimens(training: Record) -> list[tuple[str, str]]:
    judged = training["metrics"]["n_impacts"]
    return [
        ("trained on", f"{training['n_train']} impacts of {training['n_train_specimens']} specimens"),
        ("calibrated on", f"one impact of each of {training['n_calibration_specimens']} other specimens"),
        ("judged on", f"{judged} impacts of {training['n_test_specimens']} other specimens"),
    ]


def _of_recordings(model: Model, recorded: Record) -> list[tuple[str, str]]:
    weights = recorded["class_weights"]
    if isinstance(weights, Mapping):
        weights = ", ".join(f"{plain(label)} {weight:g}" for label, weight in weights.items())
    else:
        weights = plain(weights or "all rows count the same")
    by = "single impacts, where the detector finds them"
    if model.kind == "window":
        by = (
            f"windows of {model.window_time * 1e3:g} ms, a new one every {model.hop_time * 1e3:g} ms; in a vote, "
            f"they repeat each other with a correlation of {model.vote_correlation:.2f}"
        )
    rows = f"{model.training['n_train']} {recorded['by']}s"
    lines = [
        ("decides on", by),
        ("channels together", str(model.n_channels)),
        (
            "trained on",
            f"{rows} of {recorded['n_recordings']} recordings or intervals in {recorded['n_groups']} groups",
        ),
        ("judged on", "the same, each group by what was chosen and trained on the others"),
        ("class weights", weights),
    ]
    if model.sensors:
        lines.append(("reference spectra of sensors", ", ".join(map(plain, model.sensors))))
    if recorded["failures"]:
        lines.append(("could not be read", counted(len(recorded["failures"]), "recording")))
    return lines


def _judgement(model: Model) -> list[str]:
    metrics = model.training["metrics"]
    low, high = metrics["accuracy_interval_95"]
    rows = [
        ("accuracy", f"{metrics['accuracy']:.4f} (95 % interval {low:.4f} to {high:.4f})"),
        *((f"recall of {plain(label)}", f"{value:.4f}") for label, value in metrics["recall"].items()),
        ("Brier score (sum over the labels)", f"{metrics['brier_score']:.4f}"),
        ("log loss", f"{metrics['log_loss']:.4f}"),
        *((f"area under the ROC curve, {plain(label)}", f"{area:.4f}") for label, area in metrics["roc_area"].items()),
    ]
    labels = list(map(plain, model.labels))
    return [
        *table(("", ""), rows),
        "",
        "Confusion (rows: truth, columns: answer):",
        "",
        *table(("", *labels), [(label, *row) for label, row in zip(labels, metrics["confusion"], strict=True)]),
    ]


def _votes(model: Model) -> list[str]:
    """Return the accuracy of rows, running votes and whole recordings."""
    training = model.training
    metrics = training["metrics"]
    recordings = metrics.get("recordings")
    judged = [
        (f"one {training['recorded']['by']}", metrics),
        *((f"running vote over {row['time']:g} s", row) for row in metrics.get("running", []) if row["n"]),
        *([] if recordings is None else [("vote of a whole recording", recordings)]),
    ]
    shares = []
    for name, row in judged:
        low, high = row["accuracy_interval_95"]
        number = row.get("n", metrics["n_impacts"])
        shares.append((name, f"{row['accuracy']:.4f}", f"{low:.4f} to {high:.4f}", number))
    votes = [
        (
            plain(row["name"]),
            plain(row["label"]),
            plain(row["vote"]) if row["vote"] == row["label"] else f"**{plain(row['vote'])}**",
            row["n"],
            f"{row['accuracy']:.4f}",
        )
        for row in ([] if recordings is None else recordings["rows"])
    ]
    return [
        *table(("decision on", "right", "95 % interval", "number"), shares),
        "",
        "Votes add logarithms of probabilities, as of fewer windows that do not repeat each other. The intervals count "
        "groups, not what lies in them, and hold for recordings like these: of their support, sensor, bodies and days.",
        *(["", _FEW] if model.is_of_few else []),
        *(["", *table(("recording", "label", "vote", "rows", "right"), votes)] if votes else []),
    ]


def _calibration(model: Model) -> list[str]:
    metrics = model.training["metrics"]
    error, chance = metrics["expected_calibration_error"], metrics["calibration_error_by_chance"]
    if "recorded" in model.training:
        # Rows of one recording err together, so chance alone gives a larger calibration error.
        return [
            f"The expected calibration error is {error:.4f}; were all rows independent, perfectly calibrated "
            f"probabilities would show {chance:.4f} by chance, but those of one recording err together, so it is more.",
            "",
            "Recordings are too few to calibrate prediction sets: `--coverage` can promise nothing.",
        ]
    lines = [
        f"The expected calibration error is {error:.4f}; perfectly calibrated probabilities would show {chance:.4f} "
        "by chance.",
        "",
    ]
    if not metrics["prediction_sets"]:
        return [*lines, "There were too few specimens to calibrate prediction sets: nothing can be rejected."]
    rows = [
        (
            f"{row['coverage']:g}",
            "each label" if row["class_conditional"] else "the mix",
            f"{row['achieved']:.4f}",
            *(f"{row['achieved_of'][label]:.4f}" for label in model.labels),
            *(f"{row[name]:.4f}" for name in ("single", "several", "empty")),
            "-" if row["accuracy_of_single"] is None else f"{row['accuracy_of_single']:.4f}",
        )
        for row in metrics["prediction_sets"]
    ]
    titles = ("coverage asked", "of", "achieved", *(f"of {plain(label)}" for label in model.labels))
    return [
        *lines,
        "Prediction sets (split conformal) hold the truth as often as asked, over the mix of the training or for each",
        "label by itself. With `--coverage` an impact whose set is not a single label is answered with *unknown*:",
        "",
        *table((*titles, "single label", "several", "empty", "accuracy of single"), rows),
    ]


def correction_section(correction: Record) -> Section:
    """Return the section of a model that labelled impacts of a site corrected."""
    rows = []
    for name, row in (("before", correction["before"]), ("corrected", correction)):
        low, high = row["accuracy_interval_95"]
        recalls = [f"{plain(label)} {value:.4f}" for label, value in row["recall"].items()]
        rows.append((name, f"{row['accuracy']:.4f}", f"{low:.4f} to {high:.4f}", ", ".join(recalls)))
    counts = ", ".join(f"{plain(label)} {n}" for label, n in correction["labels"].items())
    biases = ", ".join(f"{bias:+.3f}" for bias in correction["bias"])
    return "Corrected for a site", [
        f"{correction['n']} labelled impacts ({counts}) moved its biases by {biases}, its slope to "
        f"{correction['slope']:.3f} and the gain to {correction['gain']:.3f}. Each impact is judged by a correction "
        f"that the others teach; {correction['n_unknown']} more lie outside of the training. The other figures of "
        "this card are those of the training, before.",
        "",
        *table(("model", "accuracy on the site", "95 % interval", "recall"), rows),
    ]


def _choice(candidates: Sequence[Record]) -> list[str]:
    rows = [
        (_selected_text(row), plain(row["family"]), row["n_features"], f"{row['accuracy']:.4f}", row["taken_in_folds"])
        for row in candidates
    ]
    return [
        *table(("features", "family", "number", "accuracy", "taken in folds"), rows),
        "",
        "These accuracies chose, so they flatter; what is above was judged by groups that had no part in the choice.",
    ]


def _adaptation(synthetic: Record, accuracy: float) -> list[str]:
    moved = [(plain(name), f"{by:+.1f}") for name, by in synthetic["moved_db"].items()]
    return [
        f"{synthetic['n']} synthetic impacts teach beside the recorded ones and judge nothing. Their levels were "
        "moved, band by band, onto those of the recordings, by the mean over the labels that both have; when groups "
        f"judge, by what trains alone. With them {accuracy:.4f} of the recorded impacts are answered right, without "
        f"them {synthetic['accuracy_without']:.4f}.",
        "",
        *table(("feature", "moved by [dB]"), moved),
    ]


def _limits(model: Model) -> list[str]:
    lines = [
        "It knows the impacts of its training data and no others. An impact whose novelty passes 1 (the distance",
        "that 99.9 % of the training impacts keep) is answered with *unknown*; at another sampling rate it is less",
        "often right than it says. Coverage is promised for impacts like those of the training, not for strangers.",
        "The interval counts specimens, not impacts.",
        "Data that was synthesised says how good the method can be, not how good it is in a mine.",
    ]
    if model.kind == "vibration":
        lines += [
            "",
            "The levels are those of one beam, its sensor where it is and as sensitive as it is: on another beam, at "
            "another",
            "place or with another gain the model must be trained again. Where two impacts follow each other within "
            f"{VIBRATION_DEAD_TIME * 1e3:g} ms",
            "the second is taken for a part of the first.",
        ]
    return lines


def _limits_of_recordings(model: Model) -> list[str]:
    lines = [
        "It knows the support, the sensors and the bodies of its recordings and no others. What has a novelty above 1",
        "is answered with *unknown*: farther out than 99.9 % of what lies in groups left out. At another sampling rate",
        "it is less often right than it says.",
    ]
    if "contrast.limit" in model.arrays:
        lines.append("A window with more noise than the clear ones of the training have is *unknown*, too.")
    selected = next(row["name"] for row in model.training["recorded"]["candidates"] if row["chosen"])
    if not selected.endswith("level-free"):
        lines.append(
            "It looks at levels: with another gain it is less often right (`cgid train --level-free` does without)."
        )
    return lines


# -- tables, also for `models/*.py` -----------------------------------------------------------------------


def plain(name: object) -> str:
    """Escape a name from a file so that Markdown shows it literally."""
    return _MARKS.sub(r"\\\g<0>", printable(str(name)))


def table(titles: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [
        f"| {' | '.join(titles)} |" if any(titles) else "|" + " |" * len(titles),
        "|" + "---|" * len(titles),
        *(f"| {' | '.join(map(str, row))} |" for row in rows),
    ]


def _selected_text(row: Record) -> str:
    return f"**{plain(row['name'])}**" if row["chosen"] else plain(row["name"])
