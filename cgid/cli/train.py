"""`cgid train`: a model and its card from datasets, from scenes synthesised on the fly, or from labelled recordings."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from cgid import shipped
from cgid._lib import validation
from cgid._lib.terminal import counted
from cgid.cli.answering import prediction_by, warn_of_chance
from cgid.cli.help import Command
from cgid.cli.options import (
    MODEL,
    SCENE,
    OutputName,
    given_flags,
    jobs_option,
    json_option,
    overwrite_option,
    point_of,
    refuse,
    require_one_executor,
    seed_option,
    share_of,
)
from cgid.cli.output import accuracy_text, print_json, progress_bar, say, warn, warn_of_one_place
from cgid.cli.reading import ReadingOptions, reading_options
from cgid.cli.site import keys
from cgid.errors import BadData, CgidError, InvalidValue

if TYPE_CHECKING:
    from cgid.identification.training.manifest import Manifest
    from cgid.identification.training.recordings import Reading
    from cgid.scene import Scene
    from cgid.signals import Batch
    from cgid.store import Dataset

#: Options for recordings only, for datasets and scenes only, and for training rather than correction.
_OF_RECORDINGS = (
    "--by --window --hop --rate --unit --channel --gain --sensitivity --full-scale --format --invert --dead-time"
)
_OF_DATASETS = "--start-error --sensor"
_OF_TRAINING = "--features --family --by --window --hop --start-error --signals"


def _beside_model(path: Path) -> list[Path]:
    from cgid.identification.training.card import beside_model

    return beside_model(path, plots=True)


@click.command(
    cls=Command,
    short_help="Train a model on recordings, on datasets, or on a scene.",
    example="cgid train reference -n 2000 -o model.npz",
)
@click.argument("data", type=SCENE, nargs=-1, required=True, metavar="DATA...")
@click.option(
    "-o",
    "--output",
    type=OutputName(_beside_model),
    help="Write this model file, ending in .npz; the model card is written next to it as .md.",
)
@click.option(
    "--family",
    type=click.Choice(["logistic", "network", "linear"]),
    help="Choose the kind of classifier; by default logistic, for recordings linear.",
)
@click.option("--features", "names", help="Use only these features, separated by commas.")
@click.option(
    "--sensor",
    "sensors",
    multiple=True,
    metavar="X,Y",
    help="Use sensors at these points [m] of a scene's beam together: the recording's channels, in this order.",
)
@click.option(
    "-n",
    "--signals",
    "n_signals",
    type=int,
    default=50_000,
    show_default=True,
    help="Draw this many signals from a scene.",
)
@click.option(
    "--from",
    "base",
    type=MODEL,
    metavar="MODEL",
    help="Correct this model by ten or more labelled impacts instead of training one.",
)
@click.option(
    "--by",
    type=click.Choice(["window", "impact"]),
    help="Choose impacts or windows of recordings, by default impacts if there is silence between them.",
)
@click.option(
    "--window", "window_time", type=float, default=0.1, show_default=True, help="Set the length of a window [s]."
)
@reading_options("same_beam")
@seed_option
@jobs_option
@keys(hop_time=None, start_error=None, scheduler=None)
@click.option("--plots", is_flag=True, help="Plot confusion matrix, reliability diagram and ROC curve (extra plot).")
@overwrite_option
@json_option
@click.pass_context
def train(
    context: click.Context,
    /,
    data: tuple[str, ...],
    output: str | None,
    plots: bool,
    overwrite: bool,
    as_json: bool,
    reading: ReadingOptions,
    **options: Any,
) -> int:
    """Train a model on DATA: labelled recordings, datasets made by cgid generate, or scenes.

    Recordings are named by a manifest, by a folder that contains one, or by a folder with labels as subfolders:
    coal/a.wav, gangue/b.wav. A scene is a .toml file or the name of a shipped one; its signals are not written to disk.

    A manifest is a .csv file with the columns path and label (and as needed start, end, group, channel, rate,
    unit, variable, format, sensitivity, gain, full_scale, invert, same_beam, site). cgid events writes one with a row
    for each impact; fill in the labels. A group (a recording, a day, a
    support) is never on both sides of a split; each group in turn judges what was chosen and trained on the others.

    With --from, ten to fifty labelled impacts correct an existing model: its bias, its slope and the gain of the
    sensor, as far as they give evidence. It reports the accuracy on this beam; its interval counts rocks, and groups
    where there are several. Impacts of recordings that trained the model are left out.

    \b
    cgid events monday.wav tuesday.wav -o events.csv
    cgid train events.csv -o mine.npz
    cgid train events.csv --from default-acceleration -o site-model.npz
    """  # noqa: D301 - \b keeps the lines of the example apart
    from cgid._lib.workers import workers
    from cgid.identification.training.card import check_model_output, write_model
    from cgid.measure.features import choose

    if output is None:
        raise click.UsageError("Missing option '-o' / '--output'.", context)
    path = check_model_output(Path(output), plots=plots, overwrite=overwrite)
    if (base := options.pop("base")) is not None:
        refuse(context, _OF_TRAINING, "--from corrects a model instead of training one")
        how = reading.of_manifest()
        return _correct(data, base, path, reading, how, plots=plots, as_json=as_json)
    names = options.pop("names")
    options["features"] = None if names is None else choose([name.strip() for name in names.split(",")])
    options["same_beam"] = reading.same_beam
    options["sensors"] = [point_of(text) for text in options["sensors"]]
    recorded = [item for item in data if _recorded(item)]
    others = [item for item in data if item not in recorded]
    if recorded and others:
        raise InvalidValue(
            f"{others[0]}: scenes and datasets must be trained on apart from recordings; leave it out, or correct its "
            f"model: cgid train {shlex.quote(others[0])} -o first.npz, then cgid train {shlex.quote(recorded[0])} "
            f"--from first.npz -o {shlex.quote(output)}"
        )
    if recorded:
        refuse(context, _OF_DATASETS, "groups of a manifest are left out one by one")
    else:
        refuse(context, _OF_RECORDINGS, "there is no manifest of recordings")
    require_one_executor(context)
    from cgid.identification.training.manifest import joined

    if options["by"] is None:
        options["by"] = _requested_windows(context, options["features"], reading)
    manifest = joined([_manifest(item, reading) for item in recorded]) if recorded else None
    with workers(options.pop("jobs"), options.pop("scheduler")) as options["workers"]:
        if manifest is not None:
            training, failures = _from_recordings(manifest, reading, options)
        else:
            training, failures = _from_signals(others, options)
    written = write_model(training, path, plots=plots, overwrite=overwrite)
    print_training(training, path, written, prediction_by(path, training.model, manifest, reading), as_json)
    if failures:
        warn(f"{counted(len(failures), 'recording')} failed and are not in the model")
    return failures[0].exit_code if failures else 0


def _correct(data: tuple[str, ...], base: str, path: Path, reading: ReadingOptions, how: Reading, **given: bool) -> int:
    """Correct a model by labelled impacts."""
    from cgid.cli.correction import correct_model

    if len(data) != 1 or not _recorded(data[0]):
        raise BadData(f"{data[-1]}: --from needs one table of labelled impacts, as written by cgid events")
    return correct_model(_manifest(data[0], reading), base, path, reading, how, **given)


def _recorded(item: str) -> bool:
    """Return whether an argument names recordings: a manifest, a folder of recordings, or one without labels."""
    from cgid.identification.training.manifest import is_manifest
    from cgid.recordings import is_dataset
    from cgid.recordings.formats import ENDINGS
    from cgid.store.folder import is_dataset_folder

    path = Path(item)
    try:
        path.stat()
    except (OSError, ValueError):
        return path.suffix.lower() == ".csv"
    if path.is_dir():
        return not is_dataset_folder(path)
    return is_manifest(item) or (path.suffix.lower() in ENDINGS and not is_dataset(item))


def _manifest(item: str, reading: ReadingOptions) -> Manifest:
    """Return the manifest of an argument that names recordings, or of the column of labels of one."""
    from cgid.identification.training.manifest import (
        Manifest,
        annotation_of,
        folder_manifest,
        is_manifest,
        read_manifest,
        unlabelled,
    )

    if is_manifest(item):
        return _noted(read_manifest(item))
    if not Path(item).is_dir():
        marks: list[tuple[float, float, str]] = []
        with suppress(CgidError):  # without labels it need not be readable to say what it lacks
            marks = reading.recording(item).labels()
        if not marks:
            raise BadData(f"{item}: {unlabelled('a recording', item)}")
        about = {"path": item, "chosen": "stretch"}
        rows = [{**about, "start": begin, "end": end, "label": label} for begin, end, label in marks]
        return Manifest(source=item, annotations=tuple(annotation_of(row, Path()) for row in rows))
    manifest = _noted(folder_manifest(item))
    counts = Counter(one.label for one in manifest.annotations)
    counted_labels = ", ".join(f"{label} {count}" for label, count in sorted(counts.items()))
    say(f"cgid: labels of {manifest.source}: {counted_labels}", err=True)
    return manifest


def _noted(manifest: Manifest) -> Manifest:
    """Return a manifest, and say how many of its rows have no label."""
    if n := manifest.n_unlabelled:
        say(f"cgid: {counted(n, 'row')} of {manifest.source} without a label are left out", err=True)
    return manifest


def _requested_windows(
    context: click.Context, features: Any, reading: ReadingOptions
) -> Literal["window", "impact"] | None:
    """Return the slicing given by other options; None to choose from the recordings."""
    if features is not None:
        return None
    given = given_flags(context)
    if "window_time" in given or "hop_time" in given:
        return "window"
    return "impact" if reading.dead_time is not None else None


#: Options for every training.
_COMMON = ("features", "family", "seed", "workers")


def _given(options: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return these options without those that leave the choice to the training."""
    return {name: options[name] for name in names if options[name] is not None}


