"""What a scene contains: `cgid check`."""

from __future__ import annotations

from typing import Any

import click
import numpy as np

from cgid import shipped
from cgid.cli.help import Command
from cgid.cli.options import SCENE, json_option
from cgid.cli.output import print_json, say, warn, warn_of_one_place

#: Blocks of 256 impacts in the preview.
_BLOCKS = 16


@click.command(cls=Command, short_help="Validate a scene and preview its impacts.", example="cgid check reference")
@click.argument("scene", type=SCENE, required=False)
@click.option("--list", "as_list", is_flag=True, help="Print the names of the shipped scenes.")
@json_option
def check(scene: str | None, as_list: bool, as_json: bool) -> None:
    """Validate SCENE (a .toml file or the name of a shipped one), and preview 4096 of its impacts."""
    if as_list:
        texts = shipped.scene_descriptions()
        if as_json:
            print_json({"scenes": texts})
        for name, text in {} if as_json else texts.items():
            say(f"{name:<12}{text}")
        return
    if scene is None:
        raise click.UsageError("give a SCENE, or --list for the shipped ones")
    from cgid.scene import load_scene, plan
    from cgid.scene.synthesis.noise import background_of

    loaded = load_scene(scene)
    warn_of_one_place(loaded)
    background_of(loaded)  # raises if its recording cannot be read
    preview = _preview(loaded, scene in shipped.SCENES)
    if loaded.stream is not None:
        preview |= _stream(loaded)
    if as_json:
        print_json(preview)
        return
    say(f"{preview['name']}: {preview['description']}")
    say(f"scene SHA-256: {preview['scene_sha256']}")
    drawn = preview["randomised"]
    rate = "a drawn rate" if "sampling_rate [Hz]" in drawn else f"{loaded.sampling.sampling_rate:g} Hz"
    samples = loaded.sampling.samples
    if loaded.stream is None:
        say(f"frames: {samples} samples at {rate}, {samples * 4} bytes per signal in float32")
    else:
        summary = ", ".join(f"{name} {value:.6g}" for name, value in preview["stream"].items())
        say(f"recording at {rate}: {summary}")
    if preview["tail_beam"]:
        say("tail beam: " + ", ".join(f"{name} {value:.4g}" for name, value in preview["tail_beam"].items()))
    if loaded.sensor.coloured:
        synthesis_plan = plan(loaded, "frames" if loaded.stream is None else "recordings")
        say(f"noise: {synthesis_plan.decisions['noise'].why}")
    for name, (low, high) in drawn.items():
        say(f"drawn for each block of 256 signals: {name} {low:g} to {high:g}")
    say("share of the labels: " + ", ".join(f"{k} {v:.3f}" for k, v in preview["labels"].items()))
    for name, (low, middle, high) in preview["quantiles_5_50_95"].items():
        say(f"{name:<28} 5 % {low:>11.4g}   median {middle:>11.4g}   95 % {high:>11.4g}")
    for text, share in preview["remarks"].items():
        say(f"note: {share:.2%} of the impacts {text}")
    for text, share in preview["warnings"].items():
        warn(f"{share:.2%} of the impacts {text}")


def _preview(scene: Any, is_shipped: bool) -> dict[str, Any]:
    from cgid.scene.synthesis.draws import BLOCK, parameter_units
    from cgid.scene.synthesis.impacts import draw

    draws = [draw(scene, 0, block) for block in range(_BLOCKS)]
    units = parameter_units(scene)
    if scene.stream is not None:
        del units["onset"]  # it belongs to a frame
    values = {name: np.concatenate([d.parameters[name] for d in draws]) for name in units}
    sampling_rate = np.repeat([d.scene.sampling.sampling_rate for d in draws], BLOCK)
    labels, counts = np.unique(np.concatenate([d.labels for d in draws]), return_counts=True)
    rows = {f"{name} [{unit}]": values[name] for name, unit in units.items()}
    rows["samples on the contact"] = values["contact_duration"] * sampling_rate
    known = {name: column[np.isfinite(column)] for name, column in rows.items()}
    shares = _shares(draws, values, sampling_rate, scene)
    return {
        "name": scene.name,
        "description": scene.description,
        "scene_sha256": scene.sha256,
        "randomised": _randomised(scene),
        "tail_beam": _tail_beam(scene),
        "labels": dict(zip(labels.tolist(), (counts / counts.sum()).tolist(), strict=True)),
        "quantiles_5_50_95": {
            name: np.quantile(column, [0.05, 0.5, 0.95]).tolist() for name, column in known.items() if column.size
        },
        # In shipped scenes it is intended, and needs no cure.
        "remarks": {what: share for (what, _), share in shares.items() if is_shipped},
        "warnings": {"; ".join(filter(None, text)): share for text, share in shares.items() if not is_shipped},
    }


