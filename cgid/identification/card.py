"""Tables and names of a model card, as Markdown.

What a model card says of a model that was trained on recordings: how it was judged, chosen, and where that ends.

The model card: what a model is, what it needs, how good it is and where that ends. Markdown.

A trained model on disk: the model file, its card, its pictures.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from cgid.errors import CannotCreate
from cgid.files import check_new, write_together
from cgid.identification.detection import VIBRATION_DEAD_TIME
from cgid.identification.drop_height import KNOWN
from cgid.identification.model import Model
from cgid.identification.training import Training
from cgid.terminal import printable

#: Signs that Markdown, or the HTML in it, makes something of within a line; an underscore only beside a word.
_MARKS = re.compile(r"[\\`*\[\]<>&|~]|\b_|_\b|(?<=_)_|_(?=_)")


def plain(name: object) -> str:
    r"""Return a name out of a file as Markdown that shows it as it is.

    Examples
    --------
    >>> print(plain("<b>a|b"), plain("_coal_wet_"))
    \<b\>a\|b \_coal_wet\_
    """
    return _MARKS.sub(r"\\\g<0>", printable(str(name)))


def table(titles: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [
        f"| {' | '.join(titles)} |" if any(titles) else "|" + " |" * len(titles),
        "|" + "---|" * len(titles),
        *(f"| {' | '.join(map(str, row))} |" for row in rows),
    ]


def identity_of_recorded(model: Model) -> list[tuple[str, str]]:
    """Return what the first table of the card says of the data."""
    training = model.training
    recorded = training["recorded"]
    rows = [
        ("decides on", _decides_on(model)),
        ("channels together", str(model.n_channels)),
        (
            "trained on",
            f"{training['n_train']} {recorded['by']}s of {recorded['n_recordings']} recordings in "
            f"{recorded['n_groups']} groups",
        ),
        ("judged on", "the same, each group by what was chosen and trained on the others"),
        ("class weights", _weights(recorded["class_weights"])),
    ]
    if model.sensors:
        rows.append(("reference spectra of sensors", ", ".join(map(plain, model.sensors))))
    if recorded["failures"]:
        rows.append(("could not be read", f"{len(recorded['failures'])} recordings"))
    return rows


def judgement_of_recorded(model: Model) -> list[str]:
    """Return how whole recordings and running votes did, as Markdown."""
    recordings = model.training["metrics"]["recordings"]
    judged = [
        (plain(row["name"]), plain(row["label"]), _vote(row), row["n"], f"{row['accuracy']:.4f}")
        for row in recordings["rows"]
    ]
    rows = [(f"one {model.training['recorded']['by']}", *_share(model.training["metrics"]))]
    rows += [
        (f"running vote over {row['time']:g} s", *_share(row))
        for row in model.training["metrics"].get("running", [])
        if row["n"]
    ]
    rows.append(("vote of a whole recording", *_share(recordings)))
    return [
        *table(("decision on", "right", "95 % interval", "number"), rows),
        "",
        "Votes are means of logarithms of probabilities. The intervals count groups, not what lies in them.",
        "",
        *table(
            ("recording", "label", "vote", "rows", "right"),
            judged,
        ),
        "",
    ]


def adaptation_lines(row: Mapping[str, Any], accuracy: float) -> list[str]:
    """Return what became of synthetic impacts, as Markdown: a dict of n, moved_db and accuracy_without."""
    return [
        f"{row['n']} synthetic impacts teach beside the recorded ones and judge nothing. Their levels were moved, band "
        "by band, onto those of the recordings, by the mean over the labels that both have; when groups judge, by what "
        f"trains alone. With them {accuracy:.4f} of the recorded impacts are answered right, without them "
        f"{row['accuracy_without']:.4f}.",
        "",
        *table(("feature", "moved by [dB]"), [(plain(name), f"{by:+.1f}") for name, by in row["moved_db"].items()]),
        "",
    ]


def choice_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the candidates as Markdown."""
    return [
        *table(
            ("features", "family", "number", "accuracy", "taken in folds"),
            [
                (
                    f"**{plain(row['name'])}**" if row["chosen"] else plain(row["name"]),
                    plain(row["family"]),
                    row["n_features"],
                    f"{row['accuracy']:.4f}",
                    row["taken_in_folds"],
                )
                for row in rows
            ],
        ),
        "",
        "These accuracies chose, so they flatter; what is above was judged by groups that had no part in the choice.",
        "",
    ]


