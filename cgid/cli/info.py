"""`cgid info`: what is in this dataset, table, model or recording."""

from __future__ import annotations

from typing import Any

import click

from cgid.cli.options import print_json


@click.command(short_help="Say what is in a dataset, a model or a recording.")
@click.argument("file")
@click.option("--rate", "sampling_rate", type=float, help="Sampling rate [Hz], where a recording does not say it.")
@click.option("--unit", help="Unit of the samples, where a recording does not say it.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object.")
def info(file: str, sampling_rate: float | None, unit: str | None, as_json: bool) -> None:
    """Say what is in FILE: a dataset, a table, a model, or a recording (every channel)."""
    from cgid.recordings import is_dataset
    from cgid.store import is_table

    if is_table(file):
        content = _table(file)
    elif is_dataset(file):
        content = _dataset(file)
    elif file.endswith(".npz"):
        content = _model(file)
    else:
        content = _recording(file, sampling_rate, unit)
    if as_json:
        print_json(content)
    else:
        _print(content)


def _print(content: dict[str, Any], indent: str = "") -> None:
    for name, value in content.items():
        if isinstance(value, dict):
            click.echo(f"{indent}{name}:")
            _print(value, indent + "  ")
        else:
            click.echo(f"{indent}{name}: {f'{value:.8g}' if isinstance(value, float) else value}")


def _dataset(file: str) -> dict[str, Any]:
    from collections import Counter

    from cgid.store import Dataset

    dataset = Dataset(file)
    labels: Counter[str] = Counter()
    for batch in dataset.batches():
        labels.update(batch.labels.tolist())
    about = dataset.header.attributes
    damaged = dataset.damaged_shards()
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
    for table in ("selection", "domain_shift", "beside_force"):  # the card prints them
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


def _recording(file: str, sampling_rate: float | None, unit: str | None) -> dict[str, Any]:
    import numpy as np

    from cgid.errors import BadData
    from cgid.features import kind_for
    from cgid.identification.events import find_impacts
    from cgid.recordings import read_recording

    channels = {}
    for signal in read_recording(file, sampling_rate=sampling_rate, unit=unit):
        samples = signal.samples
        try:
            impacts = len(find_impacts(signal, kind=kind_for(signal.quantity)))
        except BadData:
            impacts = 0
        channels[f"channel {signal.channel}"] = {
            "samples": samples.size,
            "sampling_rate_hz": signal.sampling_rate,
            "duration_s": signal.duration,
            "quantity": signal.quantity or "unknown",
            "unit": signal.unit or "unknown",
            "dtype": samples.dtype.name,
            "lowest": float(samples.min()),
            "median": float(np.median(samples)),
            "highest": float(samples.max()),
            "impacts": impacts,
        }
    return {"kind": "recording", "file": file, **channels, **_made(file)}


def _made(file: str) -> dict[str, Any]:
    """Return what a recording that cgid has made says about itself; nothing for any other."""
    from collections import Counter

    from cgid.store.recording import Recording, is_recording

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
