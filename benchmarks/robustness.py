"""Performance of a model outside its training conditions: noise, sampling rate, sensor limits, another physics.

    python benchmarks/robustness.py [MODEL.npz ...] [--signals 2000] [--ceiling 500]

Every line is a scene that differs in one setting from the reference scene. The shipped model is compared with one
trained on the reference scene alone, with the same features. Impacts that cannot be measured are counted separately,
and as guesses: 1 over the number of labels. Prints Markdown, writes robustness.csv and robustness.png to this folder.
"""

import argparse
import csv
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cgid import plots, shipped
from cgid.ceiling import untrusted
from cgid.errors import CgidError
from cgid.identification.answers import identify_frames
from cgid.identification.metrics import reliability
from cgid.identification.model import Model
from cgid.identification.training import train
from cgid.scene import Scene, load_scene, synthesise, varied
from studies.ceilings.coloured import limits

HERE = Path(__file__).parent
COLUMNS = ("model", "axis", "setting", "n", "accuracy", "accuracy_measured", "unmeasured", "flagged", "ece", "ceiling")
#: Seams: median of Young's modulus and mean density, of coal and of gangue.
SEAMS = {
    "as trained": ("3.1 GPa", 1400, "10 GPa", 2450),
    "soft coal": ("2.0 GPa", 1320, "10 GPa", 2450),
    "hard coal": ("4.5 GPa", 1480, "10 GPa", 2450),
    "mudstone roof": ("3.1 GPa", 1400, "5 GPa", 2350),
    "sandstone roof": ("3.1 GPa", 1400, "20 GPa", 2600),
}
_TRAINING_SEED, _SEED = 1, 2_000_003


def scenes(reference: Scene) -> Iterator[tuple[str, str, Scene]]:
    """Yield axis, setting and scene of every line."""
    for decibel in range(-10, 41, 5):
        yield "SNR [dB]", f"{decibel}", varied(reference, relative_noise=10 ** (-decibel / 20))
    for rate in (10e3, 20e3, 50e3, 100e3, 200e3, 500e3, 1e6):
        changed = varied(reference, sampling_rate=rate, keep_frame=True) if rate != 200e3 else reference
        yield "sampling rate [Hz]", f"{rate:g}", changed
    for level in (0.3, 0.5, 0.7, 0.9, 1.0):
        yield "clipped at", f"{level:g}", varied(reference, clipped_at=level)
    for edge in (5e3, 10e3, 20e3, 50e3):
        yield "bandwidth [Hz]", f"{edge:g}", varied(reference, bandwidth=edge)
    for theory in ("hertz", "rigid-sphere", "series"):
        yield "stiffness", theory, varied(reference, stiffness=theory)
    for name, seam in SEAMS.items():
        yield "seam", name, _seam(reference, *seam)
    steel = {"density": "7850 kg/m^3", "youngs_modulus": "210 GPa", "poisson_ratio": 0.3}
    for thickness in (20, 30, 50):
        yield "plate", f"{thickness} mm", varied(reference, target=steel | {"thickness": f"{thickness} mm"})
    yield "plate", "half space", reference


def _seam(scene: Scene, coal: str, coal_density: float, gangue: str, gangue_density: float) -> Scene:
    """Return the scene with other materials; each population keeps its relative spread."""
    changes = {"coal": (coal, coal_density), "gangue": (gangue, gangue_density)}
    populations = []
    for population in scene.populations:
        modulus, density = changes[population.label]
        alone = scene.model_copy(update={"populations": (population,)})
        content = population.model_dump(mode="json", exclude_none=True)
        populations += varied(
            alone,
            youngs_modulus=content["youngs_modulus"] | {"median": modulus},
            density=content["density"] | {"mean": density},
        ).populations
    return scene.model_copy(update={"populations": tuple(populations)})


def judge(model: Model, scene: Scene, n_signals: int) -> dict[str, float]:
    """Return the performance of a model on new signals of a scene."""
    probable, hits, unmeasured, flagged = [], [], 0, 0
    for batch in synthesise(scene, n_signals, _SEED):
        known = {"drop_height": batch.parameters["drop_height"]} if model.known else {}
        answers = identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger, **known)
        for answer, truth in zip(answers, batch.labels.tolist(), strict=True):
            flagged += not answer.in_training_range
            if not answer.probabilities:
                unmeasured += 1
                continue
            # The most probable label, regardless of novelty: flagged impacts are counted separately.
            label = max(answer.probabilities, key=answer.probabilities.__getitem__)
            probable.append(answer.probabilities[label])
            hits.append(label == truth)
    bins = reliability(np.array(probable), np.array(hits)) if hits else []
    return {
        "n": n_signals,
        "accuracy": (sum(hits) + unmeasured / len(model.labels)) / n_signals,
        "accuracy_measured": float(np.mean(hits)) if hits else float("nan"),
        "unmeasured": unmeasured / n_signals,
        "flagged": flagged / n_signals,
        "ece": sum(n * abs(c - a) for c, a, n in bins) / len(hits) if hits else float("nan"),
    }