def limits_of_recorded(model: Model) -> tuple[str, ...]:
    """Return where such a model ends."""
    lines = [
        "## Limits",
        "",
        "It knows the support, the sensors and the bodies of its recordings and no others. What has a novelty above 1",
        "is answered with *unknown*: farther out than 99.9 % of what lies in groups left out. At another sampling rate",
        "it is less often right than it says.",
    ]
    chosen = next(row["name"] for row in model.training["recorded"]["candidates"] if row["chosen"])
    if not chosen.endswith("level-free"):
        lines += [
            "It looks at levels: with another gain it is less often right (`cgid train --level-free` does without).",
        ]
    return (*lines, "")


def _decides_on(model: Model) -> str:
    if model.kind != "window":
        return "single impacts, where the detector finds them"
    return f"windows of {model.window_time * 1e3:g} ms, a new one every {model.hop_time * 1e3:g} ms"


def _weights(weights: Any) -> str:
    if not isinstance(weights, Mapping):
        return plain(weights or "all rows count the same")
    return ", ".join(f"{plain(label)} {weight:g}" for label, weight in weights.items())


def _share(row: Mapping[str, Any]) -> tuple[str, str, int]:
    low, high = row["accuracy_interval_95"]
    return f"{row['accuracy']:.4f}", f"{low:.4f} to {high:.4f}", row.get("n", row.get("n_impacts", 0))


def _vote(row: Mapping[str, Any]) -> str:
    vote = plain(row["vote"])
    return vote if row["vote"] == row["label"] else f"**{vote}**"


Rows = Sequence[Mapping[str, Any]]
#: More features than this are not listed.
_MOST_NAMES = 60
_SHAPES = {"pulse": "positive pulses", "vibration": "vibrations of both signs", "window": "recordings in windows"}


def write_card(model: Model, name: str, pictures: tuple[str, ...] = ()) -> str:
    """Return the card of a model.

    Parameters
    ----------
    model : Model
    name : str
        Of the model file.
    pictures : tuple of str
        File names, relative to the card.
    """
    training = model.training
    lines = [f"# Model card: {plain(name)}", ""]
    if training["labels_shuffled"]:
        lines += ["**Trained on shuffled labels: a check of the method, of no other use.**", ""]
    of = "a window of a recording" if model.kind == "window" else "one impact"
    lines += [f"Identifies {', '.join(map(plain, model.labels))} from the {model.quantity} of {of}.", ""]
    lines += table(("", ""), _identity(model))
    lines += [
        "",
        "## On impacts it has not seen" if model.kind != "window" else "## On windows it has not seen",
        "",
        *_judgement(model),
    ]
    if "recorded" in training:
        lines += judgement_of_recorded(model)
    lines += [f"![{plain(picture)}]({quote(picture)})" for picture in pictures] + [""] * bool(pictures)
    lines += ["## Calibration and reject option", "", *_calibration(model)]
    if "domain_shift" in training:
        lines += ["## Domain shift", "", *domain_shift_table(training["domain_shift"]), ""]
    if "beside_force" in training:
        lines += ["## What is lost against the force", "", *force_table(training["beside_force"]), ""]
    if "recorded" in training:
        lines += ["## Choice", "", *choice_table(training["recorded"]["candidates"])]
        if "synthetic" in training["recorded"]:
            accuracy = training["metrics"]["accuracy"]
            lines += ["## Adaptation", "", *adaptation_lines(training["recorded"]["synthetic"], accuracy)]
    if "selection" in training:
        lines += ["## Selection", "", *selection_table(training["selection"]), ""]
        chosen = [row["name"] for row in training["selection"] if row["chosen"]]
        if model.family not in chosen:
            lines += [
                f"Bold is the choice of this comparison; the family of this model, {model.family}, was asked for.",
                "",
            ]
    if "recorded" in training:
        return "\n".join([*lines, *limits_of_recorded(model)])
    limits = _LIMITS_OF_VIBRATIONS if model.kind == "vibration" else ()
    return "\n".join([*lines, *_LIMITS, *limits])


