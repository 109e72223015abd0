"""Backgrounds: their spectra and levels as asked, and the same numbers at the same address."""

import json
import os
import warnings

import numpy as np
import pytest
from scipy import integrate, signal
from scipy.io import wavfile

from cgid.errors import BadData, NoInput
from cgid.scene import load_scene, parse_scene, record, synthesise
from cgid.scene.file.sensor import CHUNK
from cgid.scene.synthesis.draws import BLOCK
from cgid.scene.synthesis.noise import background_of, reference_peak
from tests.plan_scenes import PANEL, beam_of
from tests.test_stream import RATE, population
from tests.test_stream import content as stream_content

#: So late and so slow that nothing but background is recorded before.
SILENT = {"arrivals": {"times": ["119 s"]}, "duration": "120 s"}


def frames(background, samples=4096, **changes):
    return parse_scene(
        {
            "name": "frames",
            "impact": {"stiffness": "hertz", "dissipation": "hunt-crossley", "target": "rigid"},
            "sampling": {"sampling_rate": RATE, "samples": samples, "pre_trigger": 16},
            "populations": [population("coal")],
            "background": background,
            **changes,
        }
    )


def recorded(background, seed=0, number=0):
    scene = parse_scene(stream_content(background=background, **SILENT))
    return record(scene, seed, number, dtype="float64")[0].samples[: int(118 * RATE)]


def in_frames(background, samples=4096, block=0, seed=0):
    return background_of(frames(background)).in_frames(seed, block, samples, np.ones(BLOCK))


# ---- hum -------------------------------------------------------------------------------------------------------------


def lines_of(samples):
    """Return amplitude and phase of whole multiples of 1 Hz, of samples of whole seconds."""
    spectrum = np.fft.rfft(samples) / samples.shape[-1] * 2
    step = round(samples.shape[-1] / RATE)
    return spectrum[..., ::step]


def test_hum_of_a_recording_is_lines_of_the_asked_frequencies_and_amplitudes():
    asked = {"hum": [{"frequency": "50 Hz", "amplitude": "2 kN"}, {"frequency": "997 Hz", "amplitude": 30}]}
    lines = np.abs(lines_of(recorded(asked)))
    assert lines[50] == pytest.approx(2000, rel=1e-9) and lines[997] == pytest.approx(30, rel=1e-7)
    lines[[50, 997]] = 0
    assert lines.max() < 1e-6