def _from_signals(data: list[str], options: dict[str, Any]) -> tuple[Any, list[Any]]:
    """Return the training on datasets and scenes, and no errors."""
    from cgid.identification.training import train_on_specimens
    from cgid.scene import Scene

    given = options["start_error"]
    sources = _sources(data, None if given is None else share_of("start_error", given))
    scene = sources[0] if len(sources) == 1 and isinstance(sources[0], Scene) else None
    points = _points_of_one_beam(scene, options)
    if points and scene is not None:
        from cgid.scene.synthesis.through_beam import moved

        scene = moved(scene, points[0])
        sources, options = [scene], {**options, "sensors": []}
    given = _given(options, *_COMMON)
    n_signals = options["n_signals"]
    if scene is not None and not (options["features"] or options["sensors"]):
        from cgid.identification.model.model import stored
        from cgid.learning.faults import explained, number_of_recordings
        from cgid.learning.seams import N_STREAMS, taught
        from cgid.learning.streams import is_streamable, numbers_of_streams, train_on_streams

        if is_streamable(scene):
            with progress_bar(sum(numbers_of_streams(scene, n_signals)), "simulated streams", "measuring") as progress:
                training = train_on_streams(scene, n_signals, progress=progress, **given)
            with progress_bar(N_STREAMS, "streams of a wide world", "measuring") as progress:
                how = {"progress": progress, "workers": options["workers"]}
                model = taught(stored(training.model), scene, n_signals, given.get("seed", 0), **how)
            if not points:  # the windows of another place would be those of another beam
                n_recordings = number_of_recordings(n_signals)
                with progress_bar(n_recordings, "spoilt recordings", "measuring") as progress:
                    how |= {"progress": progress}
                    model = explained(model, scene, n_recordings, given.get("seed", 0), **how)
            training = replace(training, model=model)
            return _behind(training, scene, points, full=True), []
    beam = _beam(sources, options)
    total = sum(n_signals if isinstance(source, Scene) else len(source) for source in sources)
    with progress_bar(total, "signals", "measuring") as progress:
        training = train_on_specimens(
            _batches(sources, options),
            beam=beam,
            progress=progress,
            **given,
        )
    return _behind(training, scene, points), []


