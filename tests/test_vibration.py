"""Features of vibrations: closed forms of one damped mode, scipy filters, sums by hand, noise, gain, and bad input."""

import re
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import integrate, signal

from cgid.errors import BadData
from cgid.measure.features.extraction import FEATURES, choose, extract_array, supported
from cgid.measure.features.vibration import EARLY_TIME, WINDOW_TIME
from cgid.measure.spectra import MEL_BANDS, THIRD_OCTAVES, EnergySpectrum, third_octave
from tests.ringing import N_SAMPLES, PRE_TRIGGER, RATE, damped_sinusoid, ringing_batch

ALL = choose(None, "vibration")
#: Those that frames of 80 ms at 25.6 kHz allow.
NAMES = supported(ALL, RATE, N_SAMPLES)
LEVELS = [name for name in NAMES if name.startswith(("level", "early"))]
SPECTRAL = [name for name in NAMES if any(word in name for word in ("level", "mel_", "vibration", "_frequency"))]


def measure(samples, features=NAMES, rate=RATE, pre_trigger=PRE_TRIGGER, **options):
    """One signal's features by name."""
    names = choose(features)
    values = extract_array(samples, rate, names, pre_trigger=pre_trigger, **options)[0]
    return dict(zip(names, values.tolist(), strict=True))


@pytest.fixture(scope="module")
def rung():
    return ringing_batch(60, seed=4).signals


# -- one damped mode: closed forms ----------------------------------------------------------------------------


@pytest.mark.parametrize(("frequency", "damping"), [(500, 0.03), (1000, 0.02), (3000, 0.01), (8000, 0.01)])
def test_decay_time_is_that_of_the_mode(frequency, damping):
    # The energy falls as exp(-2 zeta omega t), by 10^6 in 3 ln 10 / (zeta omega).
    expected = 3 * np.log(10) / (damping * 2 * np.pi * frequency)
    found = measure(damped_sinusoid(frequency, damping), ["decay_time"])["decay_time"]
    assert found == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("frequency", "damping"), [(1000, 0.02), (3000, 0.01), (8000, 0.005)])
def test_energy_comes_as_in_the_closed_form(frequency, damping):
    # With the window it goes on as 1 - exp(-2 alpha t), give or take a swing of a quarter of a period.
    alpha = damping * 2 * np.pi * frequency + 1 / WINDOW_TIME
    found = measure(damped_sinusoid(frequency, damping), ["energy_rise_50", "energy_rise_90"])
    for share in (50, 90):
        expected = -np.log(1 - share / 100) / (2 * alpha)
        assert found[f"energy_rise_{share}"] == pytest.approx(expected, abs=0.3 / frequency + 1 / RATE)


@pytest.mark.parametrize(("frequency", "damping"), [(1000, 0.01), (3000, 0.005), (8000, 0.003)])
def test_zero_crossings_are_twice_the_frequency(frequency, damping):
    found = measure(damped_sinusoid(frequency, damping), ["zero_crossing_rate", "energy_rise_90"])
    assert found["zero_crossing_rate"] == pytest.approx(2 * frequency, abs=1.5 / found["energy_rise_90"])


@pytest.mark.parametrize(("frequency", "damping"), [(1000, 0.02), (3000, 0.03), (5000, 0.01)])
def test_spectral_shape_is_that_of_the_closed_form(frequency, damping):
    # The samples are two geometric series, p^n and its conjugate: their transforms are 1 / (1 - p z^-1).
    omega = 2 * np.pi * frequency
    samples = damped_sinusoid(frequency, damping)
    first = int(np.argmax(np.abs(samples) > 0.05 * np.abs(samples).max())) - PRE_TRIGGER
    p = np.exp((1j * omega - damping * omega - 1 / WINDOW_TIME) / RATE)
    grid = np.linspace(0, RATE / 2, 400_001)
    z, phase = np.exp(-2j * np.pi * grid / RATE), np.exp(1j * omega * first / RATE)
    density = np.abs(phase / (1 - p * z) - phase.conj() / (1 - p.conj() * z)) ** 2
    mean = np.average(grid, weights=density)
    share = integrate.cumulative_trapezoid(density, grid, initial=0)
    found = measure(samples, ["vibration_centroid", "vibration_spread", "vibration_rolloff"])
    assert found["vibration_centroid"] == pytest.approx(mean, rel=1e-3)
    assert found["vibration_spread"] == pytest.approx(
        np.sqrt(np.average((grid - mean) ** 2, weights=density)), rel=1e-3
    )
    # It lies on the steep flank of a line: a bin is 14 Hz wide.
    assert found["vibration_rolloff"] == pytest.approx(grid[np.searchsorted(share, 0.85 * share[-1])], abs=7)