def ceiling_of(scene: Scene, n_signals: int, drop_height_known: bool) -> float:
    """Return the ceiling of a scene; nan if the integration does not cover it."""
    if untrusted(scene):
        return float("nan")
    try:
        (found,) = limits(scene, n_signals, _SEED, (drop_height_known,))
    except CgidError:
        return float("nan")
    return found.accuracy


def models(paths: list[str], reference: Scene, n_training: int) -> dict[str, Model]:
    """Return the models by name: the requested ones or the shipped one, and one of the reference scene alone."""
    files = [Path(p) for p in paths] or [shipped.path_of("models", shipped.DEFAULT_MODEL)]
    found = {path.stem: Model.load(path) for path in files}
    first = next(iter(found.values()))
    # A model of one sampling rate and one noise level shows the value of training on many scenes.
    alone = train(
        synthesise(reference, n_training, _TRAINING_SEED),
        features=first.features,
        family=first.family.name if hasattr(first.family, "name") else str(first.family),
        known=first.known,
    )
    return found | {"reference alone": alone.model}


def picture(rows: list[dict[str, object]]) -> bytes:
    """Draw accuracy and flagged share along every axis as PNG."""
    axes_of = list(dict.fromkeys(str(row["axis"]) for row in rows))
    figure = plots.require_matplotlib()(figsize=(13, 6), layout="constrained")
    grid = figure.subplots(2, 4, sharey=True).ravel()
    names = list(dict.fromkeys(row["model"] for row in rows))
    for axes, axis in zip(grid, axes_of, strict=False):
        here = [row for row in rows if row["axis"] == axis]
        ticks = list(dict.fromkeys(row["setting"] for row in here))
        for colour, name in zip(("C0", "C1", "C2", "C3"), names, strict=False):
            own = [row for row in here if row["model"] == name]
            places = [ticks.index(row["setting"]) for row in own]
            axes.plot(places, [row["accuracy"] for row in own], "o-", color=colour, label=f"{name}: accuracy")
            axes.plot(places, [row["flagged"] for row in own], "x:", color=colour, label=f"{name}: flagged")
        limit = [(ticks.index(row["setting"]), row["ceiling"]) for row in here if row["model"] == names[0]]
        if np.isfinite([value for _, value in limit]).any():
            axes.plot(*zip(*limit, strict=True), "k_", ms=12, label="ceiling")
        axes.set(title=axis, xticks=range(len(ticks)), ylim=(-0.03, 1.03))
        axes.set_xticklabels(ticks, rotation=35, ha="right", fontsize="small")
        axes.grid(alpha=0.3)
    for axes in grid[len(axes_of) :]:
        axes.set_axis_off()
    figure.legend(*grid[0].get_legend_handles_labels(), loc="lower right", fontsize="small")
    return plots.png(figure)


def table(rows: list[dict[str, object]], axis: str) -> None:
    """Print one axis as Markdown."""
    print(
        f"\n**{axis}**\n\n| {axis} | model | accuracy | of the measured | unmeasured | flagged | calibration error | ",
        end="",
    )
    print("ceiling |\n|---|---|---|---|---|---|---|---|")
    for row in rows:
        if row["axis"] == axis:
            numbers = [row[name] for name in COLUMNS[4:]]
            cells = " | ".join(f"{value:.3f}" if np.isfinite(value) else "-" for value in numbers)
            print(f"| {row['setting']} | {row['model']} | {cells} |")


def main() -> None:
    """Judge every model on every scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="*", help="model files; else the shipped default model")
    parser.add_argument("--signals", type=int, default=2000)
    parser.add_argument("--training", type=int, default=20_000, help="signals for the model of the reference scene")
    parser.add_argument(
        "--ceiling", type=int, default=0, metavar="N", help="signals for the ceiling beside it; else none"
    )
    parser.add_argument("--output", type=Path, default=HERE / "robustness", help="of the table and the picture")
    arguments = parser.parse_args()
    reference = load_scene(shipped.scene_path("reference"))
    judged = models(arguments.models, reference, arguments.training)
    rows: list[dict[str, object]] = []
    for axis, setting, scene in scenes(reference):
        limits = {
            known: ceiling_of(scene, arguments.ceiling, known) if arguments.ceiling else float("nan")
            for known in {bool(model.known) for model in judged.values()}
        }
        for name, model in judged.items():
            figures = judge(model, scene, arguments.signals) | {"ceiling": limits[bool(model.known)]}
            rows.append({"model": name, "axis": axis, "setting": setting, **figures})
    print(f"Scene `{reference.name}` varied, {arguments.signals} impacts a line; what cannot be measured is a guess.")
    for axis in dict.fromkeys(str(row["axis"]) for row in rows):
        table(rows, axis)
    with arguments.output.with_suffix(".csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    arguments.output.with_suffix(".png").write_bytes(picture(rows))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