def _points_of_one_beam(scene: Scene | None, options: dict[str, Any]) -> list[tuple[float, float]]:
    """Return the points of sensors that are each used alone, and whose answers are joined; none if not requested."""
    sensors, groups = options["sensors"], list(options["same_beam"])
    if not groups:
        return []
    expected = "+".join(str(number) for number in range(1, len(sensors) + 1))
    if scene is None or len(sensors) < 2 or groups != [expected]:
        raise InvalidValue(
            f"--same-beam must be {expected if len(sensors) > 1 else '1+2'}, the sensors of one scene in the order of "
            f"two or more --sensor, got {', '.join(groups)}; recordings have their own --same-beam"
        )
    return list(sensors)


def _behind(training: Any, scene: Scene | None, points: list[tuple[float, float]], *, full: bool = False) -> Any:
    """Return a training on the first of some sensors of a beam, with a model that knows the places of all."""
    from cgid.scene.synthesis.through_beam import beam_of, full_beam

    if not points or scene is None:
        return training
    model = training.model
    if model.beam is None:
        raise InvalidValue("--same-beam of a scene needs features through the beam; leave --features out")
    arrays = {name: array for name, array in model.arrays.items() if not name.startswith("beam.")}
    beam = (full_beam if full else beam_of)(scene, sensors=points)
    return replace(training, model=replace(model, arrays=arrays | beam.arrays))


