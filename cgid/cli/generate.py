"""`cgid generate`: a dataset from a scene."""

from __future__ import annotations

import time
from typing import Any

import click

from cgid.cli.options import progress_bar


@click.command(short_help="Make a dataset from a scene.")
@click.argument("scene")
@click.option("-o", "--output", required=True, help="Ending in .h5: one file; else a folder of shards.")
@click.option("-n", "--signals", "n_signals", type=int, help="How many signals (10000), or recordings of a stream (1).")
@click.option("--seed", type=int, default=0, show_default=True, help="The same seed gives the same signals.")
@click.option("--jobs", type=int, default=1, show_default=True, help="Worker processes.")
@click.option("--dtype", type=click.Choice(["float32", "float64"]), default="float32", show_default=True)
@click.option("--shard-signals", type=int, default=4096, show_default=True, help="Signals in each shard of a folder.")
@click.option("--compression", type=click.Choice(["none", "gzip"]), default="none", show_default=True)
@click.option("--overwrite", is_flag=True, help="Replace an old dataset.")
def generate(scene: str, output: str, **options: Any) -> None:
    """Make a dataset of signals from SCENE: a .toml file, or the name of a shipped one such as reference.

    A scene that randomises its sampling rate makes no dataset: train on it directly. A scene with a stream makes
    recordings, each with the truth of its impacts.
    """
    from cgid import shipped
    from cgid.scene import generate as generate_dataset
    from cgid.scene import load_scene

    loaded = load_scene(shipped.scene_path(scene))
    if loaded.stream is not None:
        _make_recordings(loaded, output, **options)
        return
    if options["n_signals"] is None:
        options["n_signals"] = 10_000
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


def _make_recordings(
    scene: Any, output: str, n_signals: int | None, jobs: int, shard_signals: int, compression: str, **options: Any
) -> None:
    from cgid.errors import InvalidValue
    from cgid.scene.stream.generation import generate_recordings
    from cgid.scene.stream.synthesis import samples_of

    for flag, given, default in (
        ("--jobs", jobs, 1),
        ("--shard-signals", shard_signals, 4096),
        ("--compression", compression, "none"),
    ):
        if given != default:
            raise InvalidValue(f"{flag} is for datasets, scene {scene.name} is a stream of recordings; leave it out")
    count = 1 if n_signals is None else n_signals
    seconds = scene.stream.duration * count
    start = time.perf_counter()
    with progress_bar(count * samples_of(scene), "samples") as progress:
        path = generate_recordings(scene, output, count, progress=progress, **options)
    took = time.perf_counter() - start
    click.echo(f"{path}: {count} recordings, {seconds:g} s in {took:.1f} s", err=True)