def test_hum_relative_to_the_peak_has_the_share_of_each_peak():
    asked = {"hum": [{"frequency": "50 Hz", "relative_amplitude": "2 %"}, {"frequency": 150, "amplitude": 3.0}]}
    scene, silent = frames(asked, samples=int(RATE) // 2), frames(None, samples=int(RATE) // 2)
    (hum,), (without,) = synthesise(scene, 64, dtype="float64"), synthesise(silent, 64, dtype="float64")
    lines = np.abs(np.fft.rfft(hum.signals - without.signals)) / (RATE / 4)
    np.testing.assert_allclose(lines[:, 25], 0.02 * without.parameters["peak_force"], rtol=1e-6)
    np.testing.assert_allclose(lines[:, 75], 3.0, rtol=1e-6)


def test_hum_relative_to_the_peak_of_a_motion_is_of_its_largest_sample():
    hum = {"hum": [{"frequency": "60 Hz", "relative_amplitude": 0.1}]}
    scene = beam_of(PANEL, {"quantity": "acceleration"})
    (with_hum,) = synthesise(parse_scene({**json.loads(scene.text), "background": hum}), 16, dtype="float64")
    (without,) = synthesise(scene, 16, dtype="float64")
    largest = np.abs(with_hum.signals - without.signals).max(axis=1) / np.abs(without.signals).max(axis=1)
    np.testing.assert_allclose(largest, 0.1, rtol=1e-3)


# ---- coloured noise --------------------------------------------------------------------------------------------------

COLOURED = {"frequencies": ["50 Hz", "400 Hz", "4 kHz"], "density": [2.0**0.5, 2.0**0.5, 0.02**0.5]}


def asked_density(frequency):
    return np.exp(np.interp(np.log(frequency), np.log([50, 400, 4000]), np.log([2.0, 2.0, 0.02])))


def require_spectrum(samples):
    frequency, density = signal.welch(samples, RATE, nperseg=2560, detrend=False)
    if density.ndim > 1:
        density = density.mean(axis=0)
    segments = samples.size / 2560
    inside = (frequency > 80) & (frequency < 3900)
    ratio = density[inside] / asked_density(frequency[inside])
    # A Welch estimate of overlapping Hann windows scatters by about 1 / sqrt(segments).
    assert abs(ratio.mean() - 1) < 0.01
    assert np.abs(ratio - 1).max() < 6 / np.sqrt(segments) + 0.01
    # At the ends the density falls from its value to nothing: beyond them is only what Hann's window lets through.
    assert density[frequency < 20].max() < 1e-3 and density[frequency > 4060].max() < 1e-6


@pytest.mark.long
def test_the_spectrum_of_a_recording_is_the_asked_one():
    samples = recorded({"coloured": COLOURED})
    require_spectrum(samples)
    # Across the borders of the chunks the power is the same as elsewhere.
    near = np.concatenate([samples[k * CHUNK - 3000 : k * CHUNK + 3000] for k in range(1, 46)])
    assert np.var(near) == pytest.approx(np.var(samples), rel=0.05)


def test_the_spectrum_of_frames_is_the_asked_one():
    require_spectrum(in_frames({"coloured": COLOURED}, samples=5120))


def test_the_level_of_coloured_noise_is_the_integral_of_its_density():
    wanted = integrate.quad(asked_density, 50, 4000, points=[400], epsabs=1e-10, limit=200)[0]
    background = background_of(frames({"coloured": COLOURED}))
    assert background.rms == pytest.approx(np.sqrt(wanted), rel=1e-9)
    assert np.std(recorded({"coloured": COLOURED})) == pytest.approx(background.rms, rel=0.01)


def test_coloured_noise_is_gaussian_and_without_memory_of_the_frame():
    made = in_frames({"coloured": COLOURED}, samples=2048)
    standard = made / made.std()
    assert np.mean(standard**4) == pytest.approx(3.0, rel=0.03)
    # The ends of a frame have nothing to do with each other, as they would in noise of the frame's own period.
    across = np.mean(made[:, 0] * made[:, -1]) / made.var()
    beside = np.mean(made[:, 0] * made[:, 1]) / made.var()
    assert beside > 0.9 and abs(across) < 4 / np.sqrt(BLOCK)


# ---- recordings ------------------------------------------------------------------------------------------------------


def with_recording(folder, samples, rate, **keys):
    wavfile.write(folder / "pump.wav", rate, samples.astype(np.float32))
    return {"recorded": {"path": "pump.wav", "signal_to_noise": "20 dB", **keys}}


def test_the_level_of_a_recorded_background_is_that_of_the_asked_ratio(tmp_path):
    rng = np.random.default_rng(0)
    asked = with_recording(tmp_path, 0.3 + 0.1 * rng.standard_normal(50_000), int(RATE))
    scene = parse_scene({**json.loads(frames(None).text), "background": asked}, folder=tmp_path)
    background = background_of(scene)
    loop = background.in_recording(0, 0, 0)[:50_000]
    assert loop.mean() == pytest.approx(0, abs=1e-3 * loop.std())
    # Against peaks of other seeds than the reference is drawn from.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        peaks = np.concatenate([batch.parameters["peak_force"] for batch in synthesise(scene, 2560, seed=11)])
    ratio = 20 * np.log10(np.median(peaks) / loop.std())
    assert ratio == pytest.approx(20, abs=0.5)
    assert 20 * np.log10(reference_peak(scene) / loop.std()) == pytest.approx(20, abs=1e-6)
    assert background.rms == pytest.approx(loop.std(), rel=1e-9)


def test_a_recording_is_resampled_and_repeated_from_a_random_start(tmp_path):
    # 440 Hz in 44.1 kHz, whole periods: repeated without end it is still one line of 440 Hz.
    times = np.arange(44_100) / 44_100
    asked = with_recording(tmp_path, np.sin(2 * np.pi * 440 * times), 44_100)
    scene = parse_scene(stream_content(background=asked, **SILENT), folder=tmp_path)
    samples = record(scene, dtype="float64")[0].samples[: int(118 * RATE)]
    spectrum = np.abs(np.fft.rfft(samples)) ** 2
    line = 440 * 118
    assert spectrum[line - 3 : line + 4].sum() > 0.999 * spectrum.sum()
    assert np.sqrt(np.mean(samples**2)) == pytest.approx(reference_peak(scene) / 10, rel=1e-3)
    other = record(scene, number=1, dtype="float64")[0].samples[: int(118 * RATE)]
    assert np.abs(samples - other)[:1000].max() > 1e-2 * np.abs(samples).max()


def test_the_file_lies_beside_the_scene(tmp_path, monkeypatch):
    asked = with_recording(tmp_path, np.sin(np.arange(1000.0)), 25_600)
    text = (
        'name = "pump"\n[impact]\nstiffness = "hertz"\ndissipation = "elastic"\ntarget = "rigid"\n'
        '[sampling]\nsampling_rate = "25.6 kHz"\nsamples = 64\npre_trigger = 16\n'
        '[[populations]]\nlabel = "coal"\ndensity = 1400\nyoungs_modulus = "3 GPa"\npoisson_ratio = 0.3\n'
        'radius = "25 mm"\nvelocity = 4\n[background.recorded]\npath = "pump.wav"\nsignal_to_noise = "6 dB"\n'
    )
    (tmp_path / "pump.toml").write_text(text)
    monkeypatch.chdir("/")
    scene = load_scene(tmp_path / "pump.toml")
    (batch,) = synthesise(scene, 4)
    assert batch.signals[:, :16].std() > 0
    assert asked["recorded"]["path"] in scene.text and str(tmp_path) not in scene.text
    assert parse_scene(json.loads(scene.text)) == scene


@pytest.mark.parametrize(
    ("write", "error", "says"),
    [
        (lambda path: None, NoInput, "must exist"),
        (lambda path: path.write_bytes(b"RIFF"), BadData, "WAV"),
        (lambda path: path.symlink_to("/dev/null"), BadData, "a recorded background must be a regular file"),
        (lambda path: (path.touch(), os.truncate(path, 2 << 30)), BadData, "at most 1024 MiB, it has 2048 MiB"),
        (lambda path: wavfile.write(path, 8000, np.full(100, 0.5, np.float32)), BadData, "must not be constant"),
        (lambda path: wavfile.write(path, 8000, np.zeros((100, 2), np.float32)), BadData, "recorded.channel"),
    ],
)
def test_recordings_that_cannot_be_used(tmp_path, write, error, says):
    write(tmp_path / "pump.wav")
    asked = {"recorded": {"path": "pump.wav", "signal_to_noise": 20}}
    scene = parse_scene(stream_content(background=asked), folder=tmp_path)
    with pytest.raises(error, match=says):
        background_of(scene)


# ---- all of them -----------------------------------------------------------------------------------------------------

ALL = {"hum": [{"frequency": "50 Hz", "amplitude": "20 N"}], "coloured": COLOURED}


def test_the_same_address_gives_the_same_numbers():
    scene = frames(ALL, samples=256)
    whole = np.concatenate([batch.signals for batch in synthesise(scene, 700, 3)])
    part = np.concatenate([batch.signals for batch in synthesise(scene, 300, 3, first=200)])
    np.testing.assert_array_equal(part, whole[200:500])
    without = np.concatenate([batch.signals for batch in synthesise(frames(None, samples=256), 700, 3)])
    np.testing.assert_allclose(
        whole - without, np.concatenate([in_frames(ALL, 256, block, 3) for block in range(3)])[:700], atol=0.01
    )


def test_a_stream_has_no_peak_that_its_hum_is_relative_to():
    asked = {"hum": [{"frequency": 50, "relative_amplitude": 0.1}]}
    with pytest.raises(BadData, match=r"^scene: background\.hum\.0\.relative_amplitude: must be left out of a stream"):
        parse_scene(stream_content(background=asked))
