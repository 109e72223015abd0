"""What a scene contains: `cgid check` and `cgid ceiling`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from cgid.cli.help import Command
from cgid.cli.options import PATH, SCENE
from cgid.cli.output import print_json, progress_bar, say, warn
from cgid.terminal import counted

#: Blocks of 256 impacts in the preview.
_BLOCKS = 16


@click.command(cls=Command, short_help="Validate a scene and say what it would make.", example="cgid check reference")
@click.argument("scene", type=SCENE, required=False)
@click.option("--list", "as_list", is_flag=True, help="Print the names of the scenes that come with cgid.")
@click.option("--seed", type=int, default=0, show_default=True, help="Choose the random numbers of the preview.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def check(scene: str | None, as_list: bool, seed: int, as_json: bool) -> None:
    """Validate SCENE (a .toml file or the name of a shipped one), and preview 4096 of its impacts."""
    from cgid import shipped

    if as_list:
        texts = shipped.scene_descriptions()
        if as_json:
            print_json({"scenes": texts})
        for name, text in {} if as_json else texts.items():
            say(f"{name:<12}{text}")
        return
    if scene is None:
        raise click.UsageError("give a SCENE, or --list for those that come with cgid")
    from cgid.scene import load_scene
    from cgid.scene.noise import background_of
    from cgid.scene.plan import plan

    loaded = load_scene(scene)
    background_of(loaded)  # raises if its recording cannot be read
    # Whoever wrote a scene is warned; what is so in a shipped one is meant.
    preview = _preview(loaded, seed, "remarks" if scene in shipped.SCENES else "warnings")
    if loaded.stream is not None:
        preview |= _stream(loaded)
    if as_json:
        print_json(preview)
        return
    say(f"{preview['name']}: {preview['description']}")
    say(f"scene SHA-256: {preview['scene_sha256']}")
    drawn = preview["randomised"]
    rate = "a drawn rate" if "sampling_rate [Hz]" in drawn else f"{loaded.sampling.sampling_rate:g} Hz"
    samples = loaded.sampling.samples
    if loaded.stream is None:
        say(f"frames: {samples} samples at {rate}, {samples * 4} bytes a signal in float32")
    else:
        told = ", ".join(f"{name} {value:.6g}" for name, value in preview["stream"].items())
        say(f"recording at {rate}: {told}")
    if preview["tail_beam"]:
        say("tail beam: " + ", ".join(f"{name} {value:.4g}" for name, value in preview["tail_beam"].items()))
    if loaded.sensor.coloured:
        asked = plan(loaded, "frames" if loaded.stream is None else "recordings")
        say(f"noise: {asked.decisions['noise'].why}")
    for name, (low, high) in drawn.items():
        say(f"drawn for each block of 256 signals: {name} {low:g} to {high:g}")
    say("share of the labels: " + ", ".join(f"{k} {v:.3f}" for k, v in preview["labels"].items()))
    for name, (low, middle, high) in preview["quantiles_5_50_95"].items():
        say(f"{name:<28} 5 % {low:>11.4g}   median {middle:>11.4g}   95 % {high:>11.4g}")
    for text, share in preview["remarks"].items():
        say(f"known of this scene: {share:.2%} of the impacts {text.partition(';')[0]}")
    for text, share in preview["warnings"].items():
        warn(f"{share:.2%} of the impacts {text}")


def _preview(scene: Any, seed: int, told_as: str) -> dict[str, Any]:
    import numpy as np

    from cgid.scene.draws import BLOCK, parameter_units
    from cgid.scene.impacts import draw

    draws = [draw(scene, seed, block) for block in range(_BLOCKS)]
    units = parameter_units(scene)
    if scene.stream is not None:
        del units["onset"]  # it belongs to a frame
    values = {name: np.concatenate([d.parameters[name] for d in draws]) for name in units}
    sampling_rate = np.repeat([d.scene.sampling.sampling_rate for d in draws], BLOCK)
    labels, counts = np.unique(np.concatenate([d.labels for d in draws]), return_counts=True)
    rows = {f"{name} [{unit}]": values[name] for name, unit in units.items()}
    rows["samples on the contact"] = values["contact_duration"] * sampling_rate
    known = {name: column[np.isfinite(column)] for name, column in rows.items()}
    shares = _shares(draws, values, sampling_rate, scene)
    return {
        "name": scene.name,
        "description": scene.description,
        "scene_sha256": scene.sha256,
        "randomised": _randomised(scene),
        "tail_beam": _tail_beam(scene),
        "labels": dict(zip(labels.tolist(), (counts / counts.sum()).tolist(), strict=True)),
        "quantiles_5_50_95": {
            name: np.quantile(column, [0.05, 0.5, 0.95]).tolist() for name, column in known.items() if column.size
        },
        "remarks": {},
        "warnings": {},
        told_as: {text: share for text, share in shares.items() if share > 0},
    }


def _tail_beam(scene: Any) -> dict[str, float]:
    """Return the facts about a scene's tail beam; empty without one."""
    from cgid.scene.impacts import beam_modes

    if scene.tail_beam is None:
        return {}
    frequency = beam_modes(scene).frequency
    told = {"modes": float(frequency.size), "lowest [Hz]": frequency[0], "highest [Hz]": frequency[-1]}
    if scene.panel is None:
        return told
    told |= {"mass [kg]": scene.panel.mass, "impedance [kg/s]": scene.panel.impedance}
    if scene.panel.ribs is not None:
        told["ribs may be smeared up to [Hz]"] = scene.panel.highest_smeared_frequency
    return told


