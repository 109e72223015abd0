"""The model card: what a model is, what it needs, how good it is and where that ends. Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote

from cgid.identification.card_tables import plain, table
from cgid.identification.detection import VIBRATION_DEAD_TIME
from cgid.identification.drop_height import KNOWN
from cgid.identification.model import Model
from cgid.identification.recorded.card import (
    adaptation_lines,
    choice_table,
    identity_of_recorded,
    judgement_of_recorded,
    limits_of_recorded,
)

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
