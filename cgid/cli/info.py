"""`cgid info`: show the contents of a dataset, table, model or recording."""

from __future__ import annotations

from typing import Any

import click

from cgid.cli.options import PATH
from cgid.cli.output import print_json, say

#: Most samples of all channels held in memory; longer recordings are read block by block.
_MOST_HELD = 1 << 24
#: Length of the header of an archive's first entry [bytes], and the name that follows it in a model file.
_LOCAL_HEAD, _HEADER = 30, b"header.npy"


@click.command(short_help="Say what is in a dataset, a model or a recording.")
@click.argument("file", type=PATH)
@click.option("--rate", "sampling_rate", type=float, help="Sampling rate [Hz], where a recording does not say it.")
@click.option("--unit", help="Unit of the samples, where a recording does not say it.")
@click.option("--variable", help="Which array, table or group of a recording, where it holds several.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object.")
def info(file: str, sampling_rate: float | None, unit: str | None, variable: str | None, as_json: bool) -> None:
    """Say what is in FILE: a dataset, a table, a model, or a recording (every channel)."""
    from cgid.recordings import is_dataset
    from cgid.store import is_table

    if is_table(file):
        content = _table(file)
    elif is_dataset(file):
        content = _dataset(file)
    elif _is_model(file):
        content = _model(file)
    else:
        content = _recording(file, sampling_rate, unit, variable)
    if as_json:
        print_json(content)
    else:
        _print(content)


def _print(content: dict[str, Any], indent: str = "") -> None:
    for name, value in content.items():
        if isinstance(value, dict):
            say(f"{indent}{name}:")
            _print(value, indent + "  ")
        else:
            say(f"{indent}{name}: {f'{value:.8g}' if isinstance(value, float) else value}")


def _dataset(file: str) -> dict[str, Any]:
    from collections import Counter

    from cgid.store import Dataset
    from cgid.store.verification import damaged_shards

    dataset = Dataset(file)
    labels: Counter[str] = Counter()
    for batch in dataset.batches():
        labels.update(batch.labels.tolist())
    about = dataset.header.attributes
    damaged = damaged_shards(file)
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
        "dtype": dataset.header.dtype,
        "damaged_shards": ", ".join(damaged) or "none",
        **{name: about[name] for name in ("scene_name", "scene_sha256", "seed", "versions") if name in about},
    }


def _table(file: str) -> dict[str, Any]:
    import numpy as np

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
        **{name: about[name] for name in ("scene_name", "scene_sha256", "seed", "versions") if name in about},
    }


def _model(file: str) -> dict[str, Any]:
    from cgid.identification.model import Model

    model = Model.load(file)
    header = model.header
    training = header.pop("training")
    metrics = training.pop("metrics", {})
    for table in ("selection", "domain_shift", "beside_force"):  # the model card prints these
        training.pop(table, None)
    shown = ("accuracy", "accuracy_interval_95", "recall", "brier_score", "expected_calibration_error")
    return {
        "kind": "model",
        "file": file,
        **header,
        "calibration_impacts": 0 if model.conformal is None else len(model.conformal.scores),
        "training": training,
        "metrics": {name: metrics[name] for name in shown if name in metrics},
    }


def _is_model(file: str) -> bool:
    """Return whether a file is named like an archive but does not hold plain arrays: an intact or damaged model."""
    from pathlib import Path

    if not file.endswith(".npz"):
        return False
    try:
        with Path(file).open("rb") as stream:
            start = stream.read(_LOCAL_HEAD + len(_HEADER))
    except OSError:
        return True
    # The directory at the end of a crafted archive may take long to read.
    return not start.startswith(b"PK") or start[_LOCAL_HEAD:] == _HEADER