def _randomised(scene: Any) -> dict[str, tuple[float, float]]:
    """Return the smallest and largest value of each quantity that is drawn per block."""
    if scene.randomise is None:
        return {}
    from cgid.scene.draws import RANDOMISED_UNITS

    units = {"sampling_rate": "Hz"} | RANDOMISED_UNITS
    return {f"{name} [{units[name]}]": law.extremes for name, law in scene.randomise.laws.items()}


def _shares(draws: list[Any], values: dict[str, Any], sampling_rate: Any, scene: Any) -> dict[str, float]:
    """Return the share of the pulses that each warning concerns."""
    import numpy as np

    from cgid.measure.pulses import WANTED_SAMPLES
    from cgid.physics.impact import BEYOND_THIN_PLATE, HERTZ_LIMIT, INELASTICITY_LIMIT

    strain = np.concatenate([d.strain for d in draws])
    inelasticity = np.concatenate([d.inelasticity for d in draws])
    end = values.get("onset", 0.0) + np.nan_to_num(values.get("second_hit_delay", 0.0)) + values["contact_duration"]
    beyond = {
        f"pass Hertz's range (displacement over radius above {HERTZ_LIMIT:g})": strain > HERTZ_LIMIT,
        f"pass the range of the thin plate (lambda above {INELASTICITY_LIMIT:g}): {BEYOND_THIN_PLATE}": (
            inelasticity > INELASTICITY_LIMIT
        ),
        f"have fewer than {WANTED_SAMPLES} samples on the contact; raise sampling_rate": (
            (values["contact_duration"] * sampling_rate < WANTED_SAMPLES) & (scene.sensor.quantity == "force")
        ),
        "last beyond the end of the frame and are cut off; raise samples": (
            (end * sampling_rate > scene.sampling.samples - 1) & (scene.stream is None)
        ),
    }
    if scene.panel is not None and scene.panel.ribs is not None:
        limit = scene.panel.highest_smeared_frequency
        beyond[
            f"are so short (over 1/{limit:.4g} Hz) that ribs may not be smeared: between two the skin gives way more "
            "than this beam does, on one less"
        ] = values["contact_duration"] * limit < 1
    return {text: float(np.sum(passed) / end.size) for text, passed in beyond.items()}


def _stream(scene: Any) -> dict[str, Any]:
    """Return the contents of a scene with a stream, and its label shares over the recording.

    Raises as `generate` for a recording that is too long, or a background that cannot be read.
    """
    import numpy as np

    from cgid.scene.noise import background_of
    from cgid.scene.recordings import require_capacity
    from cgid.scene.rocks import arrivals_of, population_shares
    from cgid.scene.schema import samples_of

    require_capacity(scene, "float32")
    background, duration = background_of(scene), scene.stream.duration
    noise = scene.sensor.noise_level(np.zeros(()), scene.sampling.sampling_rate)
    # The mixture over time, weighted by the arrival rate of the rocks.
    times = (np.arange(1000) + 0.5) / 1000 * duration
    expected = arrivals_of(scene.stream).expected(np.linspace(0, duration, 1001))
    shares = population_shares(scene, times) @ np.diff(expected) / max(expected[-1], 1e-300)
    labels = dict.fromkeys(scene.labels, 0.0)
    for population, share in zip(scene.populations, shares.tolist(), strict=True):
        labels[population.label] += share
    return {
        "labels": labels,
        "stream": {
            "duration [s]": duration,
            "samples": samples_of(scene),
            "rocks expected": float(expected[-1]),
            f"noise [{scene.sensor.unit}]": float(noise),
            f"background [{scene.sensor.unit}]": 0.0 if background is None else background.rms,
        },
    }