def test_amplitudes_are_those_of_the_samples():
    samples = damped_sinusoid(900, 0.01) + 7.0
    found = measure(samples, ["peak_amplitude", "strong_rms", "crest_factor", "strong_kurtosis", "energy_rise_90"])
    swing = samples - 7.0
    first = PRE_TRIGGER + int(np.argmax(np.abs(swing[PRE_TRIGGER:]) > 0.05 * np.abs(swing).max()))
    energy = np.cumsum((swing[first:] * np.exp(-np.arange(N_SAMPLES - first) / RATE / WINDOW_TIME)) ** 2)
    strong = swing[first : first + int(np.argmax(energy >= 0.9 * energy[-1])) + 1]
    rms = np.sqrt(np.mean(strong**2))
    assert found["peak_amplitude"] == pytest.approx(np.abs(swing).max(), rel=1e-12)
    assert found["strong_rms"] == pytest.approx(rms, rel=1e-9)
    assert found["crest_factor"] == pytest.approx(np.abs(swing).max() / rms, rel=1e-9)
    assert found["strong_kurtosis"] == pytest.approx(np.mean(strong**4) / np.mean(strong**2) ** 2, rel=1e-9)


@pytest.mark.parametrize("frequency", [300, 800, 2000])
def test_first_maximum_comes_after_a_quarter_of_a_period(frequency):
    found = measure(damped_sinusoid(frequency, 0.01), ["time_to_first_maximum", "time_to_peak"])
    # The onset is where 5 % of the peak is reached: asin(.05) of the quarter is gone by then.
    expected = (0.25 - np.arcsin(0.05) / (2 * np.pi)) / frequency
    assert found["time_to_first_maximum"] == pytest.approx(expected, abs=0.2 / RATE)
    assert found["time_to_peak"] == pytest.approx(expected, abs=0.6 / RATE)


# -- bands ----------------------------------------------------------------------------------------------------


def test_bands_are_those_of_the_standard():
    """Mid-band frequencies agree with their nominal names (IEC 61260-1), and each band begins where one ends."""
    edges = np.array([third_octave(number) for number in range(len(THIRD_OCTAVES))])
    middles = np.sqrt(edges.prod(axis=1))
    assert middles == pytest.approx([float(name) for name in THIRD_OCTAVES], rel=0.01)
    assert middles[THIRD_OCTAVES.index("1000")] == pytest.approx(1000, rel=1e-12)
    assert edges[1:, 0] == pytest.approx(edges[:-1, 1], rel=1e-12)
    assert edges[:, 1] / edges[:, 0] == pytest.approx(np.full(len(edges), 10**0.1), rel=1e-12)


def windowed(samples, first=PRE_TRIGGER):
    return samples[first:] * np.exp(-np.arange(len(samples) - first) / RATE / WINDOW_TIME)


def struck(seed=1):
    """A sum of modes that is above the onset's threshold from its very first sample on."""
    random = np.random.default_rng(seed)
    time = np.maximum(np.arange(N_SAMPLES) - PRE_TRIGGER, 0) / RATE
    modes = np.exp(random.uniform(np.log(60), np.log(11_000), 60))
    swings = np.exp(-0.03 * 2 * np.pi * modes * time[:, None]) * np.cos(2 * np.pi * modes * time[:, None])
    return np.where(np.arange(N_SAMPLES) >= PRE_TRIGGER, swings @ random.normal(1.0, 0.5, modes.size), 0.0)


