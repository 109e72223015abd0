"""`cgid info`: show the contents of a dataset, table, model or recording."""

from __future__ import annotations

import shlex
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from cgid import shipped
from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import OUTPUT, PATH, json_option
from cgid.cli.output import FileErrors, print_json, say, warn
from cgid.cli.reading import CHAIN, ReadingOptions, reading_options, warn_of_volts
from cgid.cli.table import written_table
from cgid.errors import BadData, CgidError
from cgid.signals import channel_name

if TYPE_CHECKING:
    from cgid.identification.detection import Event
    from cgid.store import Dataset

#: Maximum number of samples of all channels held in memory; longer recordings are read block by block.
MAX_SAMPLES = 1 << 24
#: A number of a sound file is at full scale from this on: the largest one of 16 bit.
_FULL = 1 - 2**-15
#: Length of the header of an archive's first entry [bytes], and the name that follows it in a model file.
_LOCAL_HEAD, _HEADER = 30, b"header.npy"


@click.command(
    cls=Command, short_help="Describe a dataset, a model or a recording.", example="cgid info datasets/sample.csv"
)
@click.argument("file", type=PATH)
@reading_options(*CHAIN)
@click.option("--write-site", type=OUTPUT, metavar="FILE.toml", help="Write a site file of what the recording states.")
@json_option
def info(file: str, write_site: str | None, as_json: bool, reading: ReadingOptions) -> int:
    """Describe FILE: a dataset, table, model, manifest, scene or recording, or each recording of a folder.

    Shipped models and scenes have names, such as default or caving.
    """
    from cgid.identification.training.manifest import recordings_of

    if not Path(file).exists():
        for names, path_of in ((shipped.MODELS, shipped.model_path), (shipped.SCENES, shipped.scene_path)):
            file = str(path_of(file)) if file.partition("@")[0] in names else file
    files = recordings_of([file])
    if write_site is not None:
        from cgid._lib.files import check_new, write_whole
        from cgid.recordings.site import site_text

        path = check_new(Path(write_site), "a site file", (".toml",))
        write_whole(path, site_text(reading.recording(files[0]), reading.stated).encode(), overwrite=False)
        say(f"wrote {path}: fill in its names, then cgid predict {shlex.quote(files[0])} --site {path}", err=True)
    reading.require_files(files)
    errors = FileErrors(strict=len(files) == 1)
    for one in errors.each(files):
        with errors:
            _describe(one, as_json, reading)
    return errors.code


def _describe(file: str, as_json: bool, reading: ReadingOptions) -> None:
    from cgid.recordings import is_dataset
    from cgid.store.table import is_table

    if is_table(file):
        content = _table(file)
    elif is_dataset(file):
        content = _dataset(file)
    elif is_model(file):
        content = _model(file)
    elif (rows := written_table(file)) is not None:
        content = {"kind": rows.kind, "file": file, "rows": rows.n_rows, "columns": rows.columns}
    else:
        content = _manifest(file) or _recording(file, as_json, reading)
    if as_json:
        print_json(content)
    else:
        _print(content)


def _print(content: dict[str, Any], indent: str = "") -> None:
    for name, value in content.items():
        if isinstance(value, dict):
            say(f"{indent}{name}:")
            _print(value, indent + "  ")
        elif name == "warnings" and isinstance(value, list):
            _print({name: dict(enumerate(value, 1))}, indent)
        else:
            say(f"{indent}{name}: {_text(value)}")


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_text(one) for one in value) or "none"
    return f"{value:.8g}" if isinstance(value, float) else str(value)


def _dataset(file: str) -> dict[str, Any]:
    from cgid.store import Dataset

    dataset = Dataset(file)
    labels: Counter[str] = Counter()
    for batch in dataset.batches():
        labels.update(batch.labels.tolist())
    about = dataset.header.attributes
    return {
        "kind": "dataset",
        "file": file,
        "signals": len(dataset),
        "samples": dataset.header.n_samples,
        "sampling_rate_hz": dataset.sampling_rate,
        "pre_trigger": dataset.pre_trigger,
        "quantity": dataset.quantity,
        "unit": dataset.unit,
        "labels": dict(sorted(labels.items())),
        "parameters": dict(dataset.header.parameter_units),
        **_laws(dataset),
        "dtype": dataset.header.dtype,
        **_origin(about),
    }


def _laws(dataset: Dataset) -> dict[str, Any]:
    """Return the laws of the stored scene, if it can be read: the one of all impacts, or those of a column by number.

    For laws of one's own, the stored JSON of names and SHA-256 of their modules is there, too.
    """
    from cgid.scene.file.schema import stored_scene

    about = dataset.header.attributes
    own = {"laws": about["laws"]} if "laws" in about else {}
    try:
        scene = stored_scene(about, dataset.path.name)
    except CgidError:  # a law of one's own is not at hand
        scene = None
    if scene is None:
        return own
    laws = {str(number): name for number, name in enumerate(scene.law_names) if name in scene.dissipations}
    return {"dissipation": laws if "dissipation" in dataset.header.parameter_units else ", ".join(laws.values()), **own}


