"""`cgid generate`: a dataset from a scene."""

from __future__ import annotations

import time
from typing import Any

import click

from cgid.cli.options import progress_bar


@click.command(short_help="Make a dataset from a scene.")
@click.argument("scene")
@click.option("-o", "--output", required=True, help="Ending in .h5: one file; else a folder of shards.")
@click.option("-n", "--signals", "n_signals", type=int, default=10_000, show_default=True, help="How many signals.")
@click.option("--seed", type=int, default=0, show_default=True, help="The same seed gives the same signals.")
@click.option("--jobs", type=int, default=1, show_default=True, help="Worker processes.")
@click.option("--dtype", type=click.Choice(["float32", "float64"]), default="float32", show_default=True)
@click.option("--shard-signals", type=int, default=4096, show_default=True, help="Signals in each shard of a folder.")
@click.option("--compression", type=click.Choice(["none", "gzip"]), default="none", show_default=True)
@click.option("--overwrite", is_flag=True, help="Replace an old dataset.")
def generate(scene: str, output: str, **options: Any) -> None:
    """Make a dataset of signals from SCENE: a .toml file, or the name of a shipped one such as reference.

    A scene that randomises its sampling rate makes no dataset: train on it directly.
    """
    from cgid import shipped
    from cgid.scene import generate as generate_dataset
    from cgid.scene import load_scene

    loaded = load_scene(shipped.scene_path(scene))
    n_signals = options["n_signals"]
    start = time.perf_counter()
    with progress_bar(n_signals, "signals") as progress:
        path = generate_dataset(loaded, output, progress=progress, **options)
    seconds = time.perf_counter() - start
    item = 8 if options["dtype"] == "float64" else 4
    megabytes = n_signals * loaded.sampling.samples * item / 1e6
    click.echo(
        f"{path}: {n_signals} signals of {loaded.sampling.samples} samples in {seconds:.1f} s: "
        f"{n_signals / seconds:.0f} signals/s, {megabytes / seconds:.0f} MB/s",
        err=True,
    )
