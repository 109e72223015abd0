"""`cgid generate`: make a dataset, recordings or a table from a scene, or print the plan for it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click

from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import (
    OUTPUT,
    SCENE,
    given_flags,
    jobs_option,
    json_option,
    overwrite_option,
    require_one_executor,
    seed_option,
)
from cgid.cli.output import print_json, progress_bar, say, warn
from cgid.cli.site import keys
from cgid.errors import InvalidValue

#: Options for tables and their outputs.
_ONLY = {"features_only": "features", "quantities": "closed-form", "parameters_only": "parameters"}
#: Options for stored signals.
_OF_SIGNALS = ("dtype", "shard_signals", "jobs", "scheduler")
#: Those among them that do not apply to recordings, and their defaults.
_OF_MANY = {"jobs": 1, "scheduler": None, "shard_signals": 4096}
#: Arguments of `generate_recordings` and `generate`.
_OF_RECORDINGS = ("output", "n_signals", "seed", "overwrite", "resume", "dtype")
_OF_DATASETS = (*_OF_RECORDINGS, "shard_signals", "jobs", "scheduler")


@click.command(
    cls=Command, short_help="Make a dataset from a scene.", example="cgid generate reference -n 1000 -o data"
)
@click.argument("scene", type=SCENE)
@click.option(
    "-o",
    "--output",
    type=OUTPUT,
    help="Write one file (ending in .h5) or a folder of shards; a table ends in .h5, .parquet or .csv.",
)
@click.option(
    "-n",
    "--signals",
    "n_signals",
    type=int,
    help="Make this many signals, by default 10000; of a stream, recordings, by default 1.",
)
@seed_option
@jobs_option
@keys(dtype="float32", shard_signals=4096, scheduler=None)
@overwrite_option
@click.option("--resume", is_flag=True, help="Continue an unfinished run, to the same bytes.")
@click.option("--features-only", is_flag=True, help="Write a table of features instead of signals.")
@click.option("--features", help="Tabulate only these features, separated by commas; by default those of a model.")
@click.option(
    "--quantities",
    help="Tabulate these quantities (peak_force,impulse) instead of signals, without computing pulses.",
)
@click.option("--parameters-only", is_flag=True, help="Write a table of the sampled parameters.")
@click.option("--explain", is_flag=True, help="Print the plan: which stages would run, which would not, and why.")
@json_option
@click.pass_context
def generate(context: click.Context, /, scene: str, **options: Any) -> None:
    """Make a dataset of signals from SCENE: a .toml file, or the name of a shipped one such as reference.

    With --features-only, --quantities or --parameters-only a table is written instead of signals.
    A scene that randomises its sampling rate makes no dataset: train on it directly, or tabulate its features. A scene
    with a stream makes recordings, each with the truth of its impacts.
    """
    output = _checked_output(context)
    from cgid.scene import load_scene, plan

    loaded = load_scene(scene)
    if loaded.stream is not None:
        if output != "frames":
            raise click.UsageError(
                f"scene {loaded.name} is a stream of recordings, which has no tables; leave out --features-only, "
                "--quantities and --parameters-only",
                context,
            )
        _require_recordings(loaded, options)
        output = "recordings"
    if options["n_signals"] is None:
        options["n_signals"] = 10_000 if loaded.stream is None else 1
    synthesis_plan = plan(loaded, output, dtype=options["dtype"], **_which(loaded, output, options))
    if options["explain"]:
        _explain(synthesis_plan, options["n_signals"], options["as_json"])
    elif output == "recordings":
        _make_recordings(loaded, **{name: options[name] for name in _OF_RECORDINGS})
    elif output == "frames":
        _write_dataset(synthesis_plan, options)
    else:
        _write_table(synthesis_plan, options)


def _checked_output(context: click.Context) -> str:
    """Return the requested output; refuse contradictory options before any work."""
    options = context.params
    given = given_flags(context)
    only = [name for name in _ONLY if name in given]
    if len(only) > 1:
        raise click.UsageError(f"{' and '.join(map(_flag, only))} exclude each other; give one of them", context)
    if "features" in given and "features_only" not in only:
        raise click.UsageError("--features needs --features-only; give both or neither", context)
    require_one_executor(context)
    if options["as_json"] and not options["explain"]:
        raise click.UsageError("--json needs --explain: it prints the plan; give both or neither", context)
    if only and options["resume"]:
        raise click.UsageError(
            f"--resume is for signals and recordings, a table ({_flag(only[0])}) is written completely or not at all; "
            "leave --resume out",
            context,
        )
    for name in _OF_SIGNALS:
        if only and name in given:
            raise click.UsageError(
                f"{given[name]} is for signals, {_flag(only[0])} keeps none; leave one of them out", context
            )
    if not options["explain"]:
        _require_file(context, bool(only))
    return _ONLY[only[0]] if only else "frames"


def _require_file(context: click.Context, table: bool) -> None:
    output = context.params["output"]
    if output is None:
        raise click.UsageError("Missing option '-o' / '--output'", context)
    if table and Path(output).suffix.lower() not in (".h5", ".hdf5", ".parquet", ".csv"):
        raise click.UsageError(
            f"-o must end in .h5, .hdf5, .parquet or .csv for a table, got {output}; choose such a name", context
        )


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _which(scene: Any, output: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return the chosen features or quantities."""

    def names(name: str) -> list[str] | None:
        return None if options[name] is None else [part.strip() for part in options[name].split(",")]

    if output == "features":
        return {"features": names("features") or _features_of_model(scene)}
    return {"quantities": names("quantities")} if output == "closed-form" else {}