def _table(file: str) -> dict[str, Any]:
    from cgid.store import read_table

    table = read_table(file)
    labels, counts = np.unique(table.labels, return_counts=True)
    unknown = {name: int(np.sum(~np.isfinite(column))) for name, column in table.columns.items()}
    about = table.header.attributes
    return {
        "kind": f"table of {table.header.kind}",
        "file": file,
        "signals": len(table),
        "labels": dict(zip(labels.tolist(), counts.tolist(), strict=True)),
        "columns": dict(table.header.units),
        "without_a_number": {name: count for name, count in unknown.items() if count} or "none",
        **_origin(about),
    }


def _model(file: str) -> dict[str, Any]:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.model.model_file import WITHDRAWN

    model, path_of = StoredModel.load(file), shipped.path_of
    about = next((one for one in shipped.model_versions() if file == str(path_of("models", f"{one['name']}.npz"))), {})
    header = {name: value for name, value in model.header.items() if name not in WITHDRAWN}
    training = header.pop("training")
    metrics = training.pop("metrics", {})
    for table in ("selection", "domain_shift", "beside_force"):  # the model card contains these
        training.pop(table, None)
    shown = ("accuracy", "accuracy_interval_95", "recall", "brier_score", "expected_calibration_error")
    return {
        "kind": "model",
        "file": file,
        **about,
        **header,
        "calibration_impacts": 0 if model.conformal is None else len(model.conformal.scores),
        "training": training,
        "metrics": {name: metrics[name] for name in shown if name in metrics},
    }


def _manifest(file: str) -> dict[str, Any]:
    """Return the content of a manifest or a scene; empty for any other file."""
    from cgid.identification.training.manifest import is_manifest, labels_in

    if file.lower().endswith(".toml") and Path(file).is_file():
        from cgid.physics.contact.own_laws import sources
        from cgid.scene import load_scene

        scene = load_scene(file)
        about = {"kind": "scene", "file": file, "name": scene.name, "description": scene.description}
        laws = [word for source in sources() for word in ("--set", f"laws={source}")]
        return {**about, "scene_sha256": scene.sha256, "next": shlex.join(["cgid", "check", file, *laws])}
    rows = labels_in(Path(file)) if is_manifest(file) else None
    if not rows:
        return {}
    labels = Counter(label for _, label in rows if label)
    train = shlex.join(["cgid", "train", file, "-o", "mine.npz"])
    return {
        "kind": "table of events",
        "file": file,
        "rows": len(rows),
        "recordings": len({path for path, _ in rows}),
        "labels": dict(sorted(labels.items())) or "none",
        "without_a_label": len(rows) - labels.total(),
        "next": train if len(labels) > 1 else f"fill in the column label with two labels or more, then {train}",
    }


def is_model(file: str) -> bool:
    """Return whether a file is named like an archive but does not contain plain arrays: an intact or damaged model."""
    if not file.endswith(".npz"):
        return False
    try:
        with Path(file).open("rb") as stream:
            start = stream.read(_LOCAL_HEAD + len(_HEADER))
    except OSError:
        return True
    # The directory at the end of a crafted archive may take long to read.
    return not start.startswith(b"PK") or start[_LOCAL_HEAD:] == _HEADER


def _recording(file: str, as_json: bool, reading: ReadingOptions) -> dict[str, Any]:
    recording = reading.recording(file)
    volts = warn_of_volts(recording)
    channels, clipped = _channels(recording, as_json, reading.beams(recording))
    for warning in (*recording.warnings, *clipped):
        warn(warning)
    started = {} if recording.start_time is None else {"start_time": recording.start_time.isoformat()}
    about = {
        "format": recording.format,
        **started,
        **channels,
        "warnings": [*volts, *recording.warnings, *clipped] or "none",
    }
    return {"kind": "recording", "file": file, **about, **_made(file)}


#: Text for the impacts of a channel without a quantity; null in JSON.
_NOT_COUNTED = "not counted, since pulses and vibrations differ; give "