def domain_shift_table(rows: Rows) -> list[str]:
    """Return how a model does elsewhere as Markdown: dicts of name, n, accuracy (None: strangers) and flagged_share."""
    return table(
        ("impacts of", "number", "accuracy", "flagged as strange"),
        [
            (
                plain(row["name"]),
                row["n"],
                "-" if row["accuracy"] is None else f"{row['accuracy']:.4f}",
                f"{row['flagged_share']:.2%}",
            )
            for row in rows
        ],
    )


def selection_table(rows: Rows) -> list[str]:
    """Return what `cgid.identification.selection.select` found as Markdown."""
    titles = ("family", "exportable", "accuracy", "difference", "Brier", "calibration error", "trained on")
    return table(
        (*titles, "fit [s]", "one impact [us]", "size [kB]"),
        [
            (
                f"**{plain(row['name'])}**" if row["chosen"] else plain(row["name"]),
                "yes" if row["exportable"] else "no",
                f"{row['accuracy']:.4f}",
                f"{row['difference']:+.4f} ± {row['standard_error']:.4f}",
                f"{row['brier_score']:.4f}",
                f"{row['expected_calibration_error']:.4f}",
                row["n_train"],
                f"{row['fit_s']:.1f}",
                f"{row['predict_us']:.0f}",
                f"{row['size_bytes'] / 1e3:.1f}",
            )
            for row in rows
        ],
    )


def force_table(row: Mapping[str, Any]) -> list[str]:
    """Return what a model and one of the contact force make of the same impacts as Markdown.

    A dict of name (of the other), n, accuracy, force_accuracy, difference and standard_error, and maybe of learner: a
    dict of name, n, accuracy, low and high of the best that could be learned.
    """
    rows = [
        ("this model, on the vibration", row["n"], f"{row['accuracy']:.4f}"),
        (plain(row["name"]), row["n"], f"{row['force_accuracy']:.4f}"),
    ]
    lost = f"{row['difference']:.4f} ± {row['standard_error']:.4f} of the accuracy"
    told = [*table(("the same impacts", "number", "accuracy"), rows), "", f"The way through the beam costs {lost}."]
    if "learner" not in row:
        return told
    learner = row["learner"]
    return [
        *told,
        "",
        "Nobody integrates the likelihood of a vibration here: a learner holds the ceiling from below. "
        f"{plain(learner['name'])} is right in {learner['accuracy']:.4f} (95 % interval {learner['low']:.4f} to "
        f"{learner['high']:.4f}) of the {learner['n']} impacts that judge. From above the ceiling of the force "
        "holds it, for the force has all that the vibration has. It lies between the two.",
    ]


def _identity(model: Model) -> list[tuple[str, str]]:
    training = model.training
    rates = " to ".join(f"{rate / 1e3:g}" for rate in dict.fromkeys(model.sampling_rates))
    guards = zip(model.guards, model.guard_limits, strict=True)
    return [
        ("family", f"{model.family}, probabilities calibrated by temperature {model.temperature:.4g}"),
        ("expects", f"{model.quantity} [{model.unit}], {_SHAPES[model.kind]}, trained at {rates} kHz"),
        ("must be known, too", ", ".join(f"{name} [{KNOWN[name]}]" for name in model.known) or "nothing"),
        ("features", _features(model)),
        ("novelty only", ", ".join(f"{name} (edge {limit:.4g})" for name, limit in guards) or "none"),
        *(identity_of_recorded(model) if "recorded" in training else _specimens(training)),
        (
            "left out",
            f"{training['n_left_out']} {'windows' if model.kind == 'window' else 'impacts'} that could not be measured",
        ),
        (
            f"data (SHA-256 of the {'files' if 'recorded' in training else 'scene'})",
            ", ".join(plain(source or "unknown") for source in training["sources"]),
        ),
        ("seed", plain(training["seed"])),
        ("versions", ", ".join(plain(f"{name} {version}") for name, version in training["versions"].items())),
    ]


def _features(model: Model) -> str:
    if len(model.features) <= _MOST_NAMES:
        return ", ".join(model.features)
    chosen = [plain(row["name"]) for row in model.training.get("recorded", {}).get("candidates", ()) if row["chosen"]]
    return f"{len(model.features)}: {', '.join(chosen) or 'many'} (`cgid info` lists them)"