@pytest.mark.parametrize("middle", ["125", "250", "500", "1000", "2000", "5000", "10000"])
def test_level_is_the_integral_of_the_spectrum_over_the_band(middle):
    """The Fourier integral by a plain sum over samples, on a grid of its own."""
    samples = struck()
    event, time = windowed(samples), np.arange(N_SAMPLES - PRE_TRIGGER) / RATE
    low, high = third_octave(THIRD_OCTAVES.index(middle))
    grid = np.linspace(low, high, 201)
    density = np.abs([np.sum(event * np.exp(-2j * np.pi * f * time)) / RATE for f in grid]) ** 2
    expected = np.log10(2 * np.trapezoid(density, grid))
    # Bins are as wide as the band is over 2 (125 Hz) to 160 (10 kHz).
    tolerance = 0.1 if middle in ("125", "250") else 0.02
    assert measure(samples, [f"level_{middle}_hz"])[f"level_{middle}_hz"] == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("middle", ["500", "1000", "2000", "4000"])
def test_level_is_that_of_a_band_pass_filter(middle):
    """A Butterworth filter's skirts take from the neighbours what its rounded edges lose: half a decibel."""
    samples = struck(2)
    edges = third_octave(THIRD_OCTAVES.index(middle))
    passed = signal.sosfilt(signal.butter(6, edges, "bandpass", fs=RATE, output="sos"), windowed(samples))
    ring_out = np.log10(np.sum(passed**2) / RATE)
    assert measure(samples, [f"level_{middle}_hz"])[f"level_{middle}_hz"] == pytest.approx(ring_out, abs=0.05)


@pytest.mark.parametrize("n_samples", [128, 129, 1000, 1792, 2047])
@pytest.mark.parametrize("finer", [1, 4])
def test_energy_spectrum_keeps_the_energy(n_samples, finer):
    rows = np.random.default_rng(n_samples).normal(size=(3, n_samples))
    spectrum = EnergySpectrum.of(rows, 5000.0, finer)
    expected = np.sum(rows**2, axis=1) / 5000.0
    assert spectrum.total == pytest.approx(expected, rel=1e-12)
    assert spectrum.between(0.0, 2500.0) == pytest.approx(expected, rel=1e-12)
    pieces = sum(spectrum.between(low, high) for low, high in ((0, 0.3), (0.3, 700), (700, 701.3), (701.3, 2500)))
    assert pieces == pytest.approx(expected, rel=1e-12)
    assert spectrum.frequency[[0, -1]] == pytest.approx([0, 2500])
    assert spectrum.energy.shape == (3, spectrum.frequency.size)
    # White noise is spread evenly.
    many = EnergySpectrum.of(np.random.default_rng(0).normal(size=(400, n_samples)), 5000.0, finer)
    share = many.between(500.0, 1500.0).sum() / many.total.sum()
    assert share == pytest.approx(0.4, abs=0.02)


def test_early_level_is_that_of_the_early_window():
    samples = struck(4)
    count = round(EARLY_TIME * RATE)
    part = samples[PRE_TRIGGER : PRE_TRIGGER + count] * np.cos(np.arange(count) / count * np.pi / 2) ** 2
    time = np.arange(count) / RATE
    for low, high in ((1000, 2000), (4000, 8000)):
        grid = np.linspace(low, high, 401)
        density = np.abs([np.sum(part * np.exp(-2j * np.pi * f * time)) / RATE for f in grid]) ** 2
        expected = np.log10(2 * np.trapezoid(density, grid))
        assert measure(samples, [f"early_level_{low}_{high}_hz"]) == pytest.approx(
            {f"early_level_{low}_{high}_hz": expected}, abs=0.02
        )


@pytest.mark.parametrize("band", [8, 15, 24])
def test_a_mode_is_in_its_own_mel_band(band):
    frequency = float(MEL_BANDS.centres[band])
    found = measure(damped_sinusoid(frequency, 0.005))
    relative = {name: value for name, value in found.items() if name.startswith("relative_mel")}
    assert max(relative, key=relative.__getitem__) == f"relative_mel_{frequency:.0f}_hz"
    assert -0.15 < max(relative.values()) <= 0
    assert found[f"mel_{frequency:.0f}_hz"] == pytest.approx(max(relative.values()) + found["level_total"], abs=1e-12)
    assert found["dominant_frequency"] == pytest.approx(frequency, abs=7)


