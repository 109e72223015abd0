"""`cgid train`: a model and its card from datasets, from scenes synthesised on the fly, or from labelled recordings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from cgid import validation
from cgid.cli.options import PATH, crew_options, dead_time_in_seconds, require_one_crew
from cgid.cli.output import print_json, progress_bar, say, say_error
from cgid.errors import CgidError, InvalidValue

#: Options for recordings only, and for datasets and scenes only.
_OF_RECORDINGS = {
    "by": "--by",
    "window_time": "--window",
    "hop_time": "--hop",
    "level_free": "--level-free",
    "sampling_rate": "--rate",
    "unit": "--unit",
    "channels": "--channel",
    "dead_time": "--dead-time",
    "strict": "--strict",
}
_OF_DATASETS = {
    "test_share": "--test-share",
    "calibration_share": "--calibration-share",
    "drop_height": "--drop-height",
}


@click.command(short_help="Train a model on datasets, on a scene, or on recordings.")
@click.argument("data", type=PATH, nargs=-1, required=True, metavar="DATA...")
@click.option(
    "-o", "--output", type=PATH, required=True, help="Model file, ending in .npz; the card goes beside it as .md."
)
@click.option(
    "--family",
    type=click.Choice(["logistic", "boosting", "network", "linear"]),
    help="Kind of classifier: logistic by default, linear for recordings.",
)
@click.option("--features", "names", help="Only these features, with commas between them.")
@click.option("--class-weights", help="Weight of a row of each label: balanced, or such as coal=1,gangue=3.")
@click.option("--test-share", type=float, default=0.25, show_default=True, help="Share of specimens that only judge.")
@click.option(
    "--calibration-share",
    type=float,
    default=0.1,
    show_default=True,
    help="Share that only calibrates prediction sets.",
)
@click.option("--drop-height", is_flag=True, help="The model also gets the drop height of each rock.")
@click.option("-n", "--signals", "n_signals", type=int, default=50_000, show_default=True, help="From a scene.")
@click.option(
    "--by",
    type=click.Choice(["window", "impact"]),
    default="window",
    show_default=True,
    help="What the model decides on in recordings.",
)
@click.option("--window", "window_time", type=float, default=0.1, show_default=True, help="Length of a window [s].")
@click.option("--hop", "hop_time", type=float, help="From one window to the next [s]; half a window by default.")
@click.option("--level-free", is_flag=True, help="Only features in which the gain of a sensor cancels.")
@click.option("--rate", "sampling_rate", type=float, help="Sampling rate [Hz], for recordings without it.")
@click.option("--unit", help="Unit of the samples (N, g, ...), for recordings without it.")
@click.option("--channel", "channels", multiple=True, help="Of the recordings, several together as 1+2; else all.")
@click.option("--dead-time", type=float, help="Ringing after a blow [ms], with --by impact.")
@click.option("--strict", is_flag=True, help="Stop at the first recording that cannot be read.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the split, and of the signals of a scene.")
@crew_options
@click.option("--shuffle-labels", is_flag=True, help="Check of the method: accuracy must be that of guessing.")
@click.option("--plots", is_flag=True, help="Also confusion, reliability and ROC pictures (extra plot).")
@click.option("--overwrite", is_flag=True, help="Replace an old model.")
@click.option("--json", "as_json", is_flag=True, help="Print the metrics as one JSON object.")
@click.pass_context
def train(
    context: click.Context,
    /,
    data: tuple[str, ...],
    output: str,
    plots: bool,
    overwrite: bool,
    as_json: bool,
    **options: Any,
) -> int:
    """Train a model on DATA: datasets made by cgid generate, scenes, or a manifest of labelled recordings.

    A scene is a .toml file or the name of a shipped one; its signals never touch the disk.

    A manifest is a .csv file with the columns path and label (and, as needed, start, end, group, channel, gain, sensor,
    reference, rate, unit, variable), or a .toml file with a [[recording]] for each file, which may list intervals = [{
    start, end, label }]. A group (a recording, a day, a support) is never on both sides of a split; each group in turn
    judges what was chosen and trained on the others. Scenes and datasets beside a manifest are used for training, too,
    with their level and spectrum moved to those of the recordings.
    """
    from cgid.identification.card import check_model_output, write_model
    from cgid.identification.manifest import is_manifest
    from cgid.measure.features import choose
    from cgid.workers import workers

    path = check_model_output(Path(output), plots=plots, overwrite=overwrite)
    names = options.pop("names")
    options["features"] = None if names is None else choose([name.strip() for name in names.split(",")])
    options["class_weights"] = _class_weights(options["class_weights"])
    manifests = [item for item in data if is_manifest(item)]
    others = [item for item in data if item not in manifests]
    _refuse_stray_options(context, _OF_DATASETS if manifests else _OF_RECORDINGS, bool(manifests))
    require_one_crew(context)
    if len(manifests) > 1:
        raise InvalidValue(f"{manifests[1]}: there must be one manifest, got {len(manifests)}; put all into one")
    with workers(options.pop("jobs"), options.pop("scheduler")) as options["crew"]:
        if manifests:
            training, failures = _from_recordings(manifests[0], others, options)
        else:
            training, failures = _from_signals(others, options)
    written = write_model(training, path, plots=plots, overwrite=overwrite)
    _say(training, path, written, as_json)
    for error in failures:
        say_error(error)
    return failures[0].exit_code if failures else 0


#: Options for every training.
_COMMON = ("features", "family", "class_weights", "seed", "shuffle_labels", "crew")


def _from_signals(data: list[str], options: dict[str, Any]) -> tuple[Any, list[Any]]:
    """Return the training on datasets and scenes, and no errors."""
    from cgid.identification.training import train as train_model

    with progress_bar(None, "signals") as progress:
        training = train_model(
            _batches(data, options["n_signals"], options["seed"]),
            known=("drop_height",) if options["drop_height"] else (),
            progress=progress,
            **{name: options[name] for name in (*_COMMON, "test_share", "calibration_share")},
        )
    return training, []


def _from_recordings(manifest: str, others: list[str], options: dict[str, Any]) -> tuple[Any, list[Any]]:
    """Return the training on recordings, and the errors of unreadable ones."""
    from cgid.identification.labelled_recordings import Reading, record
    from cgid.identification.manifest import read_manifest
    from cgid.identification.rows import Slicing
    from cgid.identification.training import train as train_model

    window, hop = options["window_time"], options["hop_time"]
    slicing = Slicing(
        by=options["by"],
        window_time=window,
        hop_time=window / 2 if hop is None else hop,
        dead_time=dead_time_in_seconds(options["dead_time"]),
    )
    given = {name: options[name] for name in ("sampling_rate", "unit", "strict")}
    with progress_bar(None, f"{options['by']}s") as progress:
        rows = record(
            read_manifest(manifest),
            options["features"],
            slicing=slicing,
            reading=Reading(channels=options["channels"] or None, **given),
            level_free=options["level_free"],
            progress=progress,
        )
    rows, synthetic = _with_synthetic(others, rows, options) if others else (rows, None)
    for warning in rows.warnings:
        say(f"cgid: warning: {warning}", err=True)
    own = {name: options[name] for name in (*_COMMON, "level_free")}
    try:
        with progress_bar(None, "groups") as progress:
            training = train_model(rows, synthetic=synthetic, progress=progress, **own)
    except CgidError:
        for failure in rows.failures:  # the unreadable recordings may be the missing ones
            say_error(failure)
        raise
    return training, list(rows.failures)


def _with_synthetic(data: list[str], recorded: Any, options: dict[str, Any]) -> tuple[Any, Any]:
    """Return recorded impacts, and those of datasets and scenes, with the features that both can have."""
    from itertools import chain

    from cgid.errors import BadData
    from cgid.identification.rows import in_unit, measure
    from cgid.measure.features import supported

    if recorded.kind == "window":
        raise InvalidValue(
            f"{data[0]}: scenes hold single impacts; give --by impact to train on both, or leave them out"
        )
    batches = _batches(data, options["n_signals"], options["seed"])
    first = next(batches, None)
    if first is None:
        raise BadData(f"{data[0]}: there must be signals to train on; there are none")
    if options["features"] is None:
        names = supported(recorded.names, first.sampling_rate, first.signals.shape[1])
        if not names:
            raise BadData(
                f"{data[0]}: frames of {first.signals.shape[1]} samples at {first.sampling_rate:g} Hz hold no feature "
                "of the recordings; make longer ones"
            )
        recorded = recorded.only(names)
    with progress_bar(None, "signals") as progress:
        alike = in_unit(chain([first], batches), recorded.unit, recorded.names)
        return recorded, measure(alike, recorded.names, progress, crew=options["crew"])


def _say(training: Any, path: Path, written: list[Path], as_json: bool) -> None:
    metrics, about = training.metrics, training.model.training
    if about["n_left_out"]:
        what = "windows" if training.model.kind == "window" else "impacts"
        say(f"cgid: warning: {about['n_left_out']} {what} could not be measured and were left out", err=True)
    without = about.get("recorded", {}).get("synthetic", {}).get("accuracy_without")
    if without is not None and without > metrics["accuracy"]:
        told = f"{metrics['accuracy']:.4f} of the recorded impacts are answered right, without them {without:.4f}"
        say(f"cgid: warning: with synthetic impacts {told}; leave the scenes out", err=True)
    if as_json:
        print_json({"model": str(path), **metrics})
        return
    say(f"accuracy {_share(metrics)}")
    for vote in metrics.get("running", []):
        told = f"{_share(vote)} of {vote['n']}" if vote["n"] else "no recording is that long"
        say(f"running vote over {vote['time']:g} s {told}")
    if "recordings" in metrics:
        say(f"vote of a recording {_share(metrics['recordings'])} of {metrics['recordings']['n']}")
        for row in metrics["recordings"]["rows"]:
            wrong = "" if row["vote"] == row["label"] else f", taken for {row['vote']}"
            say(f"  {row['name']}: {row['label']}{wrong}, {row['accuracy']:.4f} of {row['n']}")
    say("recall " + ", ".join(f"{label} {value:.4f}" for label, value in metrics["recall"].items()))
    say(f"Brier score {metrics['brier_score']:.4f}")
    chance = metrics["calibration_error_by_chance"]
    say(f"expected calibration error {metrics['expected_calibration_error']:.4f} (by chance alone {chance:.4f})")
    say("wrote " + ", ".join(map(str, written)), err=True)


def _share(metrics: dict[str, Any]) -> str:
    low, high = metrics["accuracy_interval_95"]
    return f"{metrics['accuracy']:.4f} (95 % interval {low:.4f} to {high:.4f})"


def _refuse_stray_options(context: click.Context, stray: dict[str, str], recorded: bool) -> None:
    """Refuse options that do not apply to the data, instead of ignoring them."""
    for name, flag in stray.items():
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            reason = (
                "groups of a manifest are left out one by one" if recorded else "there is no manifest of recordings"
            )
            raise InvalidValue(f"{flag} must be left out, {reason}")


def _class_weights(text: str | None) -> dict[str, float] | str | None:
    if text is None or text == "balanced":
        return text
    weights = {}
    for part in text.split(","):
        label, _, number = part.partition("=")
        try:
            weights[label.strip()] = float(number)
        except ValueError:
            raise InvalidValue(
                f"--class-weights must be balanced, or such as coal=1,gangue=3 for labels, got {text!r}"
            ) from None
    return weights


def _batches(data: list[str], n_signals: int, seed: int) -> Iterator[Any]:
    from cgid import shipped
    from cgid.store import Dataset

    for item in data:
        if Path(item).suffix == ".toml" or (item in shipped.SCENES and not Path(item).exists()):
            from cgid.scene import load_scene, synthesise
            from cgid.scene.generation import MOST_SIGNALS

            validation.whole("signals", n_signals, 1, MOST_SIGNALS)
            yield from synthesise(load_scene(shipped.scene_path(item)), n_signals, seed)
        else:
            yield from Dataset(item).batches(check_sums=True)
