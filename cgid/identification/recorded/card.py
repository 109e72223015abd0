"""What a model card says of a model that was trained on recordings: how it was judged, chosen, and where that ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cgid.identification.card_tables import plain, table
from cgid.identification.model import Model


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