@pytest.mark.parametrize(("frequency", "damping"), [(1000, 0.01), (1000, 0.03), (3078, 0.01)])
def test_energy_of_a_mel_band_comes_as_in_the_closed_form(frequency, damping):
    # Of exp(-2 alpha t) in the mean after 1 / (2 alpha); a bell about the onset has half of its first energy before it.
    alpha = damping * 2 * np.pi * frequency + 1 / WINDOW_TIME
    found = measure(damped_sinusoid(frequency, damping), [f"mel_delay_{frequency}_hz"])
    assert found[f"mel_delay_{frequency}_hz"] == pytest.approx(1 / (2 * alpha), rel=0.15, abs=4e-4)


def test_levels_without_gain_are_the_levels_less_the_whole(rung):
    table = dict(zip(NAMES, extract_array(rung, RATE, NAMES, pre_trigger=PRE_TRIGGER).T, strict=True))
    relative = [name for name in NAMES if name.startswith("relative_")]
    assert {name.split("_")[1] for name in relative} == {"level", "early", "mel"}
    for name in relative:
        assert table[name] == pytest.approx(table[name.removeprefix("relative_")] - table["level_total"], abs=1e-12)


# -- noise ----------------------------------------------------------------------------------------------------


def test_noise_does_not_move_levels_that_stand_above_it():
    clean = struck(5)
    random = np.random.default_rng(6)
    noisy = clean + 0.02 * np.abs(clean).max() * random.normal(size=(300, N_SAMPLES))
    names = ["level_total", "level_500_hz", "level_2000_hz", "level_5000_hz", "early_level_2000_4000_hz"]
    bias = extract_array(noisy, RATE, names, pre_trigger=PRE_TRIGGER).mean(axis=0)
    assert bias - extract_array(clean, RATE, names, pre_trigger=PRE_TRIGGER)[0] == pytest.approx(np.zeros(5), abs=0.02)


def test_a_band_without_vibration_is_at_the_noise():
    random = np.random.default_rng(7)
    noise = 0.5
    samples = damped_sinusoid(200, 0.02) + noise * random.normal(size=(300, N_SAMPLES))
    found = extract_array(samples, RATE, ["level_8000_hz"], pre_trigger=PRE_TRIGGER)[:, 0]
    low, high = third_octave(THIRD_OCTAVES.index("8000"))
    # Noise of this deviation has noise^2 / (rate / 2) of power in every Hz; the window lasts WINDOW_TIME / 2.
    expected = np.log10(noise**2 * (high - low) / (RATE / 2) * WINDOW_TIME / 2)
    assert found.min() > expected - 0.2  # its own samples before touch say what the noise is
    assert found.mean() == pytest.approx(expected, abs=0.1)


def test_ringing_before_touch_is_no_reason_for_nonsense():
    """What is before touch may be as strong as the blow: half the energy is left at least."""
    samples = damped_sinusoid(1000, 0.02, amplitude=3.0) + np.random.default_rng(9).normal(0, 1.0, (50, N_SAMPLES))
    louder = samples.copy()
    louder[:, :PRE_TRIGGER] *= 3
    names = ["decay_time", "energy_rise_50", "energy_rise_90", "strong_rms"]
    found = extract_array(louder, RATE, names, pre_trigger=PRE_TRIGGER, detection_limit=1.0)
    assert (found[:, 0] > 0.01).all()
    assert (found[:, 2] > found[:, 1]).all()
    assert found[:, 3] == pytest.approx(np.full(50, 2.0), rel=0.4)


# -- gain, sign, length ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [1e-3, 9.80665, 1e4])
def test_gain_moves_each_feature_as_its_unit_says(gain, rung):
    once = extract_array(rung.astype(float), RATE, NAMES, pre_trigger=PRE_TRIGGER)
    more = extract_array(gain * rung.astype(float), RATE, NAMES, pre_trigger=PRE_TRIGGER)
    for name, before, after in zip(NAMES, once.T, more.T, strict=True):
        expected = {"U": before * gain, "log10(U^2 s)": before + 2 * np.log10(gain)}.get(FEATURES[name].unit, before)
        assert after == pytest.approx(expected, rel=1e-7, abs=1e-9), name


