"""Every kind of bad input as one case: arguments, expected exit code, expected text of the error line.

`tests/test_cli.py` runs them; `python -m tests.bad_input` prints them as a table with the messages.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from scipy.io import wavfile

from cgid import shipped
from cgid.identification.model import Model
from cgid.identification.training import train
from cgid.measure.modes import LEARNED_COLUMNS
from cgid.scene import generate, load_scene, parse_scene, synthesise
from cgid.scene.generation import tabulate
from cgid.scene.plan import plan
from tests.bad_recordings import RECORDING_CASES, make_recordings
from tests.hostile_models import beam_arrays, wide_model, with_beam, written

ROOT = Path(__file__).parents[1]
RATE = 2e5
_COAL = 'label = "coal"'
_PRESSURE = 'yield_pressure = "41 MPa"'


@dataclass(frozen=True)
class Case:
    """One bad input."""

    name: str
    arguments: tuple[str, ...]
    exit_code: int
    says: tuple[str, ...]


def pulse(n_samples: int = 1000, duration: float = 5e-4, rate: float = RATE) -> np.ndarray:
    """Return a clean pulse of 9 kN in a frame with a little noise [N]."""
    times = np.arange(n_samples) / rate
    force = 9e3 * np.sin(np.pi * np.clip((times - 0.3 * n_samples / rate) / duration, 0, 1)) ** 1.5
    return force + np.random.default_rng(0).normal(0, 20, n_samples)


def _csv(path: Path, samples: np.ndarray, header: str = f"# sampling_rate: {RATE:g} Hz\nforce (N)\n") -> None:
    path.write_text(header + "".join(f"{value:.3f}\n" for value in samples))


def _scene(path: Path, change: Callable[[str], str], scene: str = "reference") -> None:
    path.write_text(change((ROOT / "datasets" / f"{scene}.toml").read_text()))


def _crushing(text: str) -> str:
    """Return a scene whose rocks crush."""
    text = text.replace('"hunt-crossley"', '"thornton"')
    return re.sub(r"(?m)^restitution = .*$", _PRESSURE, text)


def _viscous(text: str) -> str:
    """Return a scene of viscoelastic rocks."""
    return text.replace('"hunt-crossley"', '"kuwabara-kono"')


def _changed(folder: Path, scene: str, changes: dict[str, tuple[str, str]]) -> None:
    """Write copies of a shipped scene, each with one replacement; the replaced text must exist."""
    text = (ROOT / "datasets" / f"{scene}.toml").read_text()
    for name, (old, new) in changes.items():
        assert old in text, name
        (folder / f"{name}.toml").write_text(text.replace(old, new, 1))


def _tables(folder: Path) -> None:
    """Write tables of modes, good and bad, and a scene for each."""
    text = (ROOT / "datasets" / "tail_beam.toml").read_text()
    start = text.index("[tail_beam]")
    stop = text.index("[sampling]")
    for name, rows in _TABLES.items():
        (folder / f"{name}.csv").write_text(rows)
        beam = f'[tail_beam]\nmodes = "{name}.csv"\n\n'
        (folder / f"{name}.toml").write_text(text[:start] + beam + text[stop:])
    good = (folder / "modes.toml").read_text()
    (folder / "device.toml").write_text(good.replace("modes.csv", "/dev/null"))
    (folder / "no_table.toml").write_text(good.replace("modes.csv", "gone.csv"))
    (folder / "endless.toml").write_text(good.replace('"modes.csv"', '"modes.csv"\ncoupling = "impedance"'))
    (folder / "both.toml").write_text(good.replace('"modes.csv"', '"modes.csv"\nlength = "1.6 m"'))
    (folder / "beamless.toml").write_text(text[:start] + text[stop:])
    title = ",".join(f"{name} [{unit}]" for name, unit in LEARNED_COLUMNS.items())
    for name, row in {"learned": "110,0.02,1,1e-4,1e-3,0", "unsure": "110,0.02,1,-1,1e-3,0"}.items():
        (folder / f"{name}_modes.csv").write_text(f"{title}\n{row}\n")
        beam = f'[tail_beam]\nlearned = "{name}_modes.csv"\n'
        (folder / f"{name}.toml").write_text(text.replace("[tail_beam]\n", beam, 1))


def _ringing(folder: Path) -> None:
    """Write what cannot be calibrated: recordings of few blows, clipped throughout, of another beam; scenes of taps."""
    title = "frequency [Hz],damping_ratio [1],modal_mass [kg],shape_impact [1],shape_sensor [1]"
    beam = re.compile(r"\[tail_beam\]\n.*?(?=\n\[)", re.DOTALL)
    for name, scale, sensor in (("taps", 1, [0.6] * 4), ("taps_on_node", 1, [0.6, 0, 0, 0]), ("fast", 100, [0.6] * 4)):
        rows = [f"{scale * f},0.02,200,0.8,{at}" for f, at in zip((210, 340, 560, 905), sensor, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join([title, *rows]) + "\n")
        text = shipped.scene_path("tail_beam").read_text()
        (folder / f"{name}.toml").write_text(beam.sub(f'[tail_beam]\nmodes = "{name}.csv"\n', text))
    rng, times = np.random.default_rng(7), np.arange(2560) / 25600
    blow = 90 * np.exp(-60 * times) * np.sin(2 * np.pi * 300 * times) * (times < 0.09)
    for name, n, limit in (("few_blows", 5, 100.0), ("clipped_blows", 30, 6.0), ("other_beam", 24, 100.0)):
        samples = np.concatenate([np.zeros(2560), *[blow, 0 * blow] * n]) + rng.normal(0, 0.5, 2560 * (2 * n + 1))
        _csv(
            folder / f"{name}.csv",
            np.clip(samples, -limit, limit),
            "# sampling_rate: 25600 Hz\nacceleration (m/s^2)\n",
        )


def _tapped(folder: Path) -> None:
    """Write recordings of taps on a beam: none that is usable, and a good one with nan and a table of taps."""
    rng, times = np.random.default_rng(11), np.arange(12_800) / 25600
    ring = 90 * np.exp(-12 * times) * np.sin(2 * np.pi * 300 * times)
    ring += 60 * np.exp(-60 * times) * np.sin(2 * np.pi * 2300 * times)
    quiet, head = 0 * times[:2560], "# sampling_rate: 25600 Hz\nacceleration (m/s^2)\n"
    double = np.concatenate([ring[:1280], ring[:1280], ring[:200]])
    made = {
        "two_taps": [quiet, ring, ring],
        "silent_taps": [quiet, quiet, 0 * ring],
        "double_taps": [quiet, double],
        "clipped_taps": [quiet, np.clip(ring, -20, 20), np.clip(ring, -20, 20)],
        "short_taps": [quiet, quiet, ring[:500]],
    }
    for name, parts in made.items():
        samples = np.concatenate(parts)
        limit = 20.0 if name == "clipped_taps" else 1e9
        _csv(folder / f"{name}.csv", np.clip(samples + rng.normal(0, 0.02, samples.size), -limit, limit), head)
    _csv(folder / "nan_taps.csv", np.append(samples, np.nan), head)
    (folder / "tap_times.csv").write_text("time [s]\n7.5\n")
    (folder / "tap_table.csv").write_text("when\n7.5\n")


def _spectra(folder: Path) -> None:
    """Write scenes whose noise has a colour that is none, by itself or by its table."""
    for name, sensor in _COLOURS.items():
        _scene(folder / f"{name}.toml", lambda text, sensor=sensor: text.replace("relative_noise = 0.01", sensor))
    for name, rows in _SPECTRA.items():
        (folder / f"{name}.csv").write_text(rows)
        sensor = f'relative_noise = 0.01\nnoise_spectrum = "{name}.csv"'
        _scene(folder / f"{name}.toml", lambda text, sensor=sensor: text.replace("relative_noise = 0.01", sensor))


def make_files(folder: Path) -> None:
    """Write the bad files, and good ones for wrong uses."""
    good = pulse()
    _csv(folder / "good.csv", good)
    (folder / "empty.csv").write_bytes(b"")
    (folder / "junk.csv").write_bytes(np.random.default_rng(1).bytes(4000))
    (folder / "truncated.wav").write_bytes(b"RIFF\xff\xff\x00\x00WAVEfmt \x10\x00\x00\x00\x01\x00")
    np.save(folder / "whole.npy", good)
    (folder / "truncated.npy").write_bytes((folder / "whole.npy").read_bytes()[:3000])
    for name, bad in (("nan", np.nan), ("inf", np.inf)):
        samples = good.copy()
        samples[17] = bad
        _csv(folder / f"{name}.csv", samples)
    _csv(folder / "noise.csv", np.random.default_rng(2).normal(0, 20, 2000))
    _csv(folder / "constant.csv", np.full(500, 3.0))
    _csv(folder / "few.csv", pulse(200, 1e-4, 2e4), "# sampling_rate: 20000 Hz\nforce (N)\n")
    _csv(folder / "no_rate.csv", good, "force (N)\n")
    _csv(folder / "no_unit.csv", good, "# sampling_rate: 200000 Hz\n")
    _csv(folder / "acceleration.csv", good / 9.81, "# sampling_rate: 200000 Hz\nacceleration (g)\n")
    _csv(folder / "downwards.csv", -good)
    _csv(folder / "cut_off.csv", good[: 300 + 40])
    _manifests(folder, good)
    (folder / "text.npz").write_text("no model")
    shutil.copy(shipped.path_of("models", shipped.DEFAULT_MODEL), folder / "model.npz")
    default = Model.load(folder / "model.npz")
    (folder / "acceleration.npz").write_bytes(replace(default, unit="m/s^2").to_bytes())
    _old_model(folder / "old.npz", default)
    (folder / "wide.npz").write_bytes(wide_model().to_bytes())
    _beam_models(folder, good)
    scene = load_scene(ROOT / "datasets" / "reference.toml")
    knowing = train(synthesise(scene, 600), features=["peak_force", "width_50"], known=["drop_height"])
    (folder / "height.npz").write_bytes(knowing.model.to_bytes())
    few = train(synthesise(scene, 200), features=["peak_force", "width_50"])
    (folder / "uncalibrated.npz").write_bytes(few.model.to_bytes())
    _scene(folder / "reference.toml", lambda text: text)
    _scene(
        folder / "zero.toml", lambda text: text.replace("lowest = 0.1, highest = 0.8", "lowest = 0.0, highest = 0.8")
    )
    _scene(
        folder / "high.toml", lambda text: text.replace("lowest = 0.1, highest = 0.9", "lowest = 0.1, highest = 1.2")
    )
    _scene(folder / "negative.toml", lambda text: text.replace('mean = "1400 kg/m^3"', 'mean = "-1400 kg/m^3"'))
    _scene(folder / "stranger.toml", lambda text: text.replace('label = "coal"', 'label = "unknown"'))
    _scene(folder / "unknown.toml", lambda text: text.replace("jitter", "jittter"))
    _scene(folder / "unit.toml", lambda text: text.replace("3.1 GPa", "3.1 GHz"))
    _scene(folder / "shape.toml", lambda text: f"{text}[[taps]]\n{_TAP.replace('square', 'saw')}")
    _scene(folder / "tap.toml", lambda text: f"{text}[[taps]]\n{_TAP.replace('2 ms', '-2 ms')}")
    _scene(folder / "second.toml", lambda text: f'{text}second_hit = {{ delay = "2 mm", ratio = 0.5 }}\n')
    _scene(folder / "clipped.toml", lambda text: f"{text}clipped_at = 1.5\n")
    _scene(folder / "nothing.toml", lambda text: text.replace("[sensor]", "[randomise]\n[sensor]"))
    _scene(folder / "rates.toml", lambda text: text.replace("[sensor]", f"[randomise]\n{_RATES}\n[sensor]"))
    _scene(folder / "sheet.toml", lambda text: text.replace("= 0.30 }", '= 0.30, thickness = "5 mm" }'))
    _scene(folder / "uncrushed.toml", lambda text: _crushing(text).replace(_PRESSURE, "", 1))
    _scene(folder / "soft.toml", lambda text: _crushing(text).replace(_PRESSURE, "yield_pressure = 0", 1))
    for _, file, (key, value), _ in _OF_CRUSHING:
        line = f"{key} = {value}"
        _scene(folder / f"{file}.toml", lambda text, line=line: _crushing(text).replace(_PRESSURE, line, 1))
    _scene(folder / "viscous_fall.toml", lambda text: _viscous(text).replace('law = "exact"', "gravity = 9.81"))
    _scene(folder / "viscous_beam.toml", _viscous, "tail_beam")
    _scene(folder / "fallen.toml", lambda text: _crushing(text).replace('law = "exact"', "gravity = 9.81"))
    _scene(folder / "crushed_beam.toml", _crushing, "tail_beam")
    (folder / "old.png").write_bytes(b"mine")
    (folder / "old.html").write_bytes(b"mine")
    make_recordings(folder)
    _scene(folder / "toml.toml", lambda text: text.replace("[impact]", "[impact"))
    _scene(folder / "dotted.toml", lambda text: f"a{'.a' * 2000} = 1\n{text}")
    _scene(folder / "keys.toml", lambda text: text + "".join(f"[k{number}]\n" for number in range(100_000)))
    _scene(folder / "line.toml", lambda text: f'"a\\nb{"c" * 1000}" = 1\n{text}')
    _scene(
        folder / "three.toml",
        lambda text: text.replace("3.1 GPa", "3 s").replace("jitter", "jittter").replace("relative_noise", "noise"),
    )
    _changed(folder, "tail_beam", _BEAMS)
    _changed(folder, "caving", _STREAMS)
    _changed(folder, "reference", {"range": ("[sensor]", '[sensor]\nrange = "500 g"')})
    _changed(folder, "reference", {file: (_COAL, f"{_COAL}\n{line}") for _, file, line, _ in _OF_ROCKS})
    _tables(folder)
    _ringing(folder)
    _tapped(folder)
    _spectra(folder)
    tabulate(plan(load_scene(ROOT / "datasets" / "reference.toml"), "closed-form"), folder / "table.csv", 9)
    lines = (folder / "table.csv").read_text().splitlines()
    (folder / "damaged_table.csv").write_text("\n".join([*lines[:6], lines[6] + ",7", *lines[7:]]))
    one = parse_scene(_one_label())
    generate(one, folder / "one.h5", 64)
    two = _one_label()
    two["populations"] = [two["populations"][0], {**two["populations"][0], "label": "gangue", "density": 2400}]
    generate(parse_scene(two), folder / "two.h5", 64)
    (folder / "truncated.h5").write_bytes((folder / "two.h5").read_bytes()[:20000])
    for name in ("loop", "loop.h5", "loop.npz"):
        (folder / name).symlink_to(name)
    (folder / "unfinished").mkdir()
    shutil.copy(folder / "two.h5", folder / "unfinished" / "shard-00000.h5")
    shutil.copy(folder / "two.h5", folder / "tagged.h5")
    with h5py.File(folder / "tagged.h5", "r+") as file:
        file["labels"][:5] = b"<b>"


#: Calibrates the tail beam with few blows.
_TAPPED = ("tap", "two_taps.csv", "-o", "new.csv")
_CALIBRATE = ("calibrate", "few_blows.csv", "--scene", "tail_beam", "-o", "new.toml")
_TAP = 'label = "tap"\nshape = "square"\npeak_force = "1 kN"\ncontact_duration = "2 ms"\n'
_RATES = 'sampling_rate = { distribution = "uniform", lowest = "50 kHz", highest = "90 kHz" }'
#: What is wrong with the first rocks of `reference`: a line for each scene file, and the text of its error.
_OF_ROCKS = (
    ("corner of no radius", "pointed", "curvature = 0", ("populations.0.curvature", "0.001 and 10", "got 0")),
    ("negative curvature", "hollow", "curvature = -0.5", ("populations.0.curvature", "0.001 and 10", "got -0.5")),
    ("curvature nan", "nowhere", "curvature = nan", ("populations.0.curvature", "finite")),
    ("curvature in mm", "measured", 'curvature = "3 mm"', ("populations.0.curvature", "3 mm", "%")),
    (
        "side too flat",
        "flat",
        'curvature = { distribution = "uniform", lowest = 0.5, highest = 20.0 }',
        ("populations.0.curvature", "0.001 and 10", "can be drawn as 20", "lowest and highest"),
    ),
    ("blow of no mass", "massless", "effective_mass = 0", ("populations.0.effective_mass", "0.01 and 1", "got 0")),
    ("more than all mass", "massive", "effective_mass = 1.2", ("populations.0.effective_mass", "0.01 and 1", "1.2")),
    ("effective mass nan", "weighty", "effective_mass = nan", ("populations.0.effective_mass", "finite")),
    ("strength of damped rocks", "strong", 'strength = "16 MPa"', ("populations.0.strength", "hunt-crossley")),
    ("pressure of damped rocks", "pressed", 'yield_pressure = "41 MPa"', ("populations.0.yield_pressure", "left out")),
    ("viscous twice", "damped_twice", "viscous_restitution = 0.5", ("viscous_restitution", "give restitution")),
    ("rocks of weight 0", "rare", "weight = 0", ("populations.0.weight", "got 0")),
    ("rocks of negative weight", "rarer", "weight = -1.0", ("populations.0.weight", "got -1")),
    ("rocks of weight nan", "uncertain", "weight = nan", ("populations.0.weight", "finite", "nan")),
    ("unknown loss", "lost", 'dissipation = "thorton"', ("populations.0.dissipation", "did you mean 'thornton'")),
)
#: The same for the first rocks of a scene that crushes: the key and its value, and the text of the error.
_OF_CRUSHING = (
    ("negative yield pressure", "sucking", ("yield_pressure", '"-4 MPa"'), ("'-4 MPa'",)),
    ("yield pressure nan", "vague", ("yield_pressure", "nan"), ("finite",)),
    ("yield pressure in N", "forced", ("yield_pressure", '"4 N"'), ("'4 N'", "GPa")),
    ("strength 0", "crumbling", ("strength", "0"), ("got 0 Pa",)),
    ("negative strength", "weak", ("strength", "-1e6"), ("-1e+06 Pa",)),
    ("strength nan", "foggy", ("strength", "nan"), ("finite",)),
    (
        "strength that can be drawn as nothing",
        "normal",
        ("strength", '{ distribution = "normal", mean = "16 MPa", deviation = "8 MPa" }'),
        ("can be drawn as -", "lowest and highest"),
    ),
    (
        "viscous crushing",
        "crushed_both",
        ("restitution", f"0.5\n{_PRESSURE}"),
        ("thornton", "give viscous_restitution"),
    ),
    (
        "viscous restitution 0",
        "crushed_dead",
        ("viscous_restitution", f"0\n{_PRESSURE}"),
        ("between 0.05 and 1", "got 0"),
    ),
    ("viscous gain", "crushed_lively", ("viscous_restitution", f"1.2\n{_PRESSURE}"), ("between 0.05 and 1", "got 1.2")),
    ("viscous restitution nan", "crushed_vague", ("viscous_restitution", f"nan\n{_PRESSURE}"), ("finite",)),
    ("viscous restitution in mm", "crushed_mm", ("viscous_restitution", f'"5 mm"\n{_PRESSURE}'), ("5 mm", "%")),
    (
        "strength and yield pressure",
        "strength_twice",
        ("strength", f'"16 MPa"\n{_PRESSURE}'),
        ("beside yield_pressure",),
    ),
)
_BEAMS = {
    "sensor_off": ('sensor_point = { x = "0.5 m"', 'sensor_point = { x = "2.5 m"'),
    "impact_off": ('highest = "1.5 m"', 'highest = "1.7 m"'),
    "undamped": ('damping_ratio = "2 %"', "damping_ratio = 0"),
    "driven": ('damping_ratio = "2 %"', 'damping_ratio = "-2 %"'),
    "stud": ('"25 kHz", damping_ratio = 0.05', '"25 kHz", damping_ratio = 0'),
    "ribs": ('thickness = "25 mm"', 'thickness = "250 mm"'),
    "edges": ('"cantilever"', '"floating"'),
    "skinless": ('thickness = "30 mm"\n', ""),
    "nyquist": ('anti_alias = { frequency = "10 kHz"', 'anti_alias = { frequency = "13 kHz"'),
    "band": ('anti_alias = { frequency = "10 kHz", order = 8 }', 'bandwidth = "13 kHz"'),
    "two_filters": ("bits = 16", 'bits = 16\nbandwidth = "10 kHz"'),
    "two_plates": ("poisson_ratio = 0.30 }", 'poisson_ratio = 0.30, thickness = "30 mm" }'),
    "wall": (
        'target = { density = "7850 kg/m^3", youngs_modulus = "210 GPa", poisson_ratio = 0.30 }',
        'target = "rigid"',
    ),
    "heavy": ('law = "exact"', 'law = "exact"\ngravity = "1 g"'),
    "newton": ('range = "500 g"', 'range = "500 kN"'),
    "step": ('range = "500 g"\n', ""),
    "deaf": ("bits = 16", "bits = 16\ngain = 0"),
    "modes_too_many": ('"10 kHz", order = 8 }', '"10 kHz", order = 1 }'),
    "hum_device": (
        "[sampling]",
        '[background]\nrecorded = { path = "/dev/null", signal_to_noise = "20 dB" }\n[sampling]',
    ),
    "hum_missing": (
        "[sampling]",
        '[background]\nrecorded = { path = "gone.wav", signal_to_noise = "20 dB" }\n[sampling]',
    ),
}
_STREAMS = {
    "caving": ("", ""),
    "crowd": ('rate = "8 Hz"', 'rate = "1 MHz"'),
    "beyond": ('rate = "8 Hz"', 'rate = "1000 MHz"'),
    "long": ('duration = "60 s"', 'duration = "20 h"'),
    "framed": ('sampling_rate = "25.6 kHz"', 'sampling_rate = "25.6 kHz"\nsamples = 2048'),
    "twice": ('rate = "8 Hz"', 'rate = "8 Hz", times = ["1 s"]'),
    "late": ('rate = "8 Hz"', 'times = ["70 s"]'),
    "whole": ("0.90]", "1.2]"),
    "row": (", 0.90]", "]"),
    "granite": ("gangue = [", "granite = ["),
    "hum": ('"297 Hz"', '"20 kHz"'),
    "hum_unit": ('"0.05 g"', '"0.05 N"'),
    "coloured": ('"2 kHz"]', '"20 kHz"]'),
    "steep": ('"20 deg"', '"95 deg"'),
    "relative_hum": ('amplitude = "0.05 g"', "relative_amplitude = 0.1"),
    "relative_range": ('range = "500 g"', "relative_range = 2"),
    "relative": ("bits = 24", "bits = 24\nrelative_noise = 0.1"),
}
_COLOURS = {
    "blacker": "relative_noise = 0.01\nnoise_exponent = 3",
    "levelless": "noise_exponent = 1",
    "two_colours": (
        "relative_noise = 0.01\nnoise_exponent = 1\n"
        "noise_spectrum = { frequencies = [50, 100e3], density = [1.0, 1.0] }"
    ),
    "white_density": 'noise_density = "1 N/sqrt(Hz)"\nnoise_exponent = 1',
    "no_spectrum": 'relative_noise = 0.01\nnoise_spectrum = "gone.csv"',
    "spectrum_device": 'relative_noise = 0.01\nnoise_spectrum = "/dev/null"',
    "two_ranges": 'relative_noise = 0.01\nrange = "9 kN"\nrelative_range = 2',
    "drawn_bits": "relative_noise = 0.01\n[randomise]\nbits = 12",
    "drawn_hum": 'relative_noise = 0.01\n[randomise]\nhum = 0.1\nhum_frequency = "200 kHz"',
    "drawn_blackness": (
        "relative_noise = 0.01\n[randomise]\n"
        'noise_exponent = { distribution = "mixed", parts = [{ distribution = "uniform", lowest = 0, highest = 4 }] }'
    ),
    "mixed_weights": (
        'relative_noise = 0.01\n[randomise]\nhum = { distribution = "mixed", parts = [0, 0.1], weights = [1] }'
    ),
    "two_amplitudes": (
        "relative_noise = 0.01\n[background]\n"
        'hum = [{ frequency = "50 Hz", amplitude = "2 N", relative_amplitude = "1 %" }]'
    ),
}
_SPECTRUM_HEAD = "frequency [Hz],density [V/sqrt(Hz)]\n"
_SPECTRA = {
    "narrow": _SPECTRUM_HEAD + "50,1\n20e3,1\n",
    "late_start": _SPECTRUM_HEAD + "500,1\n100e3,1\n",
    "backwards": _SPECTRUM_HEAD + "50,1\n40,1\n100e3,1\n",
    "silence": _SPECTRUM_HEAD + "50,1\n900,0\n100e3,1\n",
    "nan_density": _SPECTRUM_HEAD + "50,1\n900,nan\n100e3,1\n",
    "spectrum_gap": _SPECTRUM_HEAD + "50,1\n900\n100e3,1\n",
    "power_density": "frequency [Hz],density [V^2/Hz]\n50,1\n100e3,1\n",
    "one_row": _SPECTRUM_HEAD + "50,1\n",
    "empty_spectrum": "",
}
_HEAD = "frequency [Hz],damping_ratio [1],modal_mass [kg],shape_impact [1],shape_sensor [1]\n"
_TABLES = {
    "modes": _HEAD + "118.5,0.012,210,0.9,0.4\n187,0.010,180,0.3,-0.7\n",
    "unsorted": _HEAD + "187,0.010,180,0.3,-0.7\n118.5,0.012,210,0.9,0.4\n",
    "no_modes": _HEAD,
    "gap": _HEAD + "118.5,0.012,210,0.9,0.4\n187,0.010,180,0.3\n",
    "column": "frequency [Hz],damping_ratio [1],modal_mass [kg],shape_impact [1]\n118.5,0.012,210,0.9\n",
    "unitless": _HEAD.replace(" [Hz]", "") + "118.5,0.012,210,0.9,0.4\n",
    "ringing": _HEAD + "118.5,0,210,0.9,0.4\n",
    "weightless": _HEAD + "118.5,0.012,0,0.9,0.4\n",
    "ultrasound": _HEAD + "1e300,0.012,210,0.9,0.4\n",
    "still": _HEAD + "118.5,0.012,210,0.9,0\n187,0.010,180,0,-0.7\n",
}


def _manifests(folder: Path, good: np.ndarray) -> None:
    """Write manifests of labelled recordings, each with one fault."""
    _csv(folder / "twice.csv", np.concatenate([good, good]))
    (folder / "m_gone.csv").write_text("path,label\ngone.csv,coal\ngood.csv,gangue\n")
    (folder / "m_device.csv").write_text("path,label\n/dev/null,coal\n")
    (folder / "m_label.toml").write_text(
        'labels = ["coal", "gangue"]\n[[recording]]\npath = "good.csv"\nlabel = "cole"\n'
    )
    (folder / "m_group.csv").write_text("path,label,start,end\ntwice.csv,coal,0,0.005\ntwice.csv,gangue,0.005,\n")
    (folder / "m_both.csv").write_text("path,label\ngood.csv,coal\ngood.csv,gangue\n")
    (folder / "m_half.csv").write_text("path,start,end,label,peak\ngood.csv,0,1,,9\ntwice.csv,0,1,coal,9\nb.csv,,,,9\n")
    (folder / "m_outside.csv").write_text("path,start,end,label\ngood.csv,0,1,coal\ntwice.csv,7,8,gangue\n")
    (folder / "m_overlap.csv").write_text("path,start,end,label\ntwice.csv,0,0.004,coal\ntwice.csv,0.003,1,gangue\n")
    (folder / "m_shale.csv").write_text("path,label\ngood.csv,coal\ntwice.csv,shale\n")
    (folder / "m_same.csv").write_text("path,label\ngood.csv,coal\ntwice.csv,coal\n")
    for name in ("void", "papers", "loose", "junk/coal", "junk/gangue", "two_manifests"):
        (folder / name).mkdir(parents=True)
    header = f"# sampling_rate: {RATE:g} Hz\n"
    _csv(folder / "motion.csv", good, f"{header}motion (m/s^2)\n")
    rows = "".join(f"{value:.3f},{value:.3f}\n" for value in np.tile(good, 2))
    (folder / "pair.csv").write_text(f"{header}left (N),right (N)\n{rows}")
    intervals = "pair.csv,0,0.005,coal,{0}\npair.csv,0.005,1,gangue,{0}\n"
    for name, channel in (("m_pair", ""), ("m_together", "1+2")):
        (folder / f"{name}.csv").write_text("path,start,end,label,channel\n" + intervals.format(channel))
    wavfile.write(folder / "full_scale.wav", round(RATE), (good / 1e4).astype(np.float32))
    (folder / "papers" / "readme.md").write_text("nothing")
    _csv(folder / "loose" / "a.csv", good)
    for label in ("coal", "gangue"):
        (folder / "junk" / label / "a.wav").write_bytes(b"RIFF\xff\xff\x00\x00WAVEfmt \x10\x00\x00\x00\x01\x00")
    for name in ("manifest.csv", "events.csv"):
        (folder / "two_manifests" / name).write_text("path,label\na.wav,coal\n")


def _beam_models(folder: Path, good: np.ndarray) -> None:
    """Write a model that looks through a beam, one without the beam, one with a pole that grows, a slow recording."""
    (folder / "through.npz").write_bytes(with_beam())
    (folder / "pair.npz").write_bytes(with_beam(None, sensors=np.ones((2, 3))))
    model = Model.load(folder / "through.npz")
    arrays = {name: array for name, array in model.arrays.items() if not name.startswith("beam.")}
    (folder / "beamless.npz").write_bytes(written(model.header, arrays))
    poles = beam_arrays()["beam.poles"] * [[-1.0], [1.0]]
    (folder / "growing.npz").write_bytes(with_beam(None, poles=poles))
    _csv(folder / "vibration.csv", good / 9.81, f"# sampling_rate: {RATE:g} Hz\nacceleration (m/s^2)\n")
    longer = np.concatenate([good, *[good[:250]] * 3])  # 5 ms and more after the onset
    _csv(folder / "longer.csv", longer / 9.81, f"# sampling_rate: {RATE:g} Hz\nacceleration (m/s^2)\n")
    _csv(folder / "slow.csv", good / 9.81, "# sampling_rate: 1500 Hz\nacceleration (m/s^2)\n")


def _old_model(path: Path, model: Model) -> None:
    header = json.dumps(model.header | {"schema_version": 1}).encode()
    np.savez(path, header=np.frombuffer(header, np.uint8), **model.arrays)


def _one_label() -> dict:
    return {
        "name": "one",
        "impact": {"stiffness": "hertz", "dissipation": "elastic", "target": "rigid"},
        "sampling": {"sampling_rate": "200 kHz", "samples": 512, "pre_trigger": 64},
        "populations": [
            {
                "label": "coal",
                "density": 1400,
                "youngs_modulus": "3 GPa",
                "poisson_ratio": 0.3,
                "radius": {"distribution": "uniform", "lowest": "20 mm", "highest": "30 mm"},
                "velocity": "4 m/s",
            }
        ],
    }


CASES = (
    Case("missing file", ("predict", "none.csv"), 66, ("none.csv",)),
    Case("line break in a name", ("predict", "no\ncgid: error: forged.csv"), 66, ("no\\ncgid: error: forged.csv",)),
    Case("damaged table", ("info", "damaged_table.csv"), 65, ("damaged_table.csv", "line 6", "make it again")),
    Case("empty file", ("predict", "empty.csv"), 65, ("empty.csv", "empty")),
    Case("binary junk", ("predict", "junk.csv"), 65, ("junk.csv", "neither text nor of another format")),
    Case("truncated WAV", ("predict", "truncated.wav"), 65, ("truncated.wav",)),
    Case("truncated NPY", ("predict", "truncated.npy", "--rate", "2e5", "--unit", "N"), 65, ("truncated.npy",)),
    Case("truncated dataset", ("predict", "truncated.h5"), 65, ("truncated.h5",)),
    Case("unfinished dataset", ("train", "unfinished", "-o", "new.npz"), 65, ("description.json",)),
    Case("nan sample", ("features", "nan.csv"), 65, ("17", "nan")),
    Case("infinite sample", ("features", "inf.csv"), 65, ("17", "inf")),
    Case("no impact", ("predict", "noise.csv"), 65, ("no impact", "6 times the noise")),
    Case("impact downwards", ("predict", "downwards.csv"), 65, ("no impact", "invert")),
    Case("constant signal", ("features", "constant.csv"), 65, ("constant.csv", "all 500 samples are 3")),
    Case("too few samples on the pulse", ("predict", "few.csv"), 65, ("20000 Hz", "samples", "Hz or more")),
    Case("pulse cut off by the end", ("predict", "cut_off.csv"), 65, ("cut off", "longer frame")),
    Case("no sampling rate", ("predict", "no_rate.csv"), 2, ("--rate",)),
    Case("sampling rate zero", ("predict", "whole.npy", "--rate", "0", "--unit", "N"), 65, ("sampling_rate", "0 Hz")),
    Case("sampling rate negative", ("features", "whole.npy", "--rate", "-5"), 65, ("sampling_rate", "-5 Hz")),
    Case(
        "sampling rate of years",
        ("predict", "whole.npy", "--rate", "1e-6", "--unit", "N"),
        65,
        ("sampling_rate", "at least 10 Hz", "1e-06 Hz"),
    ),
    Case(
        "sampling rate of no feature",
        ("features", "whole.npy", "--rate", "100", "--unit", "g"),
        65,
        ("feature", "needs a sampling_rate of", "got 100 Hz"),
    ),
    Case("no unit", ("predict", "no_unit.csv"), 2, ("--unit",)),
    Case("unknown unit", ("predict", "no_unit.csv", "--unit", "stone"), 65, ("stone", "force: N")),
    Case("wrong quantity", ("predict", "acceleration.csv", "--model", "model.npz"), 65, ("acceleration", "--mass KG")),
    Case(
        "model of another quantity",
        ("predict", "good.csv", "--model", "acceleration.npz"),
        65,
        ("acceleration", "force"),
    ),
    Case(
        "dataset for a model of another quantity", ("predict", "two.h5", "--model", "acceleration.npz"), 65, ("m/s^2",)
    ),
    Case("mass of a force", ("predict", "good.csv", "--mass", "2"), 65, ("mass", "force")),
    Case("mass zero", ("predict", "acceleration.csv", "--mass", "0"), 65, ("mass", "0 kg")),
    Case("no model", ("predict", "good.csv", "--model", "none.npz"), 66, ("none.npz",)),
    Case("model of no name", ("predict", "good.csv", "--model", ""), 2, ("'--model'", "must not be empty")),
    Case("recording of no name", ("predict", ""), 2, ("'FILE...'", "must not be empty")),
    Case("label that models answer strangers with", ("check", "stranger.toml"), 65, ("label must not be 'unknown'",)),
    Case("label of a page", ("train", "tagged.h5", "-o", "new.npz"), 65, ("tagged.h5: label must be", "'<b>'")),
    Case("verify no name", ("verify", ""), 2, ("'DATA...'", "must not be empty")),
    Case("model of junk", ("predict", "good.csv", "--model", "text.npz"), 65, ("text.npz", "no sound model")),
    Case("public data of no name", ("fetch", "steel-bals"), 65, ("did you mean 'steel-balls'",)),
    Case("mirror of half an address", ("fetch", "shock", "--mirror", "http://[::1"), 65, ("mirror", "[::1")),
    Case("mirror of an impossible port", ("fetch", "shock", "--mirror", "http://h:99999"), 65, ("mirror", "99999")),
    Case("mirror of no host", ("fetch", "shock", "--mirror", "http://"), 65, ("mirror",)),
    Case("mirror with a password", ("fetch", "shock", "--mirror", "http://me:pw@h/"), 65, ("mirror", "password")),
    Case("mirror on a disk", ("fetch", "shock", "--mirror", "file:///etc"), 65, ("begins with https://",)),
    Case("impactor of no scene", ("predict", "good.csv", "--impactor", "none.toml"), 66, ("none.toml",)),
    Case("impactor in drawn rigs", ("predict", "good.csv", "--impactor", "randomised"), 65, ("take [randomise] out",)),
    Case("masses without an impactor", ("predict", "good.csv", "--masses", "m.png"), 2, ("give --impactor SCENE",)),
    Case(
        "masses in a text file",
        ("predict", "good.csv", "--impactor", "reference", "--masses", "m.txt"),
        73,
        ("m.txt", "a picture must end in .png"),
    ),
    Case(
        "impactor by a model of shocks",
        ("predict", "acceleration.csv", "--model", "acceleration.npz", "--impactor", "reference"),
        65,
        ("impactor needs the force [N]", "acceleration [m/s^2]"),
    ),
    Case("unknown label in costs", ("predict", "good.csv", "--miss-cost", "granite=2"), 65, ("granite",)),
    Case("value of a former option", ("predict", "good.csv", "--cost", "granite=2"), 65, ("granite",)),
    Case(
        "rows in a text file", ("predict", "good.csv", "-o", "rows.txt"), 73, ("rows.txt", ".csv or .jsonl or .parquet")
    ),
    Case("rows over a recording", ("predict", "good.csv", "-o", "good.csv"), 73, ("good.csv", "--overwrite")),
    Case("rows in no folder", ("features", "good.csv", "-o", "no/rows.csv"), 73, ("folder no must exist",)),
    Case("rows as JSON and in a file", ("features", "good.csv", "--json", "-o", "new.csv"), 2, ("--json", "-o")),
    Case("cost that is no number", ("predict", "good.csv", "--miss-cost", "coal=much"), 2, ("LABEL=COST",)),
    Case(
        "model of an older version",
        ("predict", "good.csv", "--model", "old.npz"),
        65,
        ("old.npz", "2 to 4, got 1", "again"),
    ),
    Case(
        "look through a beam of a force",
        ("train", "reference", "-n", "600", "--features", "beam_peak_force", "-o", "new.npz"),
        65,
        ("beam_peak_force must have a beam", "[tail_beam]", "leave the feature out"),
    ),
    Case(
        "look through a beam without a model",
        ("features", "longer.csv", "--features", "beam_peak_force"),
        65,
        ("beam_peak_force must have a beam", "cgid train tail_beam"),
    ),
    Case("model that lost its beam", ("predict", "slow.csv", "--model", "beamless.npz"), 65, ("arrays of a beam",)),
    Case("model whose beam grows", ("predict", "slow.csv", "--model", "growing.npz"), 65, ("poles that decay",)),
    Case(
        "one of two sensors", ("predict", "vibration.csv", "--model", "pair.npz"), 65, ("be 2,", "got 1", "--channel")
    ),
    Case(
        "impactors through two sensors",
        ("predict", "vibration.csv", "--model", "pair.npz", "--impactor", "reference"),
        65,
        ("a model of one sensor", "several together"),
    ),
    *(
        Case(f"sensors that are {name}", ("train", *data, "--sensor", point, "-o", "new.npz"), 65, says)
        for name, data, point, says in (
            ("no point", ("tail_beam",), "0.5;0.45", ("--sensor", "X,Y", "0.5,0.45", "'0.5;0.45'")),
            ("off the beam", ("tail_beam",), "9,0.45", ("sensor_point.x", "0 and 1.6 m", "9 m")),
            *((point, ("tail_beam",), point, ("--sensor", "X,Y", point)) for point in ("nan,0.4", "0.5,inf", "-1,0.4")),
            ("three numbers", ("tail_beam",), "0.5,0.4,0.3", ("--sensor", "X,Y", "0.5,0.4,0.3")),
            ("of a force", ("reference",), "0.5,0.45", ("--sensor must be left out", "reference", "tail_beam")),
            ("of a stream", ("caving",), "0.5,0.45", ("caving", "stream", "left out")),
        )
    ),
    Case("recording slower than a beam", ("predict", "slow.csv", "--model", "through.npz"), 65, ("at least 2000 Hz",)),
    Case(
        "drop height of no use",
        ("predict", "good.csv", "--model", "model.npz", "--drop-height", "1.5"),
        65,
        ("drop_height", "left out", "cgid train --drop-height"),
    ),
    Case(
        "no drop height", ("predict", "good.csv", "--model", "height.npz"), 2, ("drop_height", "--drop-height METRES")
    ),
    Case(
        "drop height zero",
        ("predict", "good.csv", "--model", "height.npz", "--drop-height", "0"),
        65,
        ("drop_height", "above 0", "0 m"),
    ),
    Case(
        "drop height of a dataset that stores it",
        ("predict", "two.h5", "--model", "height.npz", "--drop-height", "1"),
        65,
        ("two.h5", "--drop-height", "stores"),
    ),
    Case("coverage 1", ("predict", "good.csv", "--coverage", "1"), 65, ("coverage", "between 0 and 1", "got 1")),
    Case(
        "coverage beyond the calibration",
        ("predict", "good.csv", "--model", "height.npz", "--coverage", "0.99"),
        65,
        ("at most 0.98", "60 calibration impacts", "ask for less"),
    ),
    Case(
        "coverage without calibration",
        ("predict", "good.csv", "--model", "uncalibrated.npz", "--coverage", "0.9"),
        65,
        ("coverage", "no calibration impacts"),
    ),
    Case(
        "coverage and costs",
        ("predict", "good.csv", "--coverage", "0.9", "--miss-cost", "coal=2"),
        65,
        ("costs and coverage", "leave one out"),
    ),
    Case("no coverage to hold for each label", ("predict", "good.csv", "--class-conditional"), 65, ("--coverage",)),
    Case("unknown channel", ("predict", "good.csv", "--channel", "7"), 65, ("7",)),
    Case("index out of range", ("predict", "two.h5", "--index", "64"), 65, ("index", "63")),
    Case("index of a recording", ("predict", "good.csv", "--index", "0"), 65, ("--index",)),
    Case("unit for a dataset", ("predict", "two.h5", "--unit", "V"), 65, ("--unit", "two.h5")),
    Case("dead time negative", ("predict", "good.csv", "--dead-time", "-1"), 65, ("--dead-time", "-1 ms")),
    Case("sampling rate absurd", ("predict", "whole.npy", "--rate", "1e300", "--unit", "N"), 65, ("sampling_rate",)),
    Case("unknown feature", ("features", "good.csv", "--features", "nose"), 65, ("nose", "most like")),
    Case(
        "features of windows of an impact",
        ("features", "good.csv", "--features", "window_level"),
        65,
        ("good.csv", "must be those of impacts, got those of windows"),
    ),
    Case("dataset of one class", ("train", "one.h5", "-o", "new.npz"), 65, ("at least 2 labels", "coal")),
    Case(
        "shares that leave nothing to train on",
        ("train", "reference.toml", "-n", "600", "--calibration-share", "0.9", "-o", "new.npz"),
        65,
        ("test and calibration share", "0.9"),
    ),
    Case(
        "recording of a manifest is missing",
        ("train", "m_gone.csv", "--strict", "-o", "new.npz"),
        66,
        ("gone.csv", "must exist"),
    ),
    Case(
        "recording of a manifest is a device",
        ("train", "m_device.csv", "--strict", "-o", "new.npz"),
        65,
        ("/dev/null", "recording of a manifest must be a regular file"),
    ),
    Case(
        "label that a manifest does not allow",
        ("train", "m_label.toml", "-o", "new.npz"),
        65,
        ("m_label.toml", "recording 1", "'coal', 'gangue'", "'cole'"),
    ),
    Case(
        "manifest of one group",
        ("train", "m_group.csv", "--by", "impact", "-o", "new.npz"),
        65,
        ("at least 2 groups", "got 1"),
    ),
    Case(
        "recording with two labels at once",
        ("train", "m_both.csv", "-o", "new.npz"),
        65,
        ("good.csv", "must not overlap", "coal and gangue"),
    ),
    Case(
        "manifest beside an option for datasets",
        ("train", "m_group.csv", "--test-share", "0.5", "-o", "new.npz"),
        65,
        ("--test-share", "left out"),
    ),
    Case(
        "table of impacts half filled in",
        ("train", "m_half.csv", "-o", "new.npz"),
        65,
        ("m_half.csv", "2 of 3 have none", "first is row 2", "fill in the column label, or delete"),
    ),
    Case(
        "interval outside of its recording",
        ("train", "m_outside.csv", "--strict", "-o", "new.npz"),
        65,
        ("twice.csv", "start must lie inside the recording", "lasts 0.01 s", "got 7 s"),
    ),
    Case(
        "intervals that overlap",
        ("train", "m_overlap.csv", "-o", "new.npz"),
        65,
        ("twice.csv", "intervals must not overlap, coal and gangue do at 0.003 s"),
    ),
    Case("labels all the same", ("train", "m_same.csv", "-o", "new.npz"), 65, ("at least 2 labels", "got coal")),
    Case(
        "correction by impacts of one label",
        ("train", "m_same.csv", "--from", "model.npz", "-o", "new.npz"),
        65,
        ("every label of the model (coal, gangue)", "none is gangue", "label some"),
    ),
    Case(
        "correction by too few impacts",
        ("train", "m_group.csv", "--from", "model.npz", "-o", "new.npz"),
        65,
        ("labelled impacts must be 10 at least", "label more"),
    ),
    Case(
        "correction by a label that the model has not",
        ("train", "m_shale.csv", "--from", "model.npz", "-o", "new.npz"),
        65,
        ("label must be one of 'coal', 'gangue'", "'shale'"),
    ),
    Case(
        "correction of a model that must know more",
        ("train", "m_group.csv", "--from", "height.npz", "-o", "new.npz"),
        65,
        ("--from must name a model of the signal alone", "drop_height"),
    ),
    Case(
        "correction of a model of another quantity",
        ("train", "m_group.csv", "--from", "acceleration.npz", "-o", "new.npz"),
        65,
        ("twice.csv", "quantity must be the model's, acceleration", "got force", "--from"),
    ),
    Case(
        "correction of a missing model",
        ("train", "m_group.csv", "--from", "none.npz", "-o", "new.npz"),
        66,
        ("none.npz",),
    ),
    Case(
        "correction by a scene",
        ("train", "reference", "--from", "model.npz", "-o", "new.npz"),
        65,
        ("reference: with --from there must be one table of labelled impacts", "cgid events"),
    ),
    Case(
        "correction with another family",
        ("train", "m_group.csv", "--from", "model.npz", "--family", "linear", "-o", "new.npz"),
        65,
        ("--family must be left out", "--from"),
    ),
    Case(
        "training on a recording without labels",
        ("train", "good.csv", "-o", "new.npz"),
        65,
        ("good.csv", "must have labels", "cgid events good.csv -o events.csv", "cgid train events.csv"),
    ),
    Case(
        "training on a folder without labels", ("train", "loose", "-o", "new.npz"), 65, ("a.csv", "cgid events loose")
    ),
    Case(
        "training on an empty folder", ("train", "void", "-o", "new.npz"), 65, ("void", "must hold recordings", "empty")
    ),
    Case("training on a folder of papers", ("train", "papers", "-o", "new.npz"), 65, ("papers", "other endings")),
    Case(
        "training on a folder of junk",
        ("train", "junk", "--strict", "-o", "new.npz"),
        65,
        ("junk/coal/a.wav", "WAV"),
    ),
    Case(
        "folder with two manifests",
        ("train", "two_manifests", "-o", "new.npz"),
        65,
        ("two_manifests", "manifest.csv and events.csv", "name one"),
    ),
    Case("training without a name for the model", ("train", "m_same.csv"), 2, ("-o", "--output")),
    Case("template without .csv", ("train", "loose", "--template", "t.txt"), 73, ("t.txt", ".csv")),
    Case("template exists", ("train", "loose", "--template", "m_same.csv"), 73, ("m_same.csv", "--overwrite")),
    Case("impacts of silence", ("events", "constant.csv", "-o", "e.csv"), 65, ("constant.csv", "no impact")),
    Case("impacts without a unit", ("events", "no_unit.csv", "-o", "e.csv"), 2, ("no_unit.csv", "--unit")),
    Case("impacts in parts of full scale", ("events", "full_scale.wav", "-o", "e.csv"), 2, ("full_scale.wav", "FS")),
    Case(
        "impacts of several quantities",
        ("events", "good.csv", "motion.csv", "-o", "e.csv"),
        65,
        ("motion.csv", "one quantity", "acceleration"),
    ),
    Case(
        "impacts of two channels together",
        ("events", "pair.csv", "--channel", "1+2", "-o", "e.csv"),
        65,
        ("pair.csv", "--channel", "1+2"),
    ),
    Case(
        "training on impacts of two channels together",
        ("train", "m_pair.csv", "--by", "impact", "--channel", "1+2", "-o", "new.npz"),
        65,
        ("pair.csv", "channel", "1+2", "--by window"),
    ),
    Case(
        "manifest with impacts of two channels together",
        ("train", "m_together.csv", "--by", "impact", "-o", "new.npz"),
        65,
        ("pair.csv", "channel", "1+2", "--by window"),
    ),
    Case("impacts of the standard input", ("events", "-", "-o", "e.csv"), 65, ("stdin", "save it first")),
    Case("impacts of a missing file", ("events", "gone.csv", "-o", "e.csv"), 66, ("gone.csv", "must exist")),
    Case("impacts of an empty folder", ("events", "void", "-o", "e.csv"), 65, ("void", "empty")),
    Case("table of impacts exists", ("events", "good.csv", "-o", "m_same.csv"), 73, ("m_same.csv", "--overwrite")),
    Case("table of impacts without .csv", ("events", "good.csv", "-o", "e.xlsx"), 73, ("e.xlsx", ".csv")),
    Case("impacts without a name for the table", ("events", "good.csv"), 2, ("-o",)),
    Case("model name without .npz", ("train", "two.h5", "-o", "new.txt"), 73, ("new.txt", ".npz")),
    Case("model is a link to itself", ("train", "two.h5", "-o", "loop.npz"), 73, ("loop.npz", "symbolic links")),
    Case("model exists", ("train", "two.h5", "-o", "model.npz"), 73, ("model.npz", "--overwrite")),
    Case("folder of the model is missing", ("train", "two.h5", "-o", "no/new.npz"), 73, ("no",)),
    Case("restitution 0", ("check", "zero.toml"), 65, ("populations.0.restitution", "0.05 and 1")),
    Case(
        "no yield pressure",
        ("check", "uncrushed.toml"),
        65,
        ("populations.0.yield_pressure", "missing, thornton dissipation needs it"),
    ),
    Case("yield pressure 0", ("check", "soft.toml"), 65, ("populations.0.yield_pressure", "got 0 Pa")),
    *(Case(name, ("check", f"{file}.toml"), 65, says) for name, file, _, says in _OF_ROCKS),
    *(
        Case(name, ("check", f"{file}.toml"), 65, (f"populations.0.{key}", *says))
        for name, file, (key, _), says in _OF_CRUSHING
    ),
    Case("weight of viscoelastic rocks", ("check", "viscous_fall.toml"), 65, ("impact.gravity", "kuwabara-kono")),
    Case("viscoelastic rocks on a beam", ("check", "viscous_beam.toml"), 65, ("tail_beam: must be", "kuwabara-kono")),
    Case("weight of crushing rocks", ("check", "fallen.toml"), 65, ("impact.gravity", "left out", "hunt-crossley")),
    Case("crushing on a beam", ("check", "crushed_beam.toml"), 65, ("tail_beam: must be left out", "thornton")),
    Case("restitution 1.2", ("check", "high.toml"), 65, ("populations.1.restitution", "1.2")),
    Case("negative density", ("check", "negative.toml"), 65, ("populations.0.density", "kg/m^3")),
    Case("unknown key", ("check", "unknown.toml"), 65, ("sampling.jittter", "unknown key")),
    Case("wrong unit", ("check", "unit.toml"), 65, ("populations.0.youngs_modulus", "3.1 GHz", "GPa")),
    Case("unknown shape of a tap", ("check", "shape.toml"), 65, ("taps.0.shape", "half-sine", "'saw'")),
    Case("tap of negative duration", ("check", "tap.toml"), 65, ("taps.0.contact_duration", "'-2 ms'")),
    Case("second hit after a length", ("check", "second.toml"), 65, ("populations.1.second_hit.delay", "'2 mm'", "ms")),
    Case("clipped above the peak", ("check", "clipped.toml"), 65, ("populations.1.clipped_at", "0.001 and 1", "1.5")),
    Case("nothing randomised", ("check", "nothing.toml"), 65, ("randomise", "at least one of sampling_rate")),
    Case("plate too thin", ("check", "sheet.toml"), 65, ("populations.1", "lambda", "at most 30", "target.thickness")),
    Case(
        "dataset of many sampling rates",
        ("generate", "rates.toml", "-o", "new.h5"),
        65,
        ("randomise.sampling_rate", "one sampling rate", "50000 to 90000 Hz", "cgid train"),
    ),
    Case("scene is no TOML", ("check", "toml.toml"), 65, ("toml.toml", "TOML")),
    Case("key of many parts", ("check", "dotted.toml"), 65, ("line 1", "at most 16 parts")),
    Case("many keys", ("check", "keys.toml"), 65, ("keys.toml", "at most 100000 keys and tables")),
    Case("key of several lines", ("check", "line.toml"), 65, ("line.toml: 'a\\nbccc", "...: unknown key")),
    Case(
        "model is a device",
        ("predict", "whole.npy", "--rate", "2e5", "--unit", "N", "--model", "/dev/zero"),
        65,
        ("regular file",),
    ),
    Case(
        "training for ever",
        ("train", "reference", "-o", "new.npz", "-n", "99999999999999"),
        65,
        ("signals", "1000000000"),
    ),
    Case("scene is a device", ("check", "/dev/null"), 65, ("/dev/null", "scene file must be a regular file")),
    Case("three errors at once", ("check", "three.toml"), 65, ("youngs_modulus", "jittter", "sensor.noise")),
    Case("missing scene", ("generate", "none.toml", "-o", "new.h5"), 66, ("none.toml",)),
    Case("dataset exists", ("generate", "reference.toml", "-o", "two.h5"), 73, ("two.h5", "--overwrite")),
    Case("folder is missing", ("generate", "reference.toml", "-o", "no/new.h5"), 73, ("no",)),
    Case("dataset is a link to itself", ("generate", "reference.toml", "-o", "loop"), 73, ("loop", "symbolic links")),
    Case("file is a link to itself", ("export", "two.h5", "-o", "loop.h5"), 73, ("loop.h5", "symbolic links")),
    Case("no signals", ("generate", "reference.toml", "-o", "new.h5", "-n", "0"), 65, ("n_signals", "0")),
    Case("seed negative", ("generate", "reference.toml", "-o", "new.h5", "--seed", "-1"), 65, ("seed", "-1")),
    Case("one file too large", ("generate", "reference.toml", "-o", "new.h5", "-n", "999999"), 65, ("2 GiB", ".h5")),
    Case("disk too small", ("generate", "reference.toml", "-o", "new", "-n", "999999999"), 73, ("GB", "room")),
    Case("too many signals", ("generate", "reference.toml", "-o", "new", "-n", "9999999999999"), 65, ("n_signals",)),
    Case("ceiling of no scene", ("ceiling", "none.toml"), 66, ("none.toml",)),
    Case("ceiling of no signals", ("ceiling", "reference", "-n", "0"), 65, ("n_signals", "got 0")),
    Case("ceiling without end", ("ceiling", "reference", "-n", "9" * 14), 65, ("n_signals", "between 2 and 10000000")),
    Case("learner without end", ("ceiling", "peers", "--learner", "9" * 14), 65, ("learner", "10000000")),
    Case("ceiling of taps", ("ceiling", "strangers"), 65, ("strangers", "taps")),
    Case("no signals to enclose", ("ceiling", "randomised", "-n", "0"), 65, ("n_signals", "got 0")),
    Case("learner of few signals", ("ceiling", "reference", "--learner", "20"), 65, ("learner", "100", "20")),
    Case("sensor off the beam", ("check", "sensor_off.toml"), 65, ("sensor_point.x", "0 and 1.6 m", "2.5 m")),
    Case(
        "impact point off the beam",
        ("generate", "impact_off.toml", "-o", "new.h5"),
        65,
        ("impact_point.x", "0 and 1.6 m", "1.7 m"),
    ),
    Case(
        "damping ratio 0",
        ("generate", "undamped.toml", "-o", "new.h5"),
        65,
        ("tail_beam.damping_ratio", "between 0 and 1"),
    ),
    Case(
        "damping ratio negative", ("check", "driven.toml"), 65, ("tail_beam.damping_ratio", "between 0 and 1", "-2 %")
    ),
    Case("undamped mounting", ("check", "stud.toml"), 65, ("sensor.mounting.damping_ratio", "between 0 and 1")),
    Case("ribs wider than the beam", ("check", "ribs.toml"), 65, ("ribs", "0.25 m", "1.4 m", "fewer or thinner")),
    Case("unknown edges", ("check", "edges.toml"), 65, ("tail_beam.edges", "'cantilever'", "'floating'")),
    Case("beam without thickness", ("check", "skinless.toml"), 65, ("tail_beam", "thickness", "modes in place")),
    Case(
        "anti-alias filter above half the rate",
        ("generate", "nyquist.toml", "-o", "new.h5"),
        65,
        ("sensor.anti_alias.frequency", "12800 Hz", "13000 Hz"),
    ),
    Case("bandwidth above half the rate", ("check", "band.toml"), 65, ("sensor.bandwidth", "12800 Hz", "13000 Hz")),
    Case("bandwidth and anti-alias filter", ("check", "two_filters.toml"), 65, ("bandwidth", "anti_alias", "not both")),
    Case("beam and thickness of a plate", ("check", "two_plates.toml"), 65, ("impact.target.thickness", "left out")),
    Case("beam of a rigid wall", ("check", "wall.toml"), 65, ("impact.target", "material", "'rigid'")),
    Case("weight on a beam", ("check", "heavy.toml"), 65, ("impact.gravity", "left out", "tail beam")),
    Case("motion without a beam", ("check", "beamless.toml"), 65, ("tail_beam", "missing", "quantity = 'force'")),
    Case("range of a force in g", ("check", "range.toml"), 65, ("sensor.range", "must be a force", "'500 g'")),
    Case("range of an acceleration in kN", ("check", "newton.toml"), 65, ("sensor.range", "an acceleration", "500 kN")),
    Case("bits without range", ("check", "step.toml"), 65, ("sensor", "bits", "range")),
    Case("gain 0", ("check", "deaf.toml"), 65, ("gain", "not be 0", "leave it out")),
    Case(
        "more modes than can be found",
        ("generate", "modes_too_many.toml", "-o", "new.h5"),
        65,
        ("tail_beam", "1000 modes", "anti_alias.frequency", "smaller or thicker"),
    ),
    Case("background of no file", ("check", "hum_missing.toml"), 66, ("gone.wav",)),
    Case(
        "background that is a device",
        ("generate", "hum_device.toml", "-o", "new.h5"),
        65,
        ("/dev/null", "background must be a regular file"),
    ),
    Case("ceiling of acceleration", ("ceiling", "tail_beam"), 2, ("tail_beam", "studies.ceilings")),
    Case("no table of modes", ("generate", "no_table.toml", "-o", "new.h5"), 66, ("gone.csv", "table of modes")),
    Case("table of modes is a device", ("check", "device.toml"), 65, ("/dev/null", "modes must be a regular file")),
    Case("modes not sorted", ("generate", "unsorted.toml", "-o", "new.h5"), 65, ("unsorted.csv, line 3", "ascend")),
    Case("table without a mode", ("check", "no_modes.toml"), 65, ("no_modes.csv", "a line a mode")),
    Case("number of a mode missing", ("check", "gap.toml"), 65, ("gap.csv, line 3", "shape_sensor", "''")),
    Case("column of modes missing", ("check", "column.toml"), 65, ("column.csv", "'shape_sensor [1]'")),
    Case("column of modes without unit", ("check", "unitless.toml"), 65, ("unitless.csv", "'frequency [Hz]'", "unit")),
    Case("mode without damping", ("check", "ringing.toml"), 65, ("ringing.csv, line 2", "damping_ratio", "got 0")),
    Case("mode without mass", ("check", "weightless.toml"), 65, ("weightless.csv, line 2", "modal_mass", "0 kg")),
    Case("mode far too high", ("check", "ultrasound.toml"), 65, ("tail_beam.modes.0.frequency", "1e+300")),
    Case(
        "no mode that is heard", ("check", "still.toml"), 65, ("tail_beam", "shape is not 0", "nothing would be heard")
    ),
    Case("impedance of measured modes", ("check", "endless.toml"), 65, ("coupling", "auto or modes", "no impedance")),
    Case(
        "errors of modes of a scene without a beam",
        ("train", "reference", "-n", "100", "--start-error", "1 %", "-o", "new.npz"),
        65,
        ("reference", "[tail_beam]", "sensor of motion"),
    ),
    Case(
        "errors of modes that nobody can look through",
        ("train", "tail_beam", "-n", "100", "--start-error", "90 %", "-o", "new.npz"),
        65,
        ("start_error", "at most 0.1", "0.9"),
    ),
    Case("learned modes of another beam", ("check", "learned.toml"), 65, ("a row for each of the 188 modes", "got 1")),
    Case("learned mode without sense", ("check", "unsure.toml"), 65, ("unsure_modes.csv, line 2", "deviation", "-1")),
    Case("calibration of no beam", (*_CALIBRATE[:3], "reference", *_CALIBRATE[4:]), 65, ("[tail_beam]", "add them")),
    Case("calibration with few impacts", _CALIBRATE, 65, ("few_blows.csv", "at least 20", "record longer")),
    Case("clipped throughout", ("calibrate", "clipped_blows.csv", *_CALIBRATE[2:]), 65, ("at least 20", "clipped")),
    Case(
        "dimensions of taps",
        ("calibrate", "other_beam.csv", "--scene", "taps.toml", "-o", "new.toml", "--dimension-error", "3 %"),
        65,
        ("its modes are tapped", "dimension_error"),
    ),
    Case(
        "a dimension that the beam has not",
        (*_CALIBRATE, "--dimension-error", "ribs.height = 3 %"),
        65,
        ("dimension_error must be of length", "ribs.depth", "got ribs.height"),
    ),
    Case(
        "dimensions that are far off",
        (*_CALIBRATE, "--dimension-error", "20 %"),
        65,
        ("dimension_error must be at least 0 and at most 0.1, got 0.2",),
    ),
    Case(
        "calibration with another beam",
        ("calibrate", "other_beam.csv", "--scene", "taps.toml", "-o", "new.toml"),
        65,
        ("must explain the blows", "expected", "is it the beam"),
    ),
    Case(
        "calibration on a node",
        ("calibrate", "other_beam.csv", "--scene", "taps_on_node.toml", "-o", "new.toml"),
        65,
        ("3 of 4 have a node", "sensor_point", "move it"),
    ),
    Case(
        "calibration of modes too high",
        ("calibrate", "other_beam.csv", "--scene", "fast.toml", "-o", "new.toml"),
        65,
        ("sampling.sampling_rate", "25600 Hz", "2.1e+04 Hz", "record faster"),
    ),
    Case("calibration with forces", ("calibrate", "good.csv", *_CALIBRATE[2:]), 65, ("acceleration", "force [N]")),
    Case(
        "calibration at another rate",
        ("calibrate", "acceleration.csv", *_CALIBRATE[2:]),
        65,
        ("25600 Hz", "200000 Hz", "anti_alias"),
    ),
    Case("start error that is none", (*_CALIBRATE, "--start-error", "near"), 65, ("--start-error", "'1 %'", "near")),
    Case("start error too large", (*_CALIBRATE, "--start-error", "30 %"), 65, ("start_error", "at most 0.1", "0.3")),
    Case("site that is no scene", (*_CALIBRATE[:5], "site.csv"), 73, ("site.csv", ".toml")),
    Case("site exists", (*_CALIBRATE[:5], "modes.toml"), 73, ("modes.toml", "--overwrite")),
    Case("no recording to calibrate", ("calibrate", "gone.wav", *_CALIBRATE[2:]), 66, ("gone.wav",)),
    *(
        Case(f"{name} to tap", ("tap", file, *_TAPPED[2:]), code, says)
        for name, file, code, says in (
            ("silence", "silent_taps.csv", 65, ("silent_taps.csv", "must hold one", "record nearer")),
            ("only double taps", "double_taps.csv", 65, ("double tap", "lift the hammer")),
            ("clipped taps", "clipped_taps.csv", 65, ("2 clipped", "larger range")),
            ("decays too short", "short_taps.csv", 65, ("too near the end", "leave a second")),
            ("nan", "nan_taps.csv", 65, ("nan_taps.csv", "sample 5620", "nan")),
            ("forces alone", "good.csv", 65, ("force [N]", "--hammer")),
            ("no file", "gone.wav", 66, ("gone.wav",)),
            ("a stream", "-", 65, ("stdin", "save it first")),
            ("a dataset", "two.h5", 65, ("two.h5", "dataset")),
        )
    ),
    Case("hammer that is no channel", (*_TAPPED, "--hammer", "2"), 65, ("channel '2'", "--channel")),
    Case("hammer that is no force", (*_TAPPED, "--hammer", "1"), 65, ("--hammer", "force", "acceleration")),
    Case("band upside down", (*_TAPPED, "--band", "900", "100"), 65, ("band", "ascending", "900")),
    Case("band beyond the recorder", (*_TAPPED, "--band", "100", "20000"), 65, ("--band", "12544 Hz")),
    Case("band without a mode", (*_TAPPED, "--band", "6000", "7000"), 65, ("mode must ring", "6000", "--band")),
    Case("no order", (*_TAPPED, "--max-order", "0"), 65, ("max_order", "got 0")),
    Case("hammer that never leaves", (*_TAPPED, "--contact", "-1"), 65, ("contact", "0 or more", "-0.001 s")),
    Case("no tap at that time", (*_TAPPED, "--taps", "tap_times.csv"), 65, ("7.5 s", "correct the table")),
    Case("table of taps without times", (*_TAPPED, "--taps", "tap_table.csv"), 65, ("tap_table.csv", "time_s")),
    Case("taps on no beam", (*_TAPPED, "--scene", "reference"), 65, ("reference", "[tail_beam]")),
    Case("taps with no start error", (*_TAPPED, "--start-error", "0"), 65, ("--start-error", "above 0")),
    Case("modes that exist", (*_TAPPED[:3], "modes.csv"), 73, ("modes.csv", "--overwrite")),
    Case("modes that are no table", (*_TAPPED[:3], "modes.toml"), 73, ("modes.toml", ".csv")),
    Case("measured modes and a panel", ("check", "both.toml"), 65, ("modes or a panel", "take out length")),
    Case(
        "more impacts than memory holds",
        ("generate", "crowd.toml", "-o", "new.h5"),
        65,
        ("stream.arrivals", "168 GiB", "-n 172", "lower the rate"),
    ),
    Case("impacts without number", ("check", "beyond.toml"), 65, ("stream.arrivals", "GiB", "; lower the rate")),
    Case(
        "recording larger than a file",
        ("generate", "long.toml", "-o", "new.h5"),
        65,
        ("stream.duration", "6.87 GiB", "-n 4", "lower the sampling rate"),
    ),
    Case("stream with frames", ("check", "framed.toml"), 65, ("sampling.samples", "left out", "stream.duration")),
    Case(
        "arrivals by rate and by times", ("check", "twice.toml"), 65, ("stream.arrivals", "rate or times", "not both")
    ),
    Case("arrival after the end", ("check", "late.toml"), 65, ("arrivals.times", "60 s", "70 s")),
    Case("share above 1", ("check", "whole.toml"), 65, ("stream.mixture.gangue", "1.2 at index 3")),
    Case("share missing", ("check", "row.toml"), 65, ("stream.mixture", "as many shares as times, 4", "got 3")),
    Case("share of an unknown label", ("check", "granite.toml"), 65, ("stream.mixture.granite", "coal, gangue")),
    Case("hum above half the rate", ("check", "hum.toml"), 65, ("background.hum.1.frequency", "12800 Hz", "20000 Hz")),
    Case("hum in N at an accelerometer", ("check", "hum_unit.toml"), 65, ("background.hum.1.amplitude", "0.05 N")),
    Case("noise above half the rate", ("check", "coloured.toml"), 65, ("background.coloured.frequencies", "20000 Hz")),
    Case("noise blacker than brown", ("check", "blacker.toml"), 65, ("sensor.noise_exponent", "got 3")),
    Case(
        "colour of no noise", ("check", "levelless.toml"), 65, ("sensor.noise_exponent", "relative_noise or absolute")
    ),
    Case("two colours of noise", ("check", "two_colours.toml"), 65, ("sensor.noise_spectrum", "take one of the two")),
    Case("colour of white noise", ("check", "white_density.toml"), 65, ("sensor.noise_density", "as absolute_noise")),
    Case("no table of a spectrum", ("check", "no_spectrum.toml"), 66, ("gone.csv", "table of a spectrum")),
    Case("table of a spectrum is a device", ("check", "spectrum_device.toml"), 65, ("/dev/null", "regular file")),
    Case(
        "spectrum that ends below half the rate",
        ("generate", "narrow.toml", "-o", "new.h5"),
        65,
        ("sensor.noise_spectrum.frequencies", "97.6562 Hz", "100000 Hz", "50 to 20000 Hz", "add rows"),
    ),
    Case("spectrum that begins late", ("check", "late_start.toml"), 65, ("noise_spectrum", "500 to 100000 Hz", "add")),
    Case("spectrum backwards", ("check", "backwards.toml"), 65, ("noise_spectrum", "ascend", "40 Hz after 50 Hz")),
    Case("spectrum with a hole", ("check", "silence.toml"), 65, ("noise_spectrum.density", "above 0", "got 0")),
    Case("spectrum of nan", ("check", "nan_density.toml"), 65, ("noise_spectrum.density", "finite")),
    Case("density missing", ("check", "spectrum_gap.toml"), 65, ("spectrum_gap.csv, line 3", "density", "''")),
    Case("density of power", ("check", "power_density.toml"), 65, ("power_density.csv", "'density [N/sqrt(Hz)]'")),
    Case("spectrum of one row", ("check", "one_row.toml"), 65, ("noise_spectrum.frequencies", "at least 2, got 1")),
    Case("empty table of a spectrum", ("check", "empty_spectrum.toml"), 65, ("empty_spectrum.csv", "first line")),
    Case("two ranges", ("check", "two_ranges.toml"), 65, ("sensor.range", "relative_range", "one of the two")),
    Case("drawn bits without range", ("check", "drawn_bits.toml"), 65, ("sensor.bits", "range or relative_range")),
    Case("drawn hum too high", ("check", "drawn_hum.toml"), 65, ("hum_frequency", "100000 Hz", "200000 Hz", "lower")),
    Case("drawn colour too black", ("check", "drawn_blackness.toml"), 65, ("noise_exponent", "-1 and 2", "drawn as 4")),
    Case("mixed with one weight", ("check", "mixed_weights.toml"), 65, ("randomise.hum", "as many as parts, 2, got 1")),
    Case("hum of two amplitudes", ("check", "two_amplitudes.toml"), 65, ("background.hum.0", "not both")),
    Case("hum relative to no impact", ("check", "relative_hum.toml"), 65, ("hum.1.relative_amplitude", "give amp")),
    Case("range relative to no impact", ("check", "relative_range.toml"), 65, ("sensor.relative_range", "give range")),
    Case("beam steeper than a wall", ("check", "steep.toml"), 65, ("stream.inclination", "'95 deg'")),
    Case("noise relative to no impact", ("check", "relative.toml"), 65, ("sensor.relative_noise", "absolute_noise")),
    Case(
        "table of a stream", ("generate", "caving.toml", "--features-only", "-o", "new.h5"), 2, ("stream", "--...-only")
    ),
    Case(
        "jobs for a stream", ("generate", "caving.toml", "-o", "new.h5", "--jobs", "2"), 65, ("--jobs", "leave it out")
    ),
    Case(
        "recordings in one file",
        ("generate", "caving.toml", "-o", "new.h5", "-n", "3"),
        65,
        ("one recording", "folder"),
    ),
    Case(
        "features of a stream",
        ("train", "caving.toml", "--features", "decay_time", "-o", "new.npz"),
        65,
        ("stream", "cgid generate"),
    ),
    Case("ceiling of a stream", ("ceiling", "caving.toml"), 65, ("stream", "take [stream] out")),
    Case(
        "jobs for a table",
        ("generate", "reference.toml", "--features-only", "-o", "new.h5", "--jobs", "2"),
        2,
        ("--jobs", "--features-only"),
    ),
    Case(
        "two kinds of table",
        ("generate", "reference.toml", "--features-only", "--closed-form-only", "-o", "new.h5"),
        2,
        ("--features-only", "--closed-form-only", "exclude"),
    ),
    Case("plan for nothing", ("generate", "reference.toml", "--json", "-o", "new.h5"), 2, ("--json", "--explain")),
    Case("a mistyped scene", ("check", "refrence"), 66, ("refrence: no such scene", "did you mean 'reference'")),
    Case("a mistyped scene to train on", ("train", "referense", "-o", "new.npz"), 66, ("did you mean 'reference'",)),
    Case("a scene's wrong ending", ("check", "reference.tml"), 66, ("reference.tml", "did you mean 'reference'")),
    Case("a mistyped model", ("predict", "good.csv", "--model", "defualt"), 66, ("model", "did you mean 'default'")),
    Case("evidence of a coin", ("predict", "good.csv", "--evidence", "0.4"), 65, ("--evidence", "0.5", "0.4")),
    Case("evidence beyond doubt", ("monitor", "-", "--evidence", "1"), 65, ("--evidence", "(exclusive)", "got 1")),
    Case("evidence that is no number", ("predict", "good.csv", "--evidence", "nan"), 65, ("--evidence", "nan")),
    Case("negative hold", ("monitor", "-", "--hold", "-3"), 65, ("--hold", "0 or more", "-3 s")),
    Case("endless hold", ("predict", "good.csv", "--hold", "inf"), 65, ("--hold", "inf")),
    Case("give up at once", ("monitor", "-", "--give-up", "0"), 65, ("--give-up", "above 0", "0 s")),
    Case("give up at no time", ("predict", "good.csv", "--give-up", "nan"), 65, ("--give-up", "nan")),
    Case("dilution that costs nothing", ("monitor", "-", "--dilution-cost", "0"), 65, ("--dilution-cost", "above 0")),
    Case("dilution cost no number", ("monitor", "-", "--dilution-cost", "nan"), 65, ("--dilution-cost", "nan")),
    Case("dilution that pays", ("predict", "good.csv", "--dilution-cost", "-2"), 65, ("--dilution-cost", "above 0")),
    Case("a mistyped label", ("predict", "good.csv", "--gangue", "gange"), 65, ("did you mean 'gangue'",)),
    Case("check of nothing", ("check",), 2, ("SCENE", "--list")),
    Case("verify nothing", ("verify", "nothing.h5"), 66, ("nothing.h5", "dataset")),
    Case("a scene to verify by", ("verify", "nothing.h5", "--scene", "reference"), 2, ("--scene", "--repair")),
    Case("export nothing", ("export", "nothing.h5", "-o", "new.h5"), 66, ("nothing.h5", "cgid generate")),
    Case("export a scene", ("export", "reference.toml", "-o", "new.h5"), 65, ("reference.toml", "HDF5")),
    Case("verify a name too long", ("verify", "n" * 300), 66, ("nnn", "File name too long")),
    Case("export a name too long", ("export", "n" * 300, "-o", "new.h5"), 66, ("nnn", "File name too long")),
    Case("train on a name too long", ("train", "n" * 300, "-o", "new.npz"), 66, ("nnn", "File name too long")),
    Case("export onto itself", ("export", "two.h5", "-o", "two.h5", "--overwrite"), 73, ("two.h5", "another name")),
    Case("export exists", ("export", "two.h5", "-o", "truncated.h5"), 73, ("truncated.h5", "--overwrite")),
    Case("export of another name", ("export", "two.h5", "-o", "new.csv"), 73, ("new.csv", ".h5 or .hdf5")),
    Case("export a damaged dataset", ("export", "truncated.h5", "-o", "new.h5"), 65, ("truncated.h5",)),
    Case("C of no model", ("export-model", "gone.npz", "--to", "c", "-o", "new.c"), 66, ("gone.npz", "no such model")),
    Case("C of a dataset", ("export-model", "two.h5", "--to", "c", "-o", "new.c"), 65, ("two.h5", "no sound model")),
    Case("C of another name", ("export-model", "model.npz", "--to", "c", "-o", "new.h"), 73, ("new.h", "end in .c")),
    Case("C into no folder", ("export-model", "model.npz", "--to", "c", "-o", "no/new.c"), 73, ("no", "make it first")),
    Case("C of too much", ("export-model", "wide.npz", "--to", "c", "-o", "new.c"), 65, ("1048576", "--features")),
    Case("a model as nothing", ("export-model", "model.npz", "-o", "new.c"), 2, ("--to",)),
    Case("a model as Java", ("export-model", "model.npz", "--to", "java", "-o", "new.java"), 2, ("java", "--to")),
    Case(
        "resume a table",
        ("generate", "reference.toml", "--features-only", "-o", "new.csv", "--resume"),
        2,
        ("--resume", "--features-only", "leave --resume out"),
    ),
    Case(
        "resume another run",
        ("generate", "reference.toml", "-o", "two.h5", "--resume"),
        73,
        ("two.h5", "n_signals must be that of the run to be resumed, 64, got 10000", "--overwrite"),
    ),
    Case(
        "resume a damaged file",
        ("generate", "reference.toml", "-o", "truncated.h5", "--resume"),
        65,
        ("truncated.h5", "not whole", "--overwrite"),
    ),
    Case(
        "resume a file of another kind",
        ("generate", "caving.toml", "-o", "two.h5", "--resume"),
        65,
        ("two.h5", "no cgid-recording", "another name"),
    ),
    Case(
        "dataset where another is",
        ("generate", "reference.toml", "-o", "unfinished"),
        73,
        ("unfinished", "--overwrite"),
    ),
    Case(
        "dataset in a folder of other things",
        ("generate", "reference.toml", "-o", ".", "--overwrite"),
        73,
        ("other things in it", "another name"),
    ),
    Case(
        "scheduler that is no address",
        ("generate", "reference.toml", "-o", "new", "--scheduler", "here"),
        65,
        ("'here'", "tcp://"),
    ),
    Case(
        "workers here and on a cluster",
        ("generate", "reference.toml", "-o", "new", "--jobs", "2", "--scheduler", "tcp://127.0.0.1:1"),
        2,
        ("--jobs", "--scheduler", "one of them"),
    ),
    Case("unknown command", ("foretell",), 2, ("foretell",)),
    Case("no file given", ("predict",), 2, ("FILE",)),
    *(Case(*row) for row in RECORDING_CASES),
)


def main() -> None:
    """Print the table."""
    import contextlib
    import io
    import os

    from cgid.cli.main import run

    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        make_files(Path(folder))
        print("| input | command | exit code | message |\n|---|---|---|---|")
        for case in CASES:
            stream = io.StringIO()
            with contextlib.redirect_stderr(stream), contextlib.redirect_stdout(io.StringIO()):
                code = run(list(case.arguments))
            message = "<br>".join(line.removeprefix("cgid: error: ") for line in stream.getvalue().splitlines())
            print(f"| {case.name} | `cgid {' '.join(case.arguments)}` | {code} | {message} |")


if __name__ == "__main__":
    main()