def _from_recordings(manifest: Manifest, reading: ReadingOptions, options: dict[str, Any]) -> tuple[Any, list[Any]]:
    """Return the training on recordings, and the errors of unreadable ones."""
    from cgid.identification.training import train_on_groups
    from cgid.identification.training.grouped import MAX_FOLDS
    from cgid.identification.training.recordings import record
    from cgid.identification.training.rows import Slicing

    window, hop = options["window_time"], options["hop_time"]
    slicing = Slicing(
        by=options["by"], window_time=window, hop_time=window / 2 if hop is None else hop, dead_time=reading.dead_time
    )
    with progress_bar(manifest.n_intervals, "rows", "measuring") as progress:
        rows = record(
            manifest,
            options["features"],
            slicing=slicing,
            reading=reading.of_manifest(),
            augment=True,
            progress=progress,
        )
    for note in rows.notes:
        say(f"cgid: {note}", err=True)
    for warning in rows.warnings:
        warn(warning)
    given = _given(options, *_COMMON)
    n_folds = min(len(rows.groups), MAX_FOLDS) if len(rows.groups) > 1 else None
    with progress_bar(n_folds, "groups left out", "judging") as progress:
        training = train_on_groups(rows, progress=progress, **given)
    for warning in training.model.training["recorded"]["warnings"][len(rows.warnings) :]:
        warn(warning)
    return training, list(rows.failures)