def _channels(recording: Any, as_json: bool, beams: tuple[tuple[str, ...], ...]) -> tuple[dict[str, Any], list[str]]:
    """Return the statistics of each channel, and warnings of clipped ones.

    A long recording has no median, which needs all samples, but a mean.
    """
    # A channel with samples that are no numbers is described by the others; the rest of the recording may be sound.
    from cgid.identification.detection.detector import invert_hint
    from cgid.identification.detection.ear import Ear
    from cgid.identification.prediction.same_beam import Detected, RockAssigner, grouped
    from cgid.measure.features.extraction import kind_for

    names, rate = recording.channels, recording.sampling_rate
    blocks, is_short = recording.gaps(range(len(names))).marked(recording.blocks(gaps=True)), False
    if recording.n_samples is not None and recording.n_samples * len(names) <= MAX_SAMPLES:
        blocks, is_short = iter([np.concatenate(list(blocks), axis=1)]), True
    lowest, highest = np.full(len(names), np.inf), np.full(len(names), -np.inf)
    total, n_read, n_samples, dtype = np.zeros(len(names)), np.zeros(len(names), int), 0, ""
    median = np.full(len(names), np.nan)
    # A channel of unknown quantity may contain pulses or vibrations.
    is_known = [channel.quantity not in (None, "level") for channel in names]
    ears = [Ear(rate, kind=kind_for(channel.quantity)) for channel in names]
    impacts: list[list[Detected]] = [[] for _ in names]
    n_clipped, n_full = [0] * len(names), np.zeros(len(names), int)

    def add(row: int, events: list[Event]) -> None:
        impacts[row] += (Detected(row, event.onset) for event in events)
        n_clipped[row] += sum(event.clipped for event in events)

    for block in blocks:
        n_samples, dtype = n_samples + block.shape[1], block.dtype.name
        for row, samples in enumerate(block):
            if is_known[row]:
                add(row, ears[row].feed(samples[None]).events)
            there = samples[np.isfinite(samples)]
            n_read[row] += there.size
            n_full[row] += np.sum(np.abs(there) >= _FULL) if names[row].quantity == "level" else 0
            if not there.size:
                continue
            lowest[row], highest[row] = min(lowest[row], there.min()), max(highest[row], there.max())
            with np.errstate(over="ignore", invalid="ignore"):
                total[row] += there.sum(dtype=np.float64)
                median[row] = np.median(there) if is_short else np.nan
    if not n_read.any():
        raise BadData(f"{recording.source}: samples must be finite, none is; check sensor, cable and sample format")
    lowest[n_read == 0] = highest[n_read == 0] = total[n_read == 0] = np.nan
    described = {}
    for row, (channel, ear) in enumerate(zip(names, ears, strict=True)):
        add(row, ear.feed(None).events)
        if is_known[row] and not impacts[row] and ear.is_upside_down():
            warn(f"{channel_name(recording.source, channel.name)}: no impact: {invert_hint()}")
        stated = (
            "--set full_scale='500 g'" if channel.quantity == "level" else "--unit, such as --unit N or --unit m/s^2"
        )
        middle = {"median": median[row]} if is_short else {"mean": total[row] / max(n_read[row], 1)}
        missing = n_samples - int(n_read[row])
        described[f"channel {channel.name}"] = {
            **({"name": channel.stated} if channel.stated and channel.name == "1" else {}),
            "samples": n_samples,
            **({"not_finite": missing} if missing else {}),
            "sampling_rate_hz": rate,
            "duration_s": n_samples / rate,
            "quantity": channel.quantity or "unknown",
            "unit": channel.unit or "unknown",
            **({"converted": channel.origin} if channel.origin else {}),
            "dtype": dtype,
            "lowest": float(lowest[row]),
            **{name: float(value) for name, value in middle.items()},
            "highest": float(highest[row]),
            "impacts": len(impacts[row]) if is_known[row] else None if as_json else _NOT_COUNTED + stated,
        }
    clipped = [
        f"{channel_name(recording.source, channel.name)}: {n_clipped[row]} of {counted(len(impacts[row]), 'impact')} "
        "are clipped; record with a larger range"
        for row, channel in enumerate(names)
        if n_clipped[row]
    ] + [
        f"{channel_name(recording.source, channel.name)}: {counted(int(n_full[row]), 'sample')} at full scale; it may "
        "be clipped, record with a larger range"
        for row, channel in enumerate(names)
        if n_full[row] > 1  # one is the peak of a recording that was normalised
    ]
    for rows in grouped([channel.name for channel in names], beams):
        if len(rows) > 1:
            found = sorted((one for row in rows for one in impacts[row]), key=lambda one: one.onset)
            rocks = {"impacts": len(RockAssigner[Detected]([rows], rate).feed(found, np.inf))}
            described[f"channels {'+'.join(names[row].name for row in rows)}"] = rocks
    return described, clipped


def _made(file: str) -> dict[str, Any]:
    """Return the attributes of a recording made by cgid; empty for any other."""
    from cgid.store.description import is_hdf5

    if not is_hdf5(Path(file)):  # the rest loads h5py
        return {}
    from cgid.store.reading import Recording, is_recording

    if not is_recording(file):
        return {}
    recording = Recording(file)
    truth = recording.impacts()
    return {
        "truth": {
            "impacts": recording.n_impacts,
            "rocks": int((truth["bounce"] == 0).sum()),
            "labels": dict(sorted(Counter(truth["label"].tolist()).items())),
            "columns": dict(recording.impact_units),
        },
        **_origin(recording.attributes, "recording", "background_sha256"),
    }


def _origin(about: Any, *more: str) -> dict[str, Any]:
    names = ("scene_name", "scene_sha256", "seed", *more, "versions")
    return {name: about[name] for name in names if name in about}
