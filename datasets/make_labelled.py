"""Make the folder labelled again: recordings of one beam, each of twenty rocks that fall one after the other.

    python datasets/make_labelled.py

An example for your own recordings: monday, tuesday and wednesday have labels in labels.csv, thursday is for prediction.
The beam is not that of the default models. The rocks are those of the scene reference, with other seeds than any
shipped model was trained with. labels.csv is what `cgid events` writes, with the column "label" filled in.
"""

import csv
from pathlib import Path

import numpy as np
from scipy.io import wavfile

from cgid.cli.main import run
from cgid.scene import load_scene, parse_scene, synthesise

HERE = Path(__file__).parent
#: Rocks of a recording, and the time between them [s].
N_ROCKS, SPACING = 20, 0.3
#: End stop of the recorder [m/s^2], and the noise of the sensor.
FULL_SCALE, NOISE = 10000.0, 0.5
DAYS = {"monday": 201, "tuesday": 202, "wednesday": 203, "thursday": 204}
BEAM = {
    "length": "1.1 m", "width": "0.9 m", "thickness": "25 mm", "edges": "cantilever", "damping_ratio": "2.5 %",
    "ribs": {"number": 5, "depth": "180 mm", "thickness": "20 mm"},
    "impact_point": {
        "x": {"distribution": "uniform", "lowest": "0.15 m", "highest": "0.9 m"},
        "y": {"distribution": "uniform", "lowest": "0.1 m", "highest": "0.8 m"},
    },
    "sensor_point": {"x": "0.4 m", "y": "0.3 m"},
}  # fmt: skip


def main() -> None:
    """Write the recordings and the table beside this file."""
    folder = HERE / "labelled"
    folder.mkdir(exist_ok=True)
    truth = {f"{day}.wav": recording(folder / f"{day}.wav", seed) for day, seed in DAYS.items()}
    files = [str(folder / name) for name in list(truth)[:3]]
    table = folder / "labels.csv"
    table.unlink(missing_ok=True)  # a table with labels is not replaced
    given = ["--full-scale", f"{FULL_SCALE:g} m/s^2"]
    assert run(["events", *files, "-o", str(table), *given]) == 0
    with table.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    for row in rows:
        onsets, labels = truth[Path(row["path"]).name]
        nearest = int(np.argmin(np.abs(onsets - float(row["time_s"]))))
        row["label"] = labels[nearest] if abs(onsets[nearest] - float(row["time_s"])) < 0.02 else ""
    with table.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def recording(path: Path, seed: int) -> tuple[np.ndarray, list[str]]:
    """Write a recording; return the times [s] at which rocks hit, and their labels."""
    reference = load_scene(HERE / "reference.toml")
    content = reference.model_dump(mode="json", exclude_unset=True)
    content |= {
        "name": "a labelled example",
        "sampling": {"sampling_rate": "12.8 kHz", "samples": 12800, "pre_trigger": 640},
        "sensor": {"quantity": "acceleration", "anti_alias": {"frequency": "5 kHz", "order": 8}},
        "tail_beam": BEAM,
    }
    for population in content["populations"]:  # what a site would label: known batches of one size, dropped by hand
        population["radius"] = {"distribution": "uniform", "lowest": "30 mm", "highest": "45 mm"}
        population["drop_height"] = {"distribution": "uniform", "lowest": "1 m", "highest": "1.3 m"}
    batch = next(synthesise(parse_scene(content), N_ROCKS, seed, dtype="float64"))
    rate, step = batch.sampling_rate, round(SPACING * batch.sampling_rate)
    samples = np.random.default_rng(seed).normal(0, NOISE, N_ROCKS * step + batch.signals.shape[1])
    for number, signal in enumerate(batch.signals):
        samples[number * step : number * step + signal.size] += signal
    samples = samples[: N_ROCKS * step]
    wavfile.write(path, round(rate), np.round(np.clip(samples / FULL_SCALE, -1, 1 - 2**-15) * 2**15).astype(np.int16))
    onsets = batch.parameters["onset"] if "onset" in batch.parameters else np.full(N_ROCKS, batch.pre_trigger / rate)
    return onsets + np.arange(N_ROCKS) * SPACING, batch.labels.tolist()


if __name__ == "__main__":
    main()