def print_training(training: Any, path: Path, written: list[Path], then: str, as_json: bool) -> None:
    """Print the results of a training, with warnings, and the command `then` that comes next."""
    from cgid.identification.training.control import control_notes
    from cgid.identification.training.grouped import untold_scale
    from cgid.identification.training.metrics import drawn_text

    metrics, about = training.metrics, training.model.training
    if about["n_left_out"]:
        few = counted(about["n_left_out"], training.model.subject)
        warn(f"{few} could not be measured and {'was' if about['n_left_out'] == 1 else 'were'} excluded")
    warn_of_chance(training.model)
    for note in (*control_notes(training.control or {}), untold_scale(about.get("level_range", {}))):
        if note:
            say(f"cgid: {note}", err=True)
    if as_json:
        print_json({"model": str(path), **metrics, **({"control": control} if (control := training.control) else {})})
        return
    if "drawn" in metrics:
        say(drawn_text(metrics["drawn"]))
    control = training.control or {}
    like = " for recordings like these" if "recorded" in about else ""
    if control.get("told"):
        like = f" in these recordings; about {control['expected']:.1f} in others' machines"
    say(f"accuracy {accuracy_text(metrics)}{like}")
    for vote in metrics.get("running", []):
        summary = f"{accuracy_text(vote)} of {vote['n']}" if vote["n"] else "no recording is that long"
        say(f"running vote over {vote['time']:g} s {summary}")
    if "recordings" in metrics:
        rows = metrics["recordings"]["rows"]
        say(f"vote of a recording {accuracy_text(metrics['recordings'])}, of {counted(len(rows), 'recording')}")
        for row in rows:
            wrong = "" if row["vote"] == row["label"] else f", taken for {row['vote']}"
            say(f"  {row['name']}: {row['label']}{wrong}, {row['accuracy']:.4f} of {row['n']}")
    say("recall " + ", ".join(f"{label} {value:.4f}" for label, value in metrics["recall"].items()))
    say(f"Brier score {metrics['brier_score']:.4f}")
    chance = metrics["calibration_error_by_chance"]
    say(f"expected calibration error {metrics['expected_calibration_error']:.4f} (by chance alone {chance:.4f})")
    say(f"wrote {', '.join(map(str, written))}; now {then}", err=True)


def _beam(sources: list[Scene | Dataset], options: dict[str, Any]) -> Any:
    """Return the beam shared by scenes and datasets, if the features, or the default, need it."""
    from cgid.measure.features.extraction import any_through_beam, kind_for
    from cgid.scene import Scene
    from cgid.scene.synthesis.through_beam import shared_beam

    features, sensors = options["features"], options["sensors"]
    beam, why = None, "the requested features need no beam"
    if features is None or any_through_beam(features):
        beam, why = shared_beam(sources, sensors)
    if sensors and (beam is None or len(sources) > 1 or not isinstance(sources[0], Scene)):
        raise InvalidValue(f"--sensor must be left out, there is no single scene with a beam: {why}; give tail_beam")
    for source in sources:
        warn_of_one_place(source)
    first = sources[0]
    quantity = first.sensor.quantity if isinstance(first, Scene) else first.quantity
    if features is None and kind_for(quantity) == "vibration":
        what = "levels by frequency" if beam is None else "peak, width and restitution of the contact force"
        say(f"cgid: features: {what}, {why}", err=True)
    return beam


def _means_scene(item: str) -> bool:
    """Return whether data is a scene; a non-existing name similar to a shipped one is taken as a misspelling."""
    named = bool(item in shipped.SCENES or validation.suggestion(item, shipped.SCENES))
    return Path(item).suffix == ".toml" or (named and not Path(item).exists())


def _sources(data: list[str], start_error: float | None = None) -> list[Any]:
    """Return scenes and datasets; with an error, the modes of a scene have at least this uncertainty."""
    from cgid.scene import load_scene
    from cgid.store import Dataset

    made = next((item for item in data if not _means_scene(item)), None)
    if start_error is not None and made is not None:
        raise InvalidValue(
            f"{made}: start_error must be left out, the signals of a dataset exist already; give its scene"
        )
    sources: list[Any] = [load_scene(item) if _means_scene(item) else Dataset(item) for item in data]
    if start_error is None:
        return sources
    from cgid.calibration.modes import uncertain

    return [uncertain(scene, start_error) for scene in sources]


def _batches(sources: list[Scene | Dataset], options: dict[str, Any]) -> Iterator[Batch]:
    from cgid.scene import Scene, synthesise
    from cgid.scene.output.generation import MAX_SIGNALS

    n, seed = options["n_signals"], options["seed"]
    for source in sources:
        if not isinstance(source, Scene):
            yield from source.batches()
            continue
        validation.whole("signals", n, 1, MAX_SIGNALS)
        if options["sensors"]:
            from cgid.scene.synthesis.several_sensors import recorded_together

            yield from recorded_together(source, options["sensors"], n, seed)
        else:
            yield from synthesise(source, n, seed)
