"""`cgid check`: whether a scene is sound, and what it would make."""

from __future__ import annotations

from typing import Any

import click

from cgid.cli.options import print_json

#: Blocks of 256 impacts that are drawn for the preview.
_BLOCKS = 16


@click.command(short_help="Validate a scene and say what it would make.")
@click.argument("scene")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="One JSON object.")
def check(scene: str, seed: int, as_json: bool) -> None:
    """Validate SCENE (a .toml file or the name of a shipped one), and preview 4096 of its impacts."""
    from cgid import shipped
    from cgid.scene import load_scene

    loaded = load_scene(shipped.scene_path(scene))
    preview = _preview(loaded, seed)
    if as_json:
        print_json(preview)
        return
    click.echo(f"{preview['name']}: {preview['description']}")
    click.echo(f"scene SHA-256: {preview['scene_sha256']}")
    click.echo(
        f"frames: {loaded.sampling.samples} samples at {loaded.sampling.sampling_rate:g} Hz, "
        f"{loaded.sampling.samples * 4} bytes a signal in float32"
    )
    click.echo("share of the labels: " + ", ".join(f"{k} {v:.3f}" for k, v in preview["labels"].items()))
    for name, (low, middle, high) in preview["quantiles_5_50_95"].items():
        click.echo(f"{name:<28} 5 % {low:>11.4g}   median {middle:>11.4g}   95 % {high:>11.4g}")
    for text, share in preview["warnings"].items():
        click.echo(f"cgid: warning: {share:.2%} of the impacts {text}", err=True)


def _preview(scene: Any, seed: int) -> dict[str, Any]:
    import warnings

    import numpy as np

    from cgid.impact.pulse import HERTZ_LIMIT, HertzRangeWarning
    from cgid.pulses import WANTED_SAMPLES
    from cgid.scene.population import PARAMETER_UNITS, draw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HertzRangeWarning)
        draws = [draw(scene, seed, block) for block in range(_BLOCKS)]
    values = {name: np.concatenate([d.parameters[name] for d in draws]) for name in PARAMETER_UNITS}
    labels, counts = np.unique(np.concatenate([d.labels for d in draws]), return_counts=True)
    strain = np.concatenate([d.impact.peak_displacement / d.impact.reduced_radius for d in draws])
    sampling = scene.sampling
    on_contact = values["contact_duration"] * sampling.sampling_rate
    end = values["onset"] + values["contact_duration"]
    shares = {
        f"pass Hertz's range (displacement over radius above {HERTZ_LIMIT:g})": np.mean(strain > HERTZ_LIMIT),
        f"have fewer than {WANTED_SAMPLES} samples on the contact; raise sampling_rate": np.mean(
            on_contact < WANTED_SAMPLES
        ),
        "last beyond the end of the frame and are cut off; raise samples": np.mean(
            end * sampling.sampling_rate > sampling.samples - 1
        ),
    }
    rows = {f"{name} [{unit}]": values[name] for name, unit in PARAMETER_UNITS.items()}
    rows["samples on the contact"] = on_contact
    return {
        "name": scene.name,
        "description": scene.description,
        "scene_sha256": scene.sha256,
        "labels": dict(zip(labels.tolist(), (counts / counts.sum()).tolist(), strict=True)),
        "quantiles_5_50_95": {
            name: np.quantile(column, [0.05, 0.5, 0.95]).tolist()
            for name, column in rows.items()
            if np.isfinite(column).all()
        },
        "warnings": {text: float(share) for text, share in shares.items() if share > 0},
    }