def test_which_way_up_a_sensor_sits_is_of_no_matter(rung):
    for pre_trigger in (PRE_TRIGGER, None):
        upright, turned = (extract_array(sign * rung, RATE, NAMES, pre_trigger=pre_trigger) for sign in (1, -1))
        assert np.array_equal(upright, turned)


def test_an_offset_changes_nothing(rung):
    names = [name for name in NAMES if FEATURES[name].unit != "1"]
    for pre_trigger in (PRE_TRIGGER, None):
        frames = rung.astype(float)
        plain, shifted = (extract_array(frames + offset, RATE, names, pre_trigger=pre_trigger) for offset in (0.0, 1e3))
        assert shifted == pytest.approx(plain, rel=1e-5, abs=1e-6)
    assert measure(rung[0] + 50.0, ["peak_amplitude"], remove_baseline=False)["peak_amplitude"] > 50


def test_time_scales_each_feature_as_its_unit_says():
    """At a tenth of the rate everything takes ten times as long; the window, of fixed length, is not looked through."""
    samples = damped_sinusoid(3000, 0.1)
    names = ["decay_time", "time_to_first_maximum", "time_to_peak"]
    fast, slow = (extract_array(samples, rate, names, pre_trigger=PRE_TRIGGER)[0] for rate in (RATE, RATE / 10))
    assert slow == pytest.approx(10 * fast, rel=1e-9)


@pytest.mark.parametrize("after", [0.03, 0.05])
def test_a_frame_cut_short_is_measured_alike(after):
    """A blow soon after, or the end of the recording: what weighs little is missing."""
    frames = ringing_batch(40, seed=9, noise=0.003).signals
    cut = frames.copy()
    cut[:, PRE_TRIGGER + int(after * RATE) :] = 0.0
    names = [name for name in LEVELS if "early" in name or float(name.split("_")[1].replace("total", "1e3")) >= 200]
    whole, part = (extract_array(rows, RATE, names, pre_trigger=PRE_TRIGGER) for rows in (frames, cut))
    assert np.abs(whole - part).max() < 0.1
    longer = np.pad(frames, ((0, 0), (0, 4096)))
    # In a longer frame the transform has other bins.
    assert np.abs(extract_array(longer, RATE, names, pre_trigger=PRE_TRIGGER) - whole).max() < 0.15


@pytest.mark.parametrize("kind", ["vibration", "window"])
def test_what_depends_on_the_rate_says_so(kind):
    """Bands are left out: those about half of the lower rate see what is mirrored there."""
    names = [n for n in supported(choose(None, kind), RATE, round(0.3 * RATE)) if not re.search(r"_hz$|\d$", n)]
    found = []
    for rate in (RATE, 4 * RATE):
        time = np.arange(round(0.3 * rate)) / rate - 0.1
        after = np.maximum(time, 0.0)
        modes = ((1.0, 900, 60), (0.5, 2300, 150), (0.3, 5200, 300))
        rung = sum(a * np.exp(-decay * after) * np.sin(2 * np.pi * f * after) for a, f, decay in modes)
        rung += 1e-9 * np.random.default_rng(0).normal(size=time.size)
        found.append(extract_array(rung, rate, names, pre_trigger=None if kind == "window" else round(0.09 * rate))[0])
    changed = {name for name, a, b in zip(names, *found, strict=True) if abs(a - b) > 0.12 * max(abs(a), abs(b), 1e-4)}
    said = {name for name in names if "half the sampling rate, on which it depends" in FEATURES[name].definition}
    assert changed == said
    assert len(said) == 3
    (kurtosis,) = (row for row, name in enumerate(names) if name in ("vibration_kurtosis", "window_spectral_kurtosis"))
    assert found[1][kurtosis] > 2.5 * found[0][kurtosis]