def _recording(file: str, sampling_rate: float | None, unit: str | None, variable: str | None) -> dict[str, Any]:
    from cgid.recordings import open_recording

    recording = open_recording(file, sampling_rate=sampling_rate, unit=unit, variable=variable)
    n_samples = recording.n_samples
    short = n_samples is not None and n_samples * len(recording.channels) <= _MOST_HELD
    channels = _held_channels(recording) if short else _long_channels(recording)
    for warning in recording.warnings:
        say(f"cgid: warning: {warning}", err=True)
    started = {} if recording.start_time is None else {"start_time": recording.start_time.isoformat()}
    about = {"format": recording.format, **started, **channels, "warnings": list(recording.warnings) or "none"}
    return {"kind": "recording", "file": file, **about, **_made(file)}


def _held_channels(recording: Any) -> dict[str, Any]:
    """Return the statistics of each channel of a recording that fits into memory."""
    import numpy as np

    from cgid.errors import BadData
    from cgid.identification.detection import TURN_OVER, find_impacts
    from cgid.measure.features import kind_for

    channels = {}
    for signal in recording.signals():
        samples = signal.samples
        try:
            impacts = len(find_impacts(signal, kind=kind_for(signal.quantity)))
        except BadData as error:
            impacts = 0
            if TURN_OVER in str(error):
                say(f"cgid: warning: {signal.name}: no impact: {TURN_OVER}", err=True)
        channels[f"channel {signal.channel}"] = {
            **_facts(recording, signal, samples.size, samples.dtype.name),
            "lowest": float(samples.min()),
            "median": float(np.median(samples)),
            "highest": float(samples.max()),
            "impacts": impacts,
        }
    return channels


def _long_channels(recording: Any) -> dict[str, Any]:
    """Return the statistics of each channel of a long recording, block by block; no median, which needs all samples."""
    from collections import Counter

    import numpy as np

    from cgid.identification.detection import TURN_OVER, ImpactDetector
    from cgid.measure.features import kind_for

    names = recording.channels
    lowest, highest = np.full(len(names), np.inf), np.full(len(names), -np.inf)
    total, n_samples, dtype = np.zeros(len(names)), 0, ""
    detectors = [ImpactDetector(recording.sampling_rate, kind=kind_for(channel.quantity)) for channel in names]
    impacts: Counter[int] = Counter()
    for block in recording.blocks():
        lowest, highest = np.minimum(lowest, block.min(axis=1)), np.maximum(highest, block.max(axis=1))
        total += block.sum(axis=1, dtype=np.float64)
        n_samples, dtype = n_samples + block.shape[1], block.dtype.name
        impacts.update({row: len(detector.feed(block[[row]])) for row, detector in enumerate(detectors)})
    impacts.update({row: len(detector.finish()) for row, detector in enumerate(detectors)})
    for row, channel in enumerate(names):
        if not impacts[row] and detectors[row].is_upside_down():
            say(f"cgid: warning: {recording.source} channel {channel.name}: no impact: {TURN_OVER}", err=True)
    return {
        f"channel {channel.name}": {
            **_facts(recording, channel, n_samples, dtype),
            "lowest": float(lowest[row]),
            "mean": float(total[row] / n_samples),
            "highest": float(highest[row]),
            "impacts": impacts[row],
        }
        for row, channel in enumerate(names)
    }


def _facts(recording: Any, channel: Any, n_samples: int, dtype: str) -> dict[str, Any]:
    return {
        "samples": n_samples,
        "sampling_rate_hz": recording.sampling_rate,
        "duration_s": n_samples / recording.sampling_rate,
        "quantity": channel.quantity or "unknown",
        "unit": channel.unit or "unknown",
        "dtype": dtype,
    }


def _made(file: str) -> dict[str, Any]:
    """Return what a recording made by cgid says about itself; empty for any other."""
    from collections import Counter

    from cgid.store.reading import Recording, is_recording

    if not is_recording(file):
        return {}
    recording = Recording(file)
    truth = recording.impacts()
    names = ("scene_name", "scene_sha256", "seed", "recording", "background_sha256", "versions")
    return {
        "truth": {
            "impacts": recording.n_impacts,
            "rocks": int((truth["bounce"] == 0).sum()),
            "labels": dict(sorted(Counter(truth["label"].tolist()).items())),
            "columns": dict(recording.impact_units),
        },
        **{name: recording.attributes[name] for name in names if name in recording.attributes},
    }