def _tail_beam(scene: Any) -> dict[str, float]:
    """Return the facts about a scene's tail beam; empty without one."""
    from cgid.scene.synthesis.impacts import beam_modes, placed_shapes

    if scene.tail_beam is None:
        return {}
    frequency = beam_modes(scene).frequency
    summary = {"modes": float(frequency.size), "lowest [Hz]": frequency[0], "highest [Hz]": frequency[-1]}
    if scene.tail_beam.shapes is not None:
        left = placed_shapes(scene.tail_beam.modes, scene.tail_beam.shapes).unpredicted
        summary |= {
            "places": float(len(scene.tail_beam.shapes)),
            "median share of a shape that other places do not predict": float(np.median(left)),
        }
    if scene.panel is None:
        return summary
    summary |= {"mass [kg]": scene.panel.mass, "impedance [kg/s]": scene.panel.impedance}
    if scene.panel.ribs is not None:
        summary["ribs may be smeared up to [Hz]"] = scene.panel.highest_smeared_frequency
    return summary


def _randomised(scene: Any) -> dict[str, tuple[float, float]]:
    """Return the smallest and largest value of each quantity sampled per block."""
    if scene.randomise is None:
        return {}
    from cgid.scene.synthesis.draws import RANDOMISED_UNITS

    units = {"sampling_rate": "Hz"} | RANDOMISED_UNITS
    return {f"{name} [{units[name]}]": law.extremes for name, law in scene.randomise.laws.items()}


def _shares(draws: list[Any], values: dict[str, Any], sampling_rate: Any, scene: Any) -> dict[tuple[str, str], float]:
    """Return the fraction of the pulses that each warning concerns, a fact and what helps, unless it is none."""
    from cgid.measure.features.pulses import RECOMMENDED_SAMPLES
    from cgid.physics.contact.bodies import MAX_RADIUS
    from cgid.physics.contact.impact import BEYOND_THIN_PLATE, HERTZ_LIMIT, INELASTICITY_LIMIT

    strain = np.concatenate([d.strain for d in draws])
    inelasticity = np.concatenate([d.inelasticity for d in draws])
    end = values.get("onset", 0.0) + np.nan_to_num(values.get("second_hit_delay", 0.0)) + values["contact_duration"]
    beyond = {
        (f"have a radius above {MAX_RADIUS:g} m, larger than any rock", "if it is in mm, give it as '25 mm'"): (
            values["radius"] > MAX_RADIUS
        ),
        (f"exceed Hertz's range (displacement over radius above {HERTZ_LIMIT:g})", ""): strain > HERTZ_LIMIT,
        (f"exceed the range of the thin plate (lambda above {INELASTICITY_LIMIT:g}): {BEYOND_THIN_PLATE}", ""): (
            inelasticity > INELASTICITY_LIMIT
        ),
        (f"have fewer than {RECOMMENDED_SAMPLES} samples on the contact", "raise sampling_rate"): (
            (values["contact_duration"] * sampling_rate < RECOMMENDED_SAMPLES) & (scene.sensor.quantity == "force")
        ),
        ("last beyond the end of the frame and are cut off", "raise samples"): (
            (end * sampling_rate > scene.sampling.samples - 1) & (scene.stream is None)
        ),
    }
    if scene.panel is not None and scene.panel.ribs is not None:
        limit = scene.panel.highest_smeared_frequency
        short = (
            f"are so short (over 1/{limit:.4g} Hz) that ribs may not be smeared: between two the skin gives way more "
            "than this beam does, on one less"
        )
        beyond[short, ""] = values["contact_duration"] * limit < 1
    return {text: float(np.sum(passed) / end.size) for text, passed in beyond.items() if np.any(passed)}


def _stream(scene: Any) -> dict[str, Any]:
    """Return the contents of a scene with a stream, and its label fractions over the recording."""
    from cgid.scene.file.schema import samples_of
    from cgid.scene.output.recordings import require_capacity
    from cgid.scene.synthesis.noise import background_of
    from cgid.scene.synthesis.rocks import arrivals_of, population_shares

    require_capacity(scene, "float32")
    background, duration = background_of(scene), scene.stream.duration
    noise = scene.sensor.noise_level(np.zeros(()), scene.sampling.sampling_rate)
    # The mixture over time, weighted by the arrival rate of the rocks.
    times = (np.arange(1000) + 0.5) / 1000 * duration
    expected = arrivals_of(scene.stream).expected(np.linspace(0, duration, 1001))
    shares = population_shares(scene, times) @ np.diff(expected) / max(expected[-1], 1e-300)
    labels = dict.fromkeys(scene.labels, 0.0)
    for population, share in zip(scene.populations, shares.tolist(), strict=True):
        labels[population.label] += share
    return {
        "labels": labels,
        "stream": {
            "duration [s]": duration,
            "samples": samples_of(scene),
            "rocks expected": float(expected[-1]),
            f"noise [{scene.sensor.unit}]": float(noise),
            f"background [{scene.sensor.unit}]": 0.0 if background is None else background.rms,
        },
    }