def _specimens(training: Mapping[str, Any]) -> list[tuple[str, str]]:
    judged = training["metrics"]["n_impacts"]
    return [
        ("trained on", f"{training['n_train']} impacts of {training['n_train_specimens']} specimens"),
        ("calibrated on", f"one impact of each of {training['n_calibration_specimens']} other specimens"),
        ("judged on", f"{judged} impacts of {training['n_test_specimens']} other specimens"),
    ]


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
        "",
    ]


def _calibration(model: Model) -> list[str]:
    metrics = model.training["metrics"]
    error, chance = metrics["expected_calibration_error"], metrics["calibration_error_by_chance"]
    lines = [
        f"The expected calibration error is {error:.4f}; perfectly calibrated probabilities would show {chance:.4f} "
        "by chance.",
        "",
    ]
    if "recorded" in model.training:
        # Rows of one recording err together: their errors by chance are larger, nobody knows by how much.
        return [
            f"The expected calibration error is {error:.4f}; were all rows independent, perfectly calibrated "
            f"probabilities would show {chance:.4f} by chance, but those of one recording err together, so it is more.",
            "",
            "Recordings are too few to calibrate prediction sets: `--coverage` can promise nothing.",
            "",
        ]
    if not metrics["prediction_sets"]:
        return [*lines, "There were too few specimens to calibrate prediction sets: nothing can be rejected.", ""]
    rows = [
        (
            f"{row['coverage']:g}",
            "each label" if row["class_conditional"] else "the mix",
            f"{row['achieved']:.4f}",
            *(f"{row['achieved_of'][label]:.4f}" for label in model.labels),
            f"{row['single']:.4f}",
            f"{row['several']:.4f}",
            f"{row['empty']:.4f}",
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
        "",
    ]


_LIMITS = (
    "## Limits",
    "",
    "It knows the impacts of its training data and no others. An impact whose novelty passes 1 (the distance",
    "that 99.9 % of the training impacts keep) is answered with *unknown*; at another sampling rate it is less",
    "often right than it says. Coverage is promised for impacts like those of the training, not for strangers.",
    "The interval counts specimens, not impacts.",
    "Data that was synthesised says how good the method can be, not how good it is in a mine.",
    "",
)

_LIMITS_OF_VIBRATIONS = (
    "The levels are those of one beam, its sensor where it is and as sensitive as it is: on another beam, at another",
    "place or with another gain the model must be trained again. Where two impacts follow each other within "
    f"{VIBRATION_DEAD_TIME * 1e3:g} ms",
    "the second is taken for a part of the first.",
    "",
)


#: The pictures that go beside a model.
PICTURES = ("confusion", "reliability", "roc")


def check_model_output(path: Path, *, plots: bool = False, overwrite: bool = False) -> Path:
    """Return the path if a model may be written there, before any work is done.

    Raises
    ------
    CannotCreate
        The name does not end in .npz, the folder is missing, or there is a model already.
    MissingExtra
        Pictures are asked for and matplotlib is not installed.
    """
    if path.suffix != ".npz":
        raise CannotCreate(f"{path}: the name of a model must end in .npz, got {path.suffix or 'no ending'!r}")
    pictures = [f"{path.stem}-{name}.png" for name in PICTURES] if plots else []
    for name in (path.name, f"{path.stem}.md", *pictures):
        check_new(path.with_name(name), "a file beside a model", (Path(name).suffix,), overwrite=overwrite)
    if plots:
        from cgid.plots import require_matplotlib

        require_matplotlib()
    return path


def write_model(training: Training, path: Path, *, plots: bool = False, overwrite: bool = True) -> list[Path]:
    """Write pictures, card and the model, all or nothing; return the files written.

    Raises
    ------
    CannotCreate
        The folder is not writable, or a name was taken meanwhile and is not to be overwritten.
    WriteFailed
        The disk is full or broken; an old model and its card are there as before.
    """
    pictures: dict[str, bytes] = {}
    if plots:
        from cgid.plots import judgement_pictures

        labels, probabilities = training.test_labels, training.test_probabilities
        drawn = judgement_pictures(labels, probabilities, training.model.labels, training.metrics)
        pictures = {f"{path.stem}-{name}.png": picture for name, picture in drawn.items()}
    contents = {
        **pictures,
        f"{path.stem}.md": write_card(training.model, path.name, tuple(pictures)).encode(),
        path.name: training.model.to_bytes(),
    }
    files = {path.with_name(name): content for name, content in contents.items()}
    write_together(files, overwrite=overwrite)
    return list(files)
