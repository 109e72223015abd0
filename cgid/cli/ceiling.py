"""The best possible accuracy on a scene: `cgid ceiling`."""

from __future__ import annotations

from typing import Any

import click

from cgid.cli.help import Command
from cgid.cli.options import SCENE, json_option, laws_option
from cgid.cli.output import print_json, progress_bar, say, warn
from cgid.terminal import counted

#: Number of training signals of the learner for scenes without a limit.
_TRAINING = 10_000


@click.command(
    cls=Command, short_help="Compute the best possible accuracy on a scene.", example="cgid ceiling reference -n 2000"
)
@click.argument("scene", type=SCENE)
@click.option(
    "-n", "--signals", "n_signals", type=int, default=20_000, show_default=True, help="Use this many signals."
)
@click.option(
    "--seed", type=int, default=1_000_003, show_default=True, help="Choose the random numbers of these signals."
)
@click.option("--drop-height", is_flag=True, help="Use the drop height of each rock as an input.")
@click.option(
    "--learner",
    "n_training",
    type=int,
    help=f"Train a learner on this many signals, too; {_TRAINING} for scenes without a limit.",
)
@laws_option
@json_option
def ceiling(scene: str, n_signals: int, seed: int, drop_height: bool, n_training: int | None, as_json: bool) -> None:
    """Compute the best possible accuracy on SCENE (a .toml file or the name of a shipped one).

    Bayes' rule with the scene as prior is applied to many signals: no classifier can be more accurate. If its
    integration does not cover the scene (other laws of loss, filters, coloured noise, [randomise]), a learner on
    measured signals bounds the limit from below. Acceleration needs the study: python -m studies.ceilings.
    """
    from cgid.ceiling import ceiling as limit_of
    from cgid.ceiling import check_training, require_supported, uncovered, untrusted
    from cgid.ceiling import learner as learner_of
    from cgid.scene import load_scene

    loaded = load_scene(scene)
    require_supported(loaded)
    if loaded.sensor.quantity != "force":
        raise click.UsageError(
            f"{loaded.name}: SCENE must measure force, it measures {loaded.sensor.quantity}; in a checkout of cgid "
            f"python -m studies.ceilings {scene} estimates its limit"
        )
    rule = uncovered(loaded)
    if rule and n_training is None:
        n_training = _TRAINING
    if n_training is not None:
        check_training(n_training)
    if not rule and (problem := untrusted(loaded)):
        warn(f"do not rely on this limit: {problem}")
    content: dict[str, Any] = {"scene": loaded.name, "n_signals": n_signals, "drop_height_known": drop_height}
    content["kind"] = "below" if rule else "limit"
    total = (0 if rule else n_signals) + (0 if n_training is None else n_signals + n_training)
    with progress_bar(total, "signals", "estimating") as progress:
        if rule:
            content["uncovered"] = rule
        else:
            limit = limit_of(loaded, n_signals, seed, drop_height_known=drop_height, progress=progress)
            content |= {
                "accuracy": limit.accuracy,
                "accuracy_error": limit.accuracy_error,
                "right_answers": float(limit.hits.mean()),
                "brier_score": limit.brier_score,
                "brier_error": limit.brier_error,
                "roc_area": {label: limit.roc_area(label) for label in limit.labels},
            }
        if n_training is not None:
            learner = learner_of(loaded, n_training, n_signals, seed, drop_height_known=drop_height, progress=progress)
            content["learner"] = {
                "n_training": n_training, "accuracy": learner.accuracy, "accuracy_error": learner.accuracy_error
            }  # fmt: skip
    if as_json:
        print_json(content)
    else:
        _report(content)


def _report(content: dict[str, Any]) -> None:
    known = "known" if content["drop_height_known"] else "not known"
    say(f"{content['scene']}: {counted(content['n_signals'], 'signal')}, drop height {known}")
    if content["kind"] == "limit":
        say(f"highest accuracy possible {content['accuracy']:.4f} +- {content['accuracy_error']:.4f}")
        say(f"right answers of Bayes' rule {content['right_answers']:.4f}")
        say(f"Brier score {content['brier_score']:.4f} +- {content['brier_error']:.4f}")
        say("area under ROC " + ", ".join(f"{label} {area:.4f}" for label, area in content["roc_area"].items()))
    if learner := content.get("learner"):
        head = "learner" if content["kind"] == "limit" else "highest accuracy possible at least"
        trained = counted(learner["n_training"], "signal")
        say(f"{head} {learner['accuracy']:.4f} +- {learner['accuracy_error']:.4f}, trained on {trained}")
    if content["kind"] == "below":
        say(f"not integrated: that needs {content['uncovered']}")