def _features_of_model(scene: Any) -> tuple[str, ...]:
    """Return the default features of a model for signals of this scene."""
    from cgid.identification.training.rows import DEFAULT_FEATURES, DEFAULT_VIBRATION_FEATURES
    from cgid.measure.features.extraction import kind_for
    from cgid.scene.synthesis.plan import supported_by

    pulses = kind_for(scene.sensor.quantity) == "pulse"
    return supported_by(scene, DEFAULT_FEATURES if pulses else DEFAULT_VIBRATION_FEATURES)


def _write_dataset(synthesis_plan: Any, options: dict[str, Any]) -> None:
    from cgid.scene import generate as generate_dataset

    scene, n_signals = synthesis_plan.scene, options["n_signals"]
    start = time.perf_counter()
    _warn_of_plate(scene, options["seed"])
    with progress_bar(n_signals, "signals", "generating") as progress:
        path = generate_dataset(scene, progress=progress, **{name: options[name] for name in _OF_DATASETS})
    seconds = time.perf_counter() - start
    megabytes = n_signals * synthesis_plan.signal_bytes / 1e6
    # A resumed run makes only the missing files.
    speed = f": {n_signals / seconds:.0f} signals/s, {megabytes / seconds:.0f} MB/s" if not options["resume"] else ""
    text = f"{counted(n_signals, 'signal')} of {counted(scene.sampling.samples, 'sample')}"
    say(f"{path}: {text} in {seconds:.1f} s{speed}", err=True)


def _warn_of_plate(scene: Any, seed: int) -> None:
    """Warn once if rocks of the first block exceed the range of the thin plate; blocks do not warn."""
    from cgid.physics import ThinPlate
    from cgid.physics.contact.impact import BEYOND_THIN_PLATE, INELASTICITY_LIMIT
    from cgid.scene.synthesis.draws import require_seed
    from cgid.scene.synthesis.impacts import draw

    if not isinstance(scene.body, ThinPlate):
        return
    largest = draw(scene, require_seed(seed), 0).inelasticity.max(initial=0.0)
    if largest > INELASTICITY_LIMIT:
        warn(
            f"{scene.name}: lambda of the thin plate reaches {largest:.3g}, Zener's theory is valid up to "
            f"{INELASTICITY_LIMIT:g}: {BEYOND_THIN_PLATE}"
        )


def _write_table(synthesis_plan: Any, options: dict[str, Any]) -> None:
    from cgid.scene.output.generation import tabulate

    n_signals, start = options["n_signals"], time.perf_counter()
    taken = ("output", "n_signals", "seed", "overwrite")
    with progress_bar(n_signals, "signals", "generating") as progress:
        written = tabulate(synthesis_plan, progress=progress, **{name: options[name] for name in taken})
    seconds = time.perf_counter() - start
    say(
        f"{written.path}: {synthesis_plan.kind} of {counted(n_signals, 'signal')} in {seconds:.1f} s: "
        f"{n_signals / seconds:.0f} signals/s",
        err=True,
    )
    if written.n_unmeasured:
        of = f"{written.n_unmeasured} of {counted(n_signals, 'signal')}"
        warn(f"{written.path}: {of} cannot be measured and are nan")


def _explain(synthesis_plan: Any, n_signals: int, as_json: bool) -> None:
    """Print the plan: a line for each stage, and the bytes of all signals."""
    if n_signals < 1:
        raise InvalidValue(f"n_signals must be 1 or more, got {n_signals}")
    size, noun = synthesis_plan.signal_bytes, "signal" if synthesis_plan.scene.stream is None else "recording"
    if as_json:
        print_json(
            {
                "scene": synthesis_plan.scene.name,
                "output": synthesis_plan.kind,
                "stages": [{"name": name, **decision._asdict()} for name, decision in synthesis_plan.decisions.items()],
                f"bytes_per_{noun}": size,
                f"{noun}s": n_signals,
                "bytes": size * n_signals,
            }
        )
        return
    say(f"{synthesis_plan.scene.name}: {synthesis_plan.kind}")
    say(f"{'stage':<23}{'':<9}{'error':>9}  why")
    for name, decision in synthesis_plan.decisions.items():
        say(f"{name:<23}{'run' if decision.runs else 'skipped':<9}{decision.error_bound:>9.2g}  {decision.why}")
    say(f"{counted(n_signals, noun)}: {size} bytes each, {size * n_signals / 1e6:.4g} MB")


def _require_recordings(scene: Any, options: dict[str, Any]) -> None:
    """Raise `InvalidValue` for options that do not apply to recordings."""
    for name, default in _OF_MANY.items():
        if options[name] != default:
            said = "--jobs" if name == "jobs" else name
            raise InvalidValue(f"{said} is for datasets, scene {scene.name} is a stream of recordings; leave it out")


def _make_recordings(scene: Any, output: str, n_signals: int, **options: Any) -> None:
    from cgid.scene import generate_recordings
    from cgid.scene.file.schema import samples_of

    seconds = scene.stream.duration * n_signals
    start = time.perf_counter()
    with progress_bar(n_signals * samples_of(scene), "samples", "generating") as progress:
        path = generate_recordings(scene, output, n_signals, progress=progress, **options)
    took = time.perf_counter() - start
    say(f"{path}: {counted(n_signals, 'recording')}, {seconds:g} s in {took:.1f} s", err=True)