#: Signals at each point of the survey, and to train the learner that bounds a ceiling from below.
_SURVEYED, _TRAINED = 2000, 10_000
_NAMES = {"snr": "SNR [dB]", "sampling_rate": "rate [Hz]", "size_spread": "sizes [1]", "present": "as it is"}


@click.command(
    cls=Command,
    short_help="Say how well anybody could tell a scene's labels apart.",
    example="cgid ceiling reference -n 2000",
)
@click.argument("scene", type=SCENE)
@click.option(
    "-n", "--signals", "n_signals", type=int, default=20_000, show_default=True, help="Judge on this many signals."
)
@click.option(
    "--seed", type=int, default=1_000_003, show_default=True, help="Choose the random numbers of these signals."
)
@click.option("--drop-height", is_flag=True, help="Take the drop height of each rock as known.")
@click.option("--learner", type=int, help="Train learners, too, on up to this many signals, and print their accuracy.")
@click.option(
    "--plot", "picture", type=PATH, help="Survey noise, sampling rate and spread of sizes: a PNG picture and a table."
)
@click.option("--overwrite", is_flag=True, help="Replace an existing picture.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
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
    Where its integration does not cover the scene (other laws of loss, filters, [randomise]), two learners enclose the
    answer: one on measured signals from below, one on exact pulses, without a sensor, from above. Behind a [tail_beam]
    the answer is an estimate, neither an upper nor a lower bound: a learner on pulses with the least errors that
    unbiased estimates can have. There, --learner measures the pulses through the beam.
    """
    from cgid.ceiling.bayes import ceiling as ceiling_of
    from cgid.ceiling.bayes import check_asked, check_covered, uncovered
    from cgid.ceiling.beam import check_estimated
    from cgid.ceiling.learner import N_ESTIMATED, bracket, sizes_up_to
    from cgid.ceiling.survey import untrusted
    from cgid.scene import load_scene

    loaded = load_scene(scene)
    check_asked(loaded)
    covered, behind_beam = not uncovered(loaded), loaded.tail_beam is not None
    sizes = () if learner is None else sizes_up_to(learner)
    if picture is not None:
        check_covered(loaded)
    if behind_beam:
        check_estimated(loaded)
    path = None
    if picture is not None:
        from cgid.plots import new_picture

        path = new_picture(picture, overwrite=overwrite)
    if covered and (problem := untrusted(loaded)):
        warn(f"do not rely on this ceiling: {problem}")
    if not covered and not behind_beam:
        sizes = sizes or (_TRAINED,)
    total = (n_signals if covered else n_signals + N_ESTIMATED if behind_beam else 0) + (
        n_signals + max(sizes) if sizes else 0
    )
    with progress_bar(total, "signals", "estimating") as progress:
        limit, found = None, None
        if covered:
            limit = ceiling_of(loaded, n_signals, seed, drop_height_known=drop_height, progress=progress)
        if sizes or behind_beam:
            found = bracket(
                loaded, sizes, n_signals, seed, drop_height_known=drop_height, limit=limit, progress=progress
            )
    surveyed = None if path is None else _survey(loaded, min(n_signals, _SURVEYED), seed, path, overwrite)
    content: dict[str, Any] = {"scene": loaded.name, "n_signals": n_signals, "drop_height_known": drop_height}
    content["kind"] = "limit" if found is None else found.kind
    if limit is not None:
        content |= _figures(limit)
    if found is not None:
        if limit is None:
            content["uncovered"] = found.uncovered
        if found.estimate:
            best = found.estimate[-1]
            content |= {"accuracy": best.accuracy, "accuracy_error": best.accuracy_error, "apart": found.apart}
            content["estimate"] = [_learner(one) for one in found.estimate]
        elif limit is None:
            content["above"] = [_learner(one) for one in found.above]
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
    names = ["n_signals", "kind", "accuracy", "accuracy_error", "difference", "difference_error"]
    if one.regret == one.regret:  # without a ceiling there is none
        names += ["regret", "regret_error"]
    return {name: getattr(one, name) for name in names}


def _survey(scene: Any, n_signals: int, seed: int, path: Path, overwrite: bool) -> dict[str, Any]:
    from dataclasses import asdict

    from cgid.ceiling.survey import N_POINTS, survey
    from cgid.files import write_whole
    from cgid.plots import survey_picture

    with progress_bar(n_signals * N_POINTS, "signals", "estimating") as progress:
        found = survey(scene, n_signals, seed, progress=progress)
    axes = {axis: found.along(axis) for axis in found.present}
    write_whole(path, survey_picture(axes, found.present, found.here), overwrite=overwrite)
    points = [asdict(point) for point in (found.here, *found.points)]
    return {"n_signals": n_signals, "present": found.present, "points": points}


def _say(content: dict[str, Any]) -> None:
    known = "known" if content["drop_height_known"] else "not known"
    say(f"{content['scene']}: {counted(content['n_signals'], 'signal')}, drop height {known}")
    if content["kind"] == "estimate":
        _say_estimated(content)
    elif content["kind"] == "bracket":
        _say_enclosed(content)
    else:
        say(f"highest accuracy possible {content['accuracy']:.4f} +- {content['accuracy_error']:.4f}")
        say(f"right answers of Bayes' rule {content['right_answers']:.4f}")
        say(f"Brier score {content['brier_score']:.4f} +- {content['brier_error']:.4f}")
        say("area under ROC " + ", ".join(f"{label} {area:.4f}" for label, area in content["roc_area"].items()))
        _say_learners(content.get("learners", ()))
    if content.get("unmeasured"):
        warn(f"{counted(content['unmeasured'], 'signal')} could not be measured, the label was guessed")
    if "survey" in content:
        _say_survey(content["survey"])


def _say_learners(learners: Sequence[dict[str, Any]]) -> None:
    if learners:
        say("trained on  learner    accuracy            below the ceiling   by its probabilities")
    for one in learners:
        accuracy, below, regret = (
            f"{one[name]:.4f} +- {one[f'{name}_error']:.4f}" for name in ("accuracy", "difference", "regret")
        )
        say(f"{one['n_signals']:>10}  {one['kind']:<9}  {accuracy}    {below}    {regret}")


def _say_enclosed(content: dict[str, Any]) -> None:
    below, above = (f"{one['accuracy']:.4f} +- {one['accuracy_error']:.4f}" for one in _ends(content))
    say(f"highest accuracy possible between {below} and {above}")
    say(f"not integrated: that needs {content['uncovered']}")
    _say_sides(content, {"learners": "measured", "above": "exact"}, "below the highest")


def _say_estimated(content: dict[str, Any]) -> None:
    say(f"highest accuracy possible about {content['accuracy']:.4f} +- {content['accuracy_error']:.4f}")
    say("an estimate, neither an upper nor a lower bound: pulses with the errors of Cramér and Rao, which hold for")
    say("unbiased estimates of strong blows")
    say(f"pulses stand for the closest ones of the damped Hertz family, {content['apart']:.2%} apart (median)")
    say(f"not integrated: that needs {content['uncovered']}")
    _say_sides(content, {"learners": "measured", "estimate": "estimate"}, "below the estimate")


def _say_sides(content: dict[str, Any], sides: dict[str, str], below: str) -> None:
    say(f"          trained on  learner    accuracy            {below}")
    for side, head in sides.items():
        for one in content[side]:
            accuracy, lost = (f"{one[name]:.4f} +- {one[f'{name}_error']:.4f}" for name in ("accuracy", "difference"))
            say(f"{head:<8}  {one['n_signals']:>10}  {one['kind']:<9}  {accuracy}    {lost}")


def _ends(content: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the learner from below and the one from above that had the most to learn from."""
    return content["learners"][-1], content["above"][-1]


def _say_survey(survey: dict[str, Any]) -> None:
    say(f"survey, {counted(survey['n_signals'], 'signal')} a point")
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
