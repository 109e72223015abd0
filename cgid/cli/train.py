"""`cgid train`: a model and its card from datasets, or from a scene synthesised on the fly."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from cgid.cli.options import print_json, progress_bar


@click.command(short_help="Train a model on datasets or on a scene.")
@click.argument("data", nargs=-1, required=True, metavar="DATA...")
@click.option("-o", "--output", required=True, help="Model file, ending in .npz; the card goes beside it as .md.")
@click.option(
    "--family",
    type=click.Choice(["logistic", "boosting", "discriminant", "network", "linear"]),
    default="logistic",
    show_default=True,
    help="Kind of classifier.",
)
@click.option("--features", "names", help="Only these features, with commas between them.")
@click.option("--test-share", type=float, default=0.25, show_default=True, help="Share of specimens that only judge.")
@click.option(
    "--calibration-share",
    type=float,
    default=0.1,
    show_default=True,
    help="Share that only calibrates prediction sets.",
)
@click.option("--drop-height", is_flag=True, help="The model is told how far each rock fell, as the data say.")
@click.option("-n", "--signals", "n_signals", type=int, default=50_000, show_default=True, help="From a scene.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the split, and of the signals of a scene.")
@click.option("--shuffle-labels", is_flag=True, help="Check of the method: accuracy must be that of guessing.")
@click.option("--plots", is_flag=True, help="Also confusion, reliability and ROC pictures (extra plot).")
@click.option("--overwrite", is_flag=True, help="Replace an old model.")
@click.option("--json", "as_json", is_flag=True, help="Print the metrics as one JSON object.")
def train(
    data: tuple[str, ...],
    output: str,
    family: str,
    names: str | None,
    test_share: float,
    calibration_share: float,
    drop_height: bool,
    n_signals: int,
    seed: int,
    shuffle_labels: bool,
    plots: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Train a model on DATA: datasets made by cgid generate, or scenes.

    A scene is a .toml file or the name of a shipped one; its signals never touch the disk.
    """
    from cgid.features import choose
    from cgid.identification.output import check_model_output, write_model
    from cgid.identification.training import train as train_model

    path = check_model_output(Path(output), plots=plots, overwrite=overwrite)
    chosen = None if names is None else choose([name.strip() for name in names.split(",")])
    with progress_bar(None, "signals") as progress:
        training = train_model(
            _batches(data, n_signals, seed),
            features=chosen,
            family=family,
            test_share=test_share,
            calibration_share=calibration_share,
            known=("drop_height",) if drop_height else (),
            seed=seed,
            shuffle_labels=shuffle_labels,
            progress=progress,
        )
    written = write_model(training, path, plots=plots)
    metrics = training.metrics
    if as_json:
        print_json({"model": str(path), **metrics})
        return
    low, high = metrics["accuracy_interval_95"]
    click.echo(f"accuracy {metrics['accuracy']:.4f} (95 % interval {low:.4f} to {high:.4f})")
    click.echo("recall " + ", ".join(f"{label} {value:.4f}" for label, value in metrics["recall"].items()))
    click.echo(f"Brier score {metrics['brier_score']:.4f}")
    chance = metrics["calibration_error_by_chance"]
    click.echo(f"expected calibration error {metrics['expected_calibration_error']:.4f} (by chance alone {chance:.4f})")
    left_out = training.model.training["n_left_out"]
    if left_out:
        click.echo(f"cgid: warning: {left_out} impacts could not be measured and were left out", err=True)
    click.echo("wrote " + ", ".join(map(str, written)), err=True)


def _batches(data: tuple[str, ...], n_signals: int, seed: int) -> Iterator[Any]:
    from cgid import shipped
    from cgid.store import Dataset

    for item in data:
        if Path(item).suffix == ".toml" or (item in shipped.SCENES and not Path(item).exists()):
            from cgid.scene import load_scene, synthesise

            yield from synthesise(load_scene(shipped.scene_path(item)), n_signals, seed)
        else:
            yield from Dataset(item).batches()
