"""Every kind of bad input as one case: arguments, expected exit code, and the name that the error line must contain.

`tests/test_cli.py` runs them; `python -m tests.bad_input` prints them as a table with the messages.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from scipy.io import wavfile

from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.training import train_on_specimens
from cgid.measure.modal.modes import LEARNED_COLUMNS
from cgid.scene import generate, load_scene, parse_scene, plan, synthesise
from cgid.scene.output.generation import tabulate
from tests.bad_recordings import RECORDING_CASES, make_recordings
from tests.hostile_models import beam_arrays, wide_model, with_beam, written

ROOT = Path(__file__).parents[1]
RATE = 2e5


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


def _text(scene: str) -> str:
    """Return the text of a shipped scene, or of `reference` with rocks that crush or are viscous."""
    text = (ROOT / "datasets" / f"{scene if scene in ('tail_beam', 'caving') else 'reference'}.toml").read_text()
    if scene == "crushing":
        text = text.replace('"hunt-crossley"', '"thornton"')
        return re.sub(r"(?m)^restitution = .*$", 'yield_pressure = "41 MPa"', text)
    return text.replace('"hunt-crossley"', '"kuwabara-kono"') if scene == "viscous" else text


def _scenes(folder: Path) -> None:
    """Write the scenes with something wrong; the replaced text must exist."""
    for number, (scene, old, new, _) in enumerate(_rows(_SCENES)):
        text, old, new = _text(scene), old.replace("\\n", "\n"), new.replace("\\n", "\n")
        assert old in text, (scene, old)
        (folder / f"scene{number}.toml").write_text(text.replace(old, new, 1))


def _tables(folder: Path) -> None:
    """Write tables of modes, good and bad, and a scene for each."""
    text = (ROOT / "datasets" / "tail_beam.toml").read_text()
    start = text.index("[tail_beam]")
    stop = text.index("[sampling]")
    for name, (rows, _) in _TABLES.items():
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
    (folder / "tap_times.csv").write_text("time_s\n7.5\n")
    (folder / "tap_table.csv").write_text("when\n7.5\n")
    hits = np.concatenate([quiet, *[80 * (times < 5e-4) * np.sin(2e3 * np.pi * times)] * 2])
    hits += rng.normal(0, 0.02, hits.size)
    both = np.stack([np.concatenate([quiet, ring, ring]) + rng.normal(0, 0.02, hits.size), hits], axis=1)
    titles = "# sampling_rate: 25600 Hz\nacceleration (m/s^2),force (N)"
    np.savetxt(folder / "hammered.csv", both, "%.4f", ",", header=titles, comments="")
    (folder / "places.csv").write_text("x_m,y_m\n0.1,0.1\n0.2,0.1\n0.3,0.1\n")
    (folder / "two_places.csv").write_text("x_m,y_m\n0.1,0.1\n0.2,0.1\n")
    (folder / "late_places.csv").write_text("time_s,x_m,y_m\n0.1,0.1,0.1\n7.5,0.2,0.1\n")
    (folder / "half_places.csv").write_text("time_s,x_m\n0.1,0.1\n0.6,0.2\n")
    (folder / "nowhere.csv").write_text("x_m,y_m\n0.1,here\n0.2,0.1\n")


def _spectra(folder: Path) -> None:
    """Write scenes whose noise has a colour that is none by its table."""
    for name, (rows, _) in (_SPECTRA | {"gone_spectrum": ("", "")}).items():
        (folder / f"{name}.csv").write_text(rows)
        sensor = f'relative_noise = 0.01\nnoise_spectrum = "{name}.csv"'
        (folder / f"{name}.toml").write_text(_text("reference").replace("relative_noise = 0.01", sensor))
    (folder / "gone_spectrum.csv").unlink()


#: Contact laws that are none: name of the law and its file, force, and what else it defines.
_LAWS = {
    "attracting": ("(w * w, 0.3)", ""),
    "creating": ("(w**3, -0.5 * w**3)", ""),
    "undefined": ("(w**3 if w < 0.3 else np.nan, 0.0)", ""),
    "tearing": ("(w**3, 0.0)", "turn = staticmethod(njit(lambda p, history, x: x + 1.0))"),
    "misreading": ("(p[1] * w**3, 0.0)", ""),
    "misclosed": ("(w**3, 0.0)", "closed = lambda self, impact: HuntCrossley(restitution=0.5).closed(impact)"),
    "failing": ("(w**3, 0.0)", "numbers = lambda self, impact: 1 / 0"),
    "leaving": ("(w**3, 0.0)", "numbers = lambda self, impact: exit(0)"),
    "fieldless": ("(w**3, 0.0)", "keys = ()\n    amount: float = field(kw_only=True)"),
}


def _laws(folder: Path) -> None:
    """Write modules of laws that cannot be used, and for each a scene whose first rocks have it."""
    for name, (force, more) in _LAWS.items():
        (folder / f"{name}.py").write_text(
            "from dataclasses import dataclass, field\nimport numpy as np\nfrom numba import njit\n"
            "from cgid.physics import HuntCrossley, Law\n\n\n@dataclass(frozen=True)\nclass Bad(Law):\n"
            f'    restitution: float = 0.0\n    name = "{name}"\n    keys = ("restitution",)\n'
            f"    force = staticmethod(njit(lambda p, history, w: {force}))\n    {more}\n"
        )
        scene = _text("reference").replace("[[populations]]", f'[[populations]]\ndissipation = "{name}"', 1)
        if "keys = ()" in more:
            scene = re.sub("(?m)^restitution = .*\n", "", scene, count=1)
        (folder / f"{name}.toml").write_text(scene)
    (folder / "exits.py").write_text("raise SystemExit(0)\n")
    (folder / "lawless.py").write_text("from cgid.physics import Law\n")


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
    _laws(folder)
    (folder / "text.npz").write_text("no model")
    shutil.copy(shipped.path_of("models", shipped.DEFAULT_MODEL), folder / "model.npz")
    default = StoredModel.load(folder / "model.npz")
    (folder / "acceleration.npz").write_bytes(replace(default, unit="m/s^2").to_bytes())
    _old_model(folder / "old.npz", default)
    (folder / "wide.npz").write_bytes(wide_model().to_bytes())
    whitening = np.zeros_like(default.arrays["neighbourhood.whitening"])
    (folder / "singular.npz").write_bytes(
        written(default.header, {**default.arrays, "neighbourhood.whitening": whitening})
    )
    scale = np.full_like(default.arrays["standardiser.scale"], 5e-324)
    (folder / "scaleless.npz").write_bytes(written(default.header, {**default.arrays, "standardiser.scale": scale}))
    sources = [hashlib.sha256((folder / "good.csv").read_bytes()).hexdigest()]
    (folder / "own.npz").write_bytes(replace(default, training={"sources": sources}).to_bytes())
    shutil.copy(folder / "good.csv", folder / "renamed.csv")
    (folder / "m_own.csv").write_text("path,label\nrenamed.csv,coal\n")
    _beam_models(folder, good)
    scene = load_scene(ROOT / "datasets" / "reference.toml")
    enough = train_on_specimens(synthesise(scene, 600), features=["peak_force", "width_50"])
    (folder / "enough.npz").write_bytes(enough.model.to_bytes())
    few = train_on_specimens(synthesise(scene, 200), features=["peak_force", "width_50"])
    (folder / "uncalibrated.npz").write_bytes(few.model.to_bytes())
    for name in ("reference", "caving"):
        (folder / f"{name}.toml").write_text(_text(name))
    drawn = '[randomise]\nsampling_rate = { distribution = "uniform", lowest = "50 kHz", highest = "90 kHz" }\n[sensor]'
    (folder / "rates.toml").write_text(_text("reference").replace("[sensor]", drawn))
    lost = '[background]\nrecorded = { path = "gone.wav", signal_to_noise = "20 dB" }\n[sampling]'
    (folder / "hum_missing.toml").write_text(_text("tail_beam").replace("[sampling]", lost))
    (folder / "old.png").write_bytes(b"mine")
    (folder / "old.html").write_bytes(b"mine")
    make_recordings(folder)
    scene = _text("reference")
    for name, text in {
        "toml": scene.replace("[impact]", "[impact"),
        "dotted": f"a{'.a' * 2000} = 1\n{scene}",
        "keys": scene + "".join(f"[k{number}]\n" for number in range(100_000)),
        "line": f'"a\\nb{"z" * 1000}" = 1\n{scene}',
        "three": scene.replace("3.1 GPa", "3 s").replace("jitter", "jittter").replace("relative_noise", "noise"),
    }.items():
        (folder / f"{name}.toml").write_text(text)
    _scenes(folder)
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
    shutil.copytree(folder / "unfinished", folder / "former")
    (folder / "former" / "manifest.json").write_text("{}")
    shutil.copy(folder / "two.h5", folder / "tagged.h5")
    with h5py.File(folder / "tagged.h5", "r+") as file:
        file["labels"][:5] = b"<b>"


#: What is wrong with the text of a shipped scene: the scene, the text, what stands in its place, the key in the error.
#: Single values outside of what their key declares are for `tests/test_scene.py`, but for the first few.
_SCENES = r"""
reference | lowest = 0.1, highest = 0.8 | lowest = 0.0, highest = 0.8 | populations.0.restitution
reference | mean = "1400 kg/m^3" | mean = "-1400 kg/m^3" | populations.0.density
reference | "3.1 GPa" | "3.1 GHz" | populations.0.youngs_modulus
reference | jitter | jittter | sampling.jittter
reference | drop_height | height | populations.0
reference | "hertz" | "herz" | 'hertz'
reference | label = "coal" | label = "unknown" | label
reference | label = "coal" | label = "coal"\ncurvature = nan | populations.0.curvature
reference | label = "coal" | label = "coal"\nstrength = "16 MPa" | populations.0.strength
reference | label = "coal" | label = "coal"\nyield_pressure = "41 MPa" | populations.0.yield_pressure
reference | label = "coal" | label = "coal"\nviscous_restitution = 0.5 | viscous_restitution
reference | label = "coal" | label = "coal"\nexponent = 1.2 | populations.0.exponent
reference | label = "coal" | label = "coal"\ndissipation = "power-law"\nexponent = 2.1 | populations.0.exponent
reference | label = "coal" | label = "coal"\ndissipation = "power-law"\nexponent = 0.9 | populations.0.exponent
reference | label = "coal" | label = "coal"\ndissipation = "power-law"\nstrength = "16 MPa" | populations.0.strength
reference | label = "coal" | label = "coal"\ndissipation = "power-law"\nbreaking_force = 1.2 | breaking_force
reference | label = "coal" | label = "coal"\ndissipation = "power-law"\nbreaking_force = 0.5 | populations.0
reference | label = "coal" | label = "coal"\ndissipation = "power-law"\nremaining_force = 0 | remaining_force
reference | relative_noise = 0.01 | relative_noise = 0.01\nac_coupling = "120 kHz" | sensor.ac_coupling
crushing | yield_pressure | exponent = 2\nyield_pressure | populations.0.exponent
reference | label = "coal" | label = "coal"\ndissipation = "thorton" | 'thornton'
reference | [sensor] | [randomise]\n[sensor] | randomise
reference | = 0.30 } | = 0.30, thickness = "5 mm" } | populations.1
reference | [sensor] | [sensor]\nrange = "500 g" | sensor.range
reference | relative_noise = 0.01 | noise_exponent = 1 | sensor.noise_exponent
reference | relative_noise = 0.01 | noise_density = "1 N/sqrt(Hz)"\nnoise_exponent = 1 | sensor.noise_density
reference | relative_noise = 0.01 | relative_noise = 0.01\nnoise_spectrum = "/dev/null" | /dev/null
reference | relative_noise = 0.01 | relative_noise = 0.01\nrange = "9 kN"\nrelative_range = 2 | sensor.range
reference | relative_noise = 0.01 | relative_noise = 0.01\n[randomise]\nbits = 12 | sensor.bits
reference | relative_noise = 0.01 | [randomise]\nhum = 0.1\nhum_frequency = "200 kHz" | hum_frequency
crushing | yield_pressure = "41 MPa" |  | populations.0.yield_pressure
crushing | yield_pressure | restitution = 0.5\nyield_pressure | populations.0.restitution
crushing | yield_pressure | strength = "16 MPa"\nyield_pressure | populations.0.strength
tail_beam | sensor_point = { x = "0.5 m" | sensor_point = { x = "2.5 m" | sensor_point.x
tail_beam | highest = "1.5 m" | highest = "1.7 m" | impact_point.x
tail_beam | damping_ratio = "2 %" | damping_ratio = 0 | tail_beam.damping_ratio
tail_beam | "25 kHz", damping_ratio = 0.05 | "25 kHz", damping_ratio = 0 | sensor.mounting.damping_ratio
tail_beam | thickness = "25 mm" | thickness = "250 mm" | ribs
tail_beam | thickness = "30 mm" | thickness = 30 | tail_beam
tail_beam | "cantilever" | "floating" | tail_beam.edges
tail_beam | thickness = "30 mm"\n |  | tail_beam
tail_beam | anti_alias = { frequency = "10 kHz" | anti_alias = { frequency = "13 kHz" | sensor.anti_alias.frequency
tail_beam | anti_alias = { frequency = "10 kHz", order = 8 } | bandwidth = "13 kHz" | sensor.bandwidth
tail_beam | "10 kHz", order = 8 } | "13 kHz", kind = "linear-phase" } | sensor.anti_alias.frequency
tail_beam | "10 kHz", order = 8 } | "10 kHz", kind = "linear-phase", order = 6 } | order must be left out
tail_beam | "10 kHz", order = 8 } | "10 kHz", order = 8, transition = 0.2 } | transition must be left out
tail_beam | "10 kHz", order = 8 } | "10 kHz", kind = "linear-phase", transition = 2 } | sensor.anti_alias.transition
tail_beam | "10 kHz", order = 8 } | "10 kHz", kind = "linear" } | sensor.anti_alias.kind
tail_beam | bits = 16 | bits = 16\nbandwidth = "10 kHz" | anti_alias
tail_beam | poisson_ratio = 0.30 } | poisson_ratio = 0.30, thickness = "30 mm" } | impact.target.thickness
tail_beam | law = "exact" | law = "exact"\ngravity = "1 g" | impact.gravity
tail_beam | range = "500 g" | range = "500 kN" | sensor.range
tail_beam | range = "500 g"\n |  | bits
tail_beam | bits = 16 | bits = 16\ngain = 0 | gain
tail_beam | "10 kHz", order = 8 } | "10 kHz", order = 1 } | tail_beam
tail_beam | [sampling] | [background]\nrecorded = { path = "/dev/null", signal_to_noise = 9 }\n[sampling] | /dev/null
tail_beam | [tail_beam]\n | [tail_beam]\nlearned = "learned_modes.csv"\n | 188
tail_beam | [tail_beam]\n | [tail_beam]\nlearned = "unsure_modes.csv"\n | unsure_modes.csv, line 2
caving | rate = "8 Hz" | rate = "1 MHz" | stream.arrivals
caving | rate = "8 Hz" | rate = "1000 MHz" | stream.arrivals
caving | duration = "60 s" | duration = "20 h" | stream.duration
caving | sampling_rate = "25.6 kHz" | sampling_rate = "25.6 kHz"\nsamples = 2048 | sampling.samples
caving | rate = "8 Hz" | rate = "8 Hz", times = ["1 s"] | stream.arrivals
caving | rate = "8 Hz" | times = ["70 s"] | arrivals.times
caving | 0.90] | 1.2] | stream.mixture.gangue
caving | , 0.90] | ] | stream.mixture
caving | gangue = [ | granite = [ | stream.mixture.granite
caving | "297 Hz" | "20 kHz" | background.hum.1.frequency
caving | "0.05 g" | "0.05 N" | background.hum.1.amplitude
caving | "2 kHz"] | "20 kHz"] | background.coloured.frequencies
caving | amplitude = "0.05 g" | relative_amplitude = 0.1 | hum.1.relative_amplitude
caving | amplitude = "0.05 g" | amplitude = "0.05 g", relative_amplitude = 0.1 | background.hum.1
caving | range = "500 g" | relative_range = 2 | sensor.relative_range
caving | bits = 24 | bits = 24\nrelative_noise = 0.1 | sensor.relative_noise
caving | rate = "8 Hz" | rate = { times = [0, 5], values = [1] } | stream.arrivals.rate
caving | rate = "8 Hz" | rate = { times = [5, 5], values = [1, 2] } | stream.arrivals.rate
caving | rate = "8 Hz" | rate = { times = [0, 5], values = [0, 0] } | stream.arrivals.rate
caving | rate = "8 Hz" | times = [2, 1] | stream.arrivals
caving | rate = "8 Hz" |  | stream.arrivals
caving | gangue = [ | coal = [0.99, 0.99, 0.99, 0.99], gangue = [ | stream.mixture
caving | gangue = [ | coal = [0.01, 0.01, 0.01, 0.01], gangue = [ | stream.mixture
caving | times = ["0 s", "20 s" | times = ["0 s", "0 s" | stream.mixture
caving | anti_alias = { frequency = "10 kHz", order = 8 } | bandwidth = "2 kHz" | sensor.bandwidth
caving | label = "coal" | label = "coal"\nclipped_at = 0.5 | populations.0.clipped_at
reference | relative_noise = 0.01 | relative_noise = 0.01\nnoise_exponent = nan | sensor.noise_exponent
reference | 0.01 | 0.01\nnoise_exponent = 1\nnoise_spectrum = {frequencies=[50, 1e5], density=[1, 1]} | noise_spectrum
reference | 0.01 | 0.01\nnoise_spectrum = {frequencies=[50, 1e5], density=["1 g/sqrt(Hz)", 1]} | noise_spectrum.density
reference | [sensor] | [background]\n[sensor] | background
reference | [sensor] | [[background.hum]]\nfrequency = 50\n[sensor] | background.hum.0
reference | [sensor] | [background]\ncoloured = {frequencies=[10, 5], density=[1, 1]}\n[sensor] | background.coloured
reference | [sensor] | [background]\ncoloured = {frequencies=[5, 10], density=[1]}\n[sensor] | background.coloured
reference | [sensor] | [background]\nrecorded = { path = "pump.wav" }\n[sensor] | background.recorded.signal_to_noise
"""
_SPECTRUM_HEAD = "frequency [Hz],density [V/sqrt(Hz)]\n"
#: Tables of a spectrum, and the word in the error.
_SPECTRA = {
    "narrow": (_SPECTRUM_HEAD + "50,1\n20e3,1\n", "sensor.noise_spectrum.frequencies"),
    "late_start": (_SPECTRUM_HEAD + "500,1\n100e3,1\n", "noise_spectrum"),
    "backwards": (_SPECTRUM_HEAD + "50,1\n40,1\n100e3,1\n", "noise_spectrum"),
    "silence": (_SPECTRUM_HEAD + "50,1\n900,0\n100e3,1\n", "noise_spectrum.density"),
    "nan_density": (_SPECTRUM_HEAD + "50,1\n900,nan\n100e3,1\n", "noise_spectrum.density"),
    "spectrum_gap": (_SPECTRUM_HEAD + "50,1\n900\n100e3,1\n", "spectrum_gap.csv, line 3"),
    "power_density": ("frequency [Hz],density [V^2/Hz]\n50,1\n100e3,1\n", "power_density.csv"),
    "one_row": (_SPECTRUM_HEAD + "50,1\n", "noise_spectrum.frequencies"),
    "empty_spectrum": ("", "empty_spectrum.csv"),
}
_HEAD = "frequency [Hz],damping_ratio [1],modal_mass [kg],shape_impact [1],shape_sensor [1]\n"
#: Tables of modes, and the word in the error.
_TABLES = {
    "modes": (_HEAD + "118.5,0.012,210,0.9,0.4\n187,0.010,180,0.3,-0.7\n", ""),
    "unsorted": (_HEAD + "187,0.010,180,0.3,-0.7\n118.5,0.012,210,0.9,0.4\n", "unsorted.csv, line 3"),
    "no_modes": (_HEAD, "no_modes.csv"),
    "gap": (_HEAD + "118.5,0.012,210,0.9,0.4\n187,0.010,180,0.3\n", "shape_sensor"),
    "column": (
        "frequency [Hz],damping_ratio [1],modal_mass [kg],shape_impact [1]\n118.5,0.012,210,0.9\n",
        "column.csv",
    ),
    "doubled": (_HEAD.replace("\n", ",modal_mass [kg]\n") + "118.5,0.012,210,0.9,0.4,210\n", "got twice"),
    "unitless": (_HEAD.replace(" [Hz]", "") + "118.5,0.012,210,0.9,0.4\n", "unitless.csv"),
    "weightless": (_HEAD + "118.5,0.012,0,0.9,0.4\n", "modal_mass"),
    "ultrasound": (_HEAD + "1e300,0.012,210,0.9,0.4\n", "tail_beam.modes.0.frequency"),
    "still": (_HEAD + "118.5,0.012,210,0.9,0\n187,0.010,180,0,-0.7\n", "tail_beam"),
}


def _manifests(folder: Path, good: np.ndarray) -> None:
    """Write manifests of labelled recordings, each with one fault."""
    _csv(folder / "twice.csv", np.concatenate([good, good]))
    (folder / "m_gone.csv").write_text("path,label\ngone.csv,coal\ngood.csv,gangue\n")
    (folder / "m_device.csv").write_text("path,label\n/dev/null,coal\n")
    (folder / "m_group.csv").write_text("path,label,start_s,end_s\ntwice.csv,coal,0,0.005\ntwice.csv,gangue,0.005,\n")
    (folder / "m_both.csv").write_text("path,label\ngood.csv,coal\ngood.csv,gangue\n")
    (folder / "m_empty.csv").write_text("path,start_s,end_s,label,peak\ngood.csv,0,1,,9\ntwice.csv,0,1,,9\n")
    (folder / "m_outside.csv").write_text("path,start_s,end_s,label\ngood.csv,0,1,coal\ntwice.csv,7,8,gangue\n")
    (folder / "m_overlap.csv").write_text("path,start_s,end_s,label\ntwice.csv,0,4e-3,coal\ntwice.csv,3e-3,1,gangue\n")
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
        (folder / f"{name}.csv").write_text("path,start_s,end_s,label,channel\n" + intervals.format(channel))
    (folder / "m_beam.csv").write_text("path,label,same_beam\npair.csv,coal,1+1\n")
    (folder / "mixed.csv").write_text(f"{header}left,right\n{rows}")
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
    model = StoredModel.load(folder / "through.npz")
    arrays = {name: array for name, array in model.arrays.items() if not name.startswith("beam.")}
    (folder / "beamless.npz").write_bytes(written(model.header, arrays))
    poles = beam_arrays()["beam.poles"] * [[-1.0], [1.0]]
    (folder / "growing.npz").write_bytes(with_beam(None, poles=poles))
    _csv(folder / "vibration.csv", good / 9.81, f"# sampling_rate: {RATE:g} Hz\nacceleration (m/s^2)\n")
    longer = np.concatenate([good, *[good[:250]] * 3])  # 5 ms and more after the onset
    _csv(folder / "longer.csv", longer / 9.81, f"# sampling_rate: {RATE:g} Hz\nacceleration (m/s^2)\n")
    _csv(folder / "slow.csv", good / 9.81, "# sampling_rate: 1500 Hz\nacceleration (m/s^2)\n")


def _old_model(path: Path, model: StoredModel) -> None:
    header = json.dumps(model.header | {"schema_version": 3}).encode()
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


#: Exit code | arguments of a command in the folder of `make_files` | a name in the error.
_COMMANDS = r"""
66 | predict none.csv | none.csv
66 | check hum_missing.toml | gone.wav
66 | check gone_spectrum.toml | gone_spectrum.csv
65 | info damaged_table.csv | damaged_table.csv
65 | predict empty.csv | empty.csv
65 | predict junk.csv | junk.csv
65 | predict truncated.wav | truncated.wav
65 | predict truncated.npy --rate 2e5 --unit N | truncated.npy
65 | predict truncated.h5 | truncated.h5
65 | train unfinished -o new.npz | description.json
65 | train former -o new.npz | former
65 | verify former | former
73 | generate reference.toml -o former --overwrite | manifest.json
65 | features nan.csv | nan
65 | features inf.csv | inf
65 | predict noise.csv | no impact
65 | predict downwards.csv | no impact
65 | features constant.csv | constant.csv
65 | predict few.csv | 20000 Hz
65 | predict cut_off.csv | cut off
2 | predict no_rate.csv | --rate
65 | predict whole.npy --rate 0 --unit N | --rate
65 | features whole.npy --rate -5 | --rate
65 | predict whole.npy --rate 1e-6 --unit N | sampling_rate
65 | features whole.npy --rate 100 --unit g | feature
2 | predict no_unit.csv | --unit
65 | predict no_unit.csv --unit stone | stone
65 | predict acceleration.csv --model model.npz | acceleration
65 | predict good.csv --model acceleration.npz | acceleration
65 | predict two.h5 --model acceleration.npz | m/s^2
65 | predict good.csv --set mass=2 | mass
65 | predict acceleration.csv --set mass=0 | mass
66 | predict good.csv --model none.npz | none.npz
2 | predict good.csv --model '' | '--model'
2 | predict '' | 'FILE...'
65 | train tagged.h5 -o new.npz | tagged.h5: label must be
2 | verify '' | 'DATA...'
65 | predict good.csv --model text.npz | text.npz
65 | fetch steel-bals | did you mean 'steel-balls'
65 | fetch shock --mirror 'http://[::1' | mirror
65 | fetch shock --mirror http://h:99999 | mirror
65 | fetch shock --mirror http:// | mirror
65 | fetch shock --mirror http://me:pw@h/ | mirror
65 | fetch shock --mirror file:///etc | begins with https://
65 | predict good.csv --set miss_cost=granite=2 | granite
73 | predict good.csv -o rows.txt | rows.txt
73 | predict good.csv -o good.csv | good.csv
73 | features good.csv -o no/rows.csv | folder no must exist
2 | features good.csv --json -o new.csv | --json
65 | predict good.csv --set miss_cost=coal=much | LABEL=COST
65 | predict good.csv --model old.npz | schema_version
65 | train reference -n 600 --features beam_peak_force -o new.npz | [tail_beam]
65 | features longer.csv --features beam_peak_force | beam_peak_force must have a beam
65 | predict slow.csv --model beamless.npz | arrays of a beam
65 | predict slow.csv --model growing.npz | poles that decay
65 | predict vibration.csv --model pair.npz | --channel
65 | train tail_beam --sensor '0.5;0.45' -o new.npz | --sensor
65 | train tail_beam --sensor 9,0.45 -o new.npz | sensor_point.x
65 | train tail_beam --sensor nan,0.4 -o new.npz | --sensor
65 | train tail_beam --sensor 0.5,inf -o new.npz | --sensor
65 | train tail_beam --sensor -1,0.4 -o new.npz | --sensor
65 | train tail_beam --sensor 0.5,0.4,0.3 -o new.npz | --sensor
65 | train reference --sensor 0.5,0.45 -o new.npz | reference
65 | train caving --sensor 0.5,0.45 -o new.npz | caving
65 | predict slow.csv --model through.npz | at least 2000 Hz
65 | predict good.csv --set coverage=1 | coverage
65 | predict good.csv --model enough.npz --set coverage=0.99 | at most 0.98
65 | predict good.csv --model uncalibrated.npz --set coverage=0.9 | coverage
65 | predict good.csv --set coverage=0.9 --set miss_cost=coal=2 | costs and coverage
65 | predict good.csv --channel 7 | 7
65 | predict two.h5 --set index=64 | index
65 | predict two.h5 --set index=-1 | index
65 | predict good.csv --set index=0 | index
65 | predict two.h5 --unit V | --unit
65 | predict good.csv --set dead_time=-1 | dead_time
65 | predict whole.npy --rate 1e300 --unit N | --rate
65 | features good.csv --features nose | nose
65 | features good.csv --features window_level | good.csv
65 | train one.h5 -o new.npz | at least 2 labels
65 | train m_device.csv -o new.npz | /dev/null
65 | train m_group.csv --by impact -o new.npz | at least 2 groups
65 | train m_both.csv -o new.npz | good.csv
65 | train m_empty.csv -o new.npz | m_empty.csv: some row must have a label, none of 2 has
65 | train m_overlap.csv -o new.npz | twice.csv
65 | train m_group.csv --by window --window 0 -o new.npz | --window
65 | train m_group.csv --by window --set hop=1e-6 -o new.npz | hop
65 | train m_group.csv --by impact --features window_level -o new.npz | features
65 | train m_group.csv reference -o new.npz | reference: scenes and datasets
65 | train m_same.csv -o new.npz | at least 2 labels
65 | train m_same.csv --from model.npz -o new.npz | every label of the model (coal, gangue)
65 | predict good.csv --model singular.npz | neighbourhood.whitening
65 | predict good.csv --model scaleless.npz | standardiser.scale
65 | info singular.npz | neighbourhood.whitening
65 | export-model singular.npz --to c -o new.c | neighbourhood.whitening
65 | train m_group.csv --from singular.npz -o new.npz | neighbourhood.whitening
65 | train m_own.csv --from own.npz -o new.npz | did not train the model
65 | train m_group.csv --from model.npz -o new.npz | labelled impacts must be 10 at least
65 | train m_shale.csv --from model.npz -o new.npz | label must be one of 'coal', 'gangue'
65 | train m_group.csv --from acceleration.npz -o new.npz | --from
66 | train m_group.csv --from none.npz -o new.npz | none.npz
65 | train reference --from model.npz -o new.npz | reference: --from needs one table of labelled impacts
65 | train m_group.csv --from model.npz --family linear -o new.npz | --from
65 | predict model.npz | model.npz: must be a recording, it is a model; give it by --model
2 | train reference --family sklearn.svm.SVC -o new.npz | --family
2 | train reference --family boosting -o new.npz | logistic
65 | train good.csv -o new.npz | good.csv
65 | train loose -o new.npz | a.csv
65 | train void -o new.npz | void
65 | train papers -o new.npz | papers
65 | train junk -o new.npz | junk/coal/a.wav
65 | train two_manifests -o new.npz | two_manifests
2 | train m_same.csv | -o
65 | events constant.csv -o e.csv | constant.csv
2 | events no_unit.csv -o e.csv | no_unit.csv
2 | events full_scale.wav -o e.csv | full_scale.wav
65 | events good.csv motion.csv -o e.csv | motion.csv
65 | events pair.csv --channel 1+2 -o e.csv | pair.csv
65 | train m_pair.csv --by impact --channel 1+2 -o new.npz | pair.csv
65 | train m_together.csv --by impact -o new.npz | pair.csv
65 | predict pair.csv --same-beam 1+1 | once, got 1 twice
65 | predict pair.csv --same-beam 1 | two or more channels
65 | predict pair.csv --same-beam left+up | channel 'up' is none of them
65 | predict pair.csv --same-beam left+1 | got left twice
65 | predict pair.csv --channel 1 --same-beam 1+2 | channels that are read, right is not
65 | predict mixed.csv --unit 1=N,2=m/s^2 --same-beam 1+2 | one quantity
65 | predict pair.csv --channel 1+2 | give --same-beam 1+2
65 | predict two.h5 --same-beam 1+2 | --same-beam
65 | events pair.csv --same-beam 1+9 -o e.csv | channel '9' is none of them
65 | features pair.csv --same-beam 1+9 | channel '9' is none of them
65 | train m_pair.csv --by impact --same-beam 1+9 -o new.npz | channel '9' is none of them
65 | train m_pair.csv --by window --same-beam 1+2 -o new.npz | same_beam
65 | train m_beam.csv -o new.npz | row 2: same_beam
65 | train reference --same-beam 1+2 -o new.npz | --same-beam must be 1+2
65 | train tail_beam --sensor 0.5,0.4 --sensor 1,1 --same-beam 2+1 -o new.npz | --same-beam must be 1+2
65 | monitor - --same-beam 1+1 | once, got 1 twice
65 | events - -o e.csv | stdin
65 | events good.csv twice.csv --audacity a.txt -o e.csv | --audacity
65 | events good.csv --audacity pair.csv -o e.csv | pair.csv
73 | events good.csv --audacity ./e.csv -o e.csv | e.csv
65 | label - | stdin
66 | label gone.csv | gone.csv
73 | label good.csv -o l.xlsx | l.xlsx
65 | label good.csv -o pair.csv | pair.csv
65 | label good.csv --labels coal,<b> | --labels
66 | label good.csv --model gone.npz | gone.npz
2 | label good.csv --port 0 | --port
65 | label constant.csv motion.csv | motion.csv
66 | events gone.csv -o e.csv | gone.csv
65 | events void -o e.csv | void
73 | events good.csv -o m_same.csv | m_same.csv
73 | events good.csv -o e.xlsx | e.xlsx
2 | events good.csv | -o
73 | train two.h5 -o new.txt | new.txt
73 | train two.h5 -o loop.npz | loop.npz
73 | train two.h5 -o model.npz | model.npz
73 | train two.h5 -o no/new.npz | no
65 | generate rates.toml -o new.h5 | randomise.sampling_rate
65 | check toml.toml | toml.toml
65 | check dotted.toml | line 1
65 | check keys.toml | keys.toml
65 | check line.toml | line.toml: 'a\nbzzz
65 | predict whole.npy --rate 2e5 --unit N --model /dev/zero | regular file
65 | train reference -o new.npz -n 99999999999999 | signals
65 | check /dev/null | /dev/null
65 | check three.toml | youngs_modulus
66 | generate none.toml -o new.h5 | none.toml
73 | generate reference.toml -o two.h5 | two.h5
73 | generate reference.toml -o no/new.h5 | no
73 | generate reference.toml -o loop | loop
73 | export two.h5 -o loop.h5 | loop.h5
65 | generate reference.toml -o new.h5 -n 0 | --signals
65 | generate reference.toml -o new.h5 --seed -1 | seed
65 | generate reference.toml -o new.h5 -n 999999 | .h5
73 | generate reference.toml -o new -n 999999999 | GB
65 | generate reference.toml -o new -n 9999999999999 | --signals
65 | check beamless.toml | tail_beam
66 | generate no_table.toml -o new.h5 | gone.csv
65 | check device.toml | /dev/null
65 | check endless.toml | coupling
65 | train reference -n 100 --set start_error='1 %' -o new.npz | reference
65 | train tail_beam -n 100 --set start_error='90 %' -o new.npz | start_error
65 | calibrate few_blows.csv --scene reference -o new.toml | [tail_beam]
65 | calibrate few_blows.csv --scene tail_beam -o new.toml | few_blows.csv
65 | calibrate clipped_blows.csv --scene tail_beam -o new.toml | clipped
65 | calibrate other_beam.csv --scene taps.toml -o new.toml --dimension-error '3 %' | dimension_error
65 | calibrate few_blows.csv --scene tail_beam -o new.toml --dimension-error 'ribs.height = 3 %' | ribs.depth
65 | calibrate few_blows.csv --scene tail_beam -o new.toml --dimension-error '20 %' | --dimension-error
65 | calibrate few_blows.csv --scene tail_beam -o new.toml --set exact=sensor,filters | exact
65 | calibrate other_beam.csv --scene taps.toml -o new.toml | must explain the impacts
65 | calibrate other_beam.csv --scene tail_beam --sensor 0.5,0.45 --sensor 1,1 -o new.toml | by --sensor X,Y
65 | calibrate other_beam.csv --scene tail_beam --sensor 0.5,9 -o new.toml | sensor_point.y
65 | calibrate other_beam.csv --scene taps.toml --sensor 0.5,0.45 -o new.toml | dimensions of a beam
65 | calibrate other_beam.csv --scene taps_on_node.toml -o new.toml | sensor_point
65 | calibrate other_beam.csv --scene fast.toml -o new.toml | sampling.sampling_rate
65 | calibrate good.csv --scene tail_beam -o new.toml | acceleration
65 | calibrate acceleration.csv --scene tail_beam -o new.toml | anti_alias
65 | calibrate few_blows.csv --scene tail_beam -o new.toml --set start_error=near | start_error
65 | calibrate few_blows.csv --scene tail_beam -o new.toml --set start_error='30 %' | start_error
73 | calibrate few_blows.csv --scene tail_beam -o site.csv | site.csv
73 | calibrate few_blows.csv --scene tail_beam -o modes.toml | modes.toml
66 | calibrate gone.wav --scene tail_beam -o new.toml | gone.wav
65 | tap silent_taps.csv -o new.csv | silent_taps.csv
65 | tap blow.wav --hammer 1 -o new.csv | --set channels.1.full_scale='5 kN'
65 | invert blow.wav --modes modes.csv | give --set full_scale='500 g'
65 | tap double_taps.csv -o new.csv | double tap
65 | tap clipped_taps.csv -o new.csv | 2 clipped
65 | tap short_taps.csv -o new.csv | too close to the end
65 | tap nan_taps.csv -o new.csv | nan_taps.csv
65 | tap good.csv -o new.csv | --hammer
66 | tap gone.wav -o new.csv | gone.wav
65 | tap - -o new.csv | stdin
65 | tap two.h5 -o new.csv | two.h5
65 | tap two_taps.csv -o new.csv --hammer 2 | --channel
65 | tap two_taps.csv -o new.csv --hammer 1 | --hammer
65 | tap two_taps.csv -o new.csv --band 900 100 | band
65 | tap two_taps.csv -o new.csv --band 100 20000 | --band
65 | tap two_taps.csv -o new.csv --band 6000 7000 | 6000
65 | tap two_taps.csv -o new.csv --set contact=-1 | contact
65 | tap two_taps.csv -o new.csv --taps tap_times.csv | 7.5 s
65 | tap two_taps.csv -o new.csv --taps tap_table.csv | tap_table.csv
65 | tap two_taps.csv -o new.csv --taps places.csv | --hammer
65 | tap two_taps.csv -o new.csv --sensor 0.1,0.1 | --taps
65 | tap hammered.csv --hammer 2 -o new.csv --taps two_places.csv | --sensor
65 | tap hammered.csv --hammer 2 -o new.csv --taps two_places.csv --sensor here | --sensor
65 | tap hammered.csv --hammer 2 -o new.csv --taps two_places.csv --sensor 0.1,0.1 | 6 places
65 | tap hammered.csv --hammer 2 -o new.csv --taps places.csv --sensor 0.1,0.1 | got 3 for 2 taps
65 | tap hammered.csv --hammer 2 -o new.csv --taps late_places.csv --sensor 0.1,0.1 | 7.5 s
65 | tap hammered.csv --hammer 2 -o new.csv --taps half_places.csv --sensor 0.1,0.1 | half_places.csv
65 | tap hammered.csv --hammer 2 -o new.csv --taps nowhere.csv --sensor 0.1,0.1 | nowhere.csv, line 2
65 | tap two_taps.csv -o new.csv --scene reference | reference
65 | tap two_taps.csv -o new.csv --set start_error=0 | start_error
73 | tap two_taps.csv -o modes.csv | modes.csv
65 | invert two_taps.csv | --modes
65 | invert two_taps.csv --scene tail_beam --modes modes.csv | --scene
65 | invert two_taps.csv --scene reference | reference
65 | invert two_taps.csv --scene tail_beam --band 100 900 | --band
65 | invert two_taps.csv --modes modes.csv --band 900 100 | band
65 | invert two_taps.csv --modes modes.csv --band 6000 7000 | --band
65 | invert two_taps.csv --modes modes.csv --set longest_contact=0 | contact
65 | invert two_taps.csv --modes modes.csv --hammer 1 | --hammer
65 | invert two_taps.csv --modes modes.csv --modes modes.csv | one table for each
65 | invert two_taps.csv --modes tap_times.csv | tap_times.csv
66 | invert two_taps.csv --modes gone.csv | gone.csv
65 | invert silent_taps.csv --modes modes.csv | silent_taps.csv
66 | invert gone.wav --modes modes.csv | gone.wav
65 | invert - --modes modes.csv | stdin
65 | invert two.h5 --modes modes.csv | two.h5
73 | invert two_taps.csv --modes modes.csv -o modes.csv | modes.csv
73 | tap two_taps.csv -o modes.toml | modes.toml
65 | check both.toml | modes or a panel
2 | generate caving.toml --features-only -o new.h5 | leave out --features-only
65 | generate caving.toml -o new.h5 --jobs 2 | --jobs
65 | generate caving.toml -o new.h5 -n 3 | one recording
65 | train caving.toml --features decay_time -o new.npz | stream
2 | generate reference --features peak_force -o new.h5 | --features-only
2 | generate reference --features-only --set dtype=float64 -o new.h5 | dtype
2 | generate reference --features-only --set shard_signals=9 -o new.h5 | shard_signals
2 | generate reference --features-only -o new | .h5
2 | generate reference | -o
65 | generate reference --features-only --features colour -o new.csv | 'colour'
73 | generate reference --parameters-only -n 10 -o good.csv | --overwrite
2 | generate reference.toml --features-only -o new.h5 --jobs 2 | --jobs
2 | generate reference.toml --features-only --quantities impulse -o new.h5 | --features-only
2 | generate reference.toml --json -o new.h5 | --json
66 | check refrence | refrence: no such scene
66 | train referense -o new.npz | did you mean 'reference'
66 | check reference.tml | reference.tml
66 | predict good.csv --model defualt | model
65 | monitor - --set cost_early=-0.5 | cost_early
65 | predict good.csv --set cost_early=nan | cost_early
65 | monitor - --set hold=-3 | hold
65 | predict good.csv --set hold=inf | hold
65 | monitor - --set hold=1e9 | hold
65 | monitor - --set blind_after=1e9 | blind_after
65 | predict good.csv --coal-until 0 | --coal-until
65 | monitor - --coal-until -5s | --coal-until
2 | predict good.csv --coal-until soon | --coal-until
2 | monitor - --coal-until 3kg | --coal-until
65 | predict good.csv --set cycle_pause=60 | --coal-until
65 | monitor - --coal-until 30s --set cycle_pause=0 | cycle_pause
2 | monitor - --set cycle_by=stdin | --coal-until
2 | monitor - --coal-until 30s --set cycle_by=stdin | cycle_by
2 | monitor - --coal-until 30s --set cycle_by=mqtt | --mqtt
65 | monitor - --coal-until 30s --set cycle_by=smoke | cycle_by
65 | predict good.csv --set trained_seam=true --coal-until 3 | trained_seam
65 | predict good.csv --labelled two_manifests/manifest.csv | labelled coal
65 | predict good.csv --labelled good.csv | good.csv
66 | monitor - --set labelled=none.csv | none.csv
65 | monitor - --set give_up=0 | give_up
65 | predict good.csv --set give_up=nan | give_up
65 | monitor - --set dilution_cost=0 | dilution_cost
65 | monitor - --set dilution_cost=nan | dilution_cost
65 | predict good.csv --set dilution_cost=-2 | dilution_cost
65 | predict good.csv --set gangue=gange | did you mean 'gangue'
2 | check | --list
66 | verify nothing.h5 | nothing.h5
65 | verify two.h5 --set laws=exits.py | SystemExit
65 | check reference.toml --set laws=exits.py | SystemExit
65 | check reference.toml --set laws=lawless.py | must have a class
65 | check reference.toml --set laws=lawless | give lawless.py
65 | check reference.toml --set laws=no/law.py | no/law.py
66 | export nothing.h5 -o new.h5 | nothing.h5
65 | export reference.toml -o new.h5 | reference.toml
73 | export two.h5 -o two.h5 --overwrite | two.h5
73 | export two.h5 -o truncated.h5 | truncated.h5
73 | features good.csv -o ./good.csv --overwrite | one of the inputs
73 | predict good.csv --report good.csv | one of the inputs
73 | generate reference.toml -o reference.toml --overwrite | one of the inputs
73 | events good.csv -o m_same.csv --overwrite | 2 labels
73 | export two.h5 -o new.csv | new.csv
65 | export truncated.h5 -o new.h5 | truncated.h5
66 | export-model gone.npz --to c -o new.c | gone.npz
65 | export-model two.h5 --to c -o new.c | two.h5
73 | export-model model.npz --to c -o new.h | new.h
73 | export-model model.npz --to c -o no/new.c | no
65 | export-model wide.npz --to c -o new.c | --features
2 | export-model model.npz -o new.c | --to
2 | export-model model.npz --to java -o new.java | java
2 | generate reference.toml --features-only -o new.csv --resume | --resume
73 | generate reference.toml -o two.h5 --resume | two.h5
65 | generate reference.toml -o truncated.h5 --resume | truncated.h5
65 | generate caving.toml -o two.h5 --resume | two.h5
73 | generate reference.toml -o unfinished | unfinished
73 | generate reference.toml -o . --overwrite | other files in it
65 | generate reference.toml -o new --set scheduler=here | 'here'
2 | generate reference.toml -o new --jobs 2 --set scheduler=tcp://127.0.0.1:1 | --jobs
2 | foretell | foretell
2 | predict | FILE
"""


def _rows(text: str) -> list[list[str]]:
    return [[cell.strip(" ") for cell in re.split(r" \|(?: |$)", line)] for line in text.strip("\n").splitlines()]


def _commands() -> Iterator[Case]:
    for code, arguments, word in _rows(_COMMANDS):
        yield Case(arguments, tuple(shlex.split(arguments)), int(code), (word,))
    for number, (scene, _, new, word) in enumerate(_rows(_SCENES)):
        yield Case(f"{scene} with {new}", ("check", f"scene{number}.toml"), 65, (word,))
    for name, (_, word) in (_SPECTRA | _TABLES).items():
        if word:
            yield Case(f"table {name}", ("check", f"{name}.toml"), 65, (word,))
    for name, word in zip(
        _LAWS, ("pulls = True", "energy", "finite", "approach", "numbers", "differ", "Zero", "SystemExit", "TypeError"),
        strict=True,
    ):  # fmt: skip
        yield Case(f"law {name}", ("check", f"{name}.toml", "--set", f"laws={name}.py"), 65, (f"law {name}: ", word))
    for command in (("verify",), ("export", "-o", "new.h5"), ("train", "-o", "new.npz")):
        yield Case(f"{command[0]} a name too long", (command[0], "n" * 300, *command[1:]), 66, ("nnn",))
    yield Case(
        "line break in a name", ("predict", "no\ncgid: error: forged.csv"), 66, ("no\\ncgid: error: forged.csv",)
    )
    for row in RECORDING_CASES:
        yield Case(*row)


CASES = tuple(_commands())


def main() -> None:
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