# -- batches --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pre_trigger", [None, PRE_TRIGGER])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_row_is_the_same_to_the_last_bit_whatever_else_is_in_the_batch(pre_trigger, kind, rung):
    rows = rung.astype(kind)
    rows[7] = damped_sinusoid(70, 0.01)  # far longer than the others
    together = extract_array(rows, RATE, NAMES, pre_trigger=pre_trigger)
    alone = np.concatenate([extract_array(row, RATE, NAMES, pre_trigger=pre_trigger) for row in rows])
    few = np.concatenate(
        [extract_array(rows[k : k + 7], RATE, NAMES, pre_trigger=pre_trigger) for k in range(0, 60, 7)]
    )
    assert np.array_equal(together, alone)
    assert np.array_equal(together, few)


# -- what cannot be measured ----------------------------------------------------------------------------------


def test_bad_rows_become_nan_and_no_other(rung):
    spoilt = rung.copy()
    spoilt[3], spoilt[11] = 0.0, np.random.default_rng(1).normal(size=N_SAMPLES)
    found = extract_array(spoilt, RATE, NAMES, pre_trigger=PRE_TRIGGER, invalid="nan")
    assert np.flatnonzero(np.isnan(found).any(axis=1)).tolist() == [3, 11]
    good = np.setdiff1d(np.arange(len(rung)), [3, 11])
    assert np.array_equal(found[good], extract_array(rung, RATE, NAMES, pre_trigger=PRE_TRIGGER)[good])
    with pytest.raises(BadData, match=r"^signal 3: no impact.*\(2 of 60 signals cannot"):
        extract_array(spoilt, RATE, NAMES, pre_trigger=PRE_TRIGGER)


# -- anything at all ------------------------------------------------------------------------------------------

JUNK = st.one_of(
    arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(6, 80)), elements=st.integers(-3, 9).map(float)),
    arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(6, 80)), elements=st.floats(-1e12, 1e12)),
    arrays(np.float32, st.tuples(st.integers(1, 3), st.integers(6, 80)), elements=st.floats(-1, 1, width=32)),
)


@settings(max_examples=200, deadline=None)
@given(JUNK, st.one_of(st.none(), st.integers(0, 5)), st.booleans())
def test_junk_is_measured_or_refused(samples, pre_trigger, remove_baseline):
    rate = 4000.0
    names = supported(ALL, rate, samples.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = extract_array(
            samples, rate, names, pre_trigger=pre_trigger, remove_baseline=remove_baseline, invalid="nan"
        )
    refused = np.isnan(found).all(axis=1)
    assert np.isfinite(found[~refused]).all()
    assert (found[~refused, names.index("time_to_first_maximum")] > 0).all()
    assert (found[~refused, names.index("energy_rise_50")] > 0).all()


def test_the_window_of_a_low_rate_is_longer():
    """At 500 Hz it is .17 of 175 samples: energies as in the closed form, and lines that narrow."""
    rate, before, frequency, damping = 500.0, 10, 40.0, 0.005
    time = np.arange(180) / rate
    ring = np.exp(-damping * 2 * np.pi * frequency * time) * np.cos(2 * np.pi * frequency * time)
    samples = np.concatenate([np.zeros(before), ring])[None] + 1e-9 * np.sin(np.arange(190))
    found = measure(samples, ["level_total", "level_40_hz", "level_25_hz"], rate, before)
    alpha = damping * 2 * np.pi * frequency + 1 / (0.17 * 175 / rate)
    energy = np.sum(np.square(ring * np.exp(-time / 0.0595))) / rate
    assert found["level_total"] == pytest.approx(np.log10(energy), abs=0.01)
    # A Lorentzian of this half width [Hz] about the frequency.
    half, inside, beside = alpha / (2 * np.pi), *map(THIRD_OCTAVES.index, ("40", "25"))
    shares = [np.diff(np.arctan((np.array(third_octave(k)) - frequency) / half)).item() for k in (inside, beside)]
    assert found["level_25_hz"] - found["level_40_hz"] == pytest.approx(np.log10(shares[1] / shares[0]), abs=0.15)
