"""`cgid ceiling`: the highest possible accuracy in a scene, and the gain from a better rig."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cgid.cli.options import PATH, print_json, progress_bar
from cgid.cli.output import say

#: Signals at each point of the survey.
_SURVEYED = 2000
_NAMES = {"snr": "SNR [dB]", "sampling_rate": "rate [Hz]", "size_spread": "sizes [1]", "present": "as it is"}


@click.command(short_help="Say how well anybody could tell a scene's labels apart.")
@click.argument("scene", type=PATH)
@click.option("-n", "--signals", "n_signals", type=int, default=20_000, show_default=True, help="To judge on.")
@click.option("--seed", type=int, default=1_000_003, show_default=True, help="Of these signals.")
@click.option("--drop-height", is_flag=True, help="It is known how far each rock fell.")
@click.option("--learner", type=int, help="Also the accuracy of learners, trained on up to this many signals.")
@click.option(
    "--plot", "picture", type=PATH, help="Survey noise, sampling rate and spread of sizes: a PNG picture and a table."
)
@click.option("--overwrite", is_flag=True, help="Replace an old picture.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object.")
def ceiling(
    scene: str,
    n_signals: int,
    seed: int,
    drop_height: bool,
    learner: int | None,
    picture: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Say how well anybody could tell the labels of SCENE apart (a .toml file or the name of a shipped one).

    Bayes' rule, which knows the scene, is applied to each of many signals: no classifier can be right more often.
    """
    from cgid import shipped
    from cgid.ceiling.bayes import ceiling as ceiling_of
    from cgid.ceiling.bayes import check_covered
    from cgid.ceiling.learner import bracket, sizes_up_to
    from cgid.ceiling.survey import untrusted
    from cgid.scene import load_scene

    loaded = load_scene(shipped.scene_path(scene))
    check_covered(loaded)
    sizes = () if learner is None else sizes_up_to(learner)
    path = None if picture is None else _checked(Path(picture), overwrite)
    if problem := untrusted(loaded):
        say(f"cgid: warning: do not rely on this ceiling: {problem}", err=True)
    total = n_signals + (n_signals + max(sizes) if sizes else 0)
    with progress_bar(total, "signals") as progress:
        limit = ceiling_of(loaded, n_signals, seed, drop_height_known=drop_height, progress=progress)
        found = None
        if sizes:
            found = bracket(
                loaded, sizes, n_signals, seed, drop_height_known=drop_height, limit=limit, progress=progress
            )
    surveyed = None if path is None else _survey(loaded, min(n_signals, _SURVEYED), seed, path, overwrite)
    content = {"scene": loaded.name, "n_signals": n_signals, "drop_height_known": drop_height, **_figures(limit)}
    if found is not None:
        content["learners"] = [_learner(one) for one in found.learners]
        content["unmeasured"] = found.unmeasured
    if surveyed is not None:
        content["survey"] = surveyed
    if as_json:
        print_json(content)
    else:
        _say(content)
    if path is not None:
        say(f"wrote {path}", err=True)


def _checked(path: Path, overwrite: bool) -> Path:
    """Return the path of a picture after checking that it can be written."""
    from cgid.files import check_new
    from cgid.plots import require_matplotlib

    check_new(path, "a picture", (".png",), overwrite=overwrite)
    require_matplotlib()
    return path


def _figures(limit: Any) -> dict[str, Any]:
    return {
        "accuracy": limit.accuracy,
        "accuracy_error": limit.accuracy_error,
        "right_answers": float(limit.hits.mean()),
        "brier_score": limit.brier_score,
        "brier_error": limit.brier_error,
        "roc_area": {label: limit.roc_area(label) for label in limit.labels},
    }


def _learner(one: Any) -> dict[str, Any]:
    names = ("n_signals", "kind", "accuracy", "accuracy_error")
    differences = ("difference", "difference_error", "regret", "regret_error")
    return {name: getattr(one, name) for name in (*names, *differences)}


def _survey(scene: Any, n_signals: int, seed: int, path: Path, overwrite: bool) -> dict[str, Any]:
    from dataclasses import asdict

    from cgid.ceiling.survey import N_POINTS, survey
    from cgid.files import write_whole
    from cgid.plots import survey_picture

    with progress_bar(n_signals * N_POINTS, "signals") as progress:
        found = survey(scene, n_signals, seed, progress=progress)
    axes = {axis: found.along(axis) for axis in found.present}
    write_whole(path, survey_picture(axes, found.present, found.here), overwrite=overwrite)
    points = [asdict(point) for point in (found.here, *found.points)]
    return {"n_signals": n_signals, "present": found.present, "points": points}


def _say(content: dict[str, Any]) -> None:
    known = "known" if content["drop_height_known"] else "not known"
    say(f"{content['scene']}: {content['n_signals']} signals, drop height {known}")
    say(f"highest accuracy possible {content['accuracy']:.4f} +- {content['accuracy_error']:.4f}")
    say(f"right answers of Bayes' rule {content['right_answers']:.4f}")
    say(f"Brier score {content['brier_score']:.4f} +- {content['brier_error']:.4f}")
    say("area under ROC " + ", ".join(f"{label} {area:.4f}" for label, area in content["roc_area"].items()))
    if "learners" in content:
        say("trained on  learner    accuracy            below the ceiling   by its probabilities")
    for one in content.get("learners", ()):
        accuracy, below, regret = (
            f"{one[name]:.4f} +- {one[f'{name}_error']:.4f}" for name in ("accuracy", "difference", "regret")
        )
        say(f"{one['n_signals']:>10}  {one['kind']:<9}  {accuracy}    {below}    {regret}")
    if content.get("unmeasured"):
        say(f"cgid: warning: {content['unmeasured']} signals could not be measured and were guessed", err=True)
    if "survey" in content:
        _say_survey(content["survey"])


def _say_survey(survey: dict[str, Any]) -> None:
    say(f"survey, {survey['n_signals']} signals a point")
    say(f"{'':<9}  {'':>8}  drop height not known  known")
    for point in survey["points"]:
        value = "" if point["axis"] == "present" else f"{point['value']:g}"
        head = f"{_NAMES[point['axis']]:<9}  {value:>8}  "
        if point["left_out"]:
            say(f"{head}left out: {point['left_out']}")
            continue
        say(
            f"{head}{point['accuracy']:.4f} +- {point['accuracy_error']:.4f}       "
            f"{point['accuracy_known']:.4f} +- {point['accuracy_known_error']:.4f}"
        )
