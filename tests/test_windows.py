"""Features of windows: closed forms of tones, noise and blows, scipy's spectra, sums by hand, gain, and bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import signal, stats
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from cgid.errors import BadData
from cgid.measure.features.extraction import choose, extract_array, supported
from cgid.measure.features.windows import CORRELATION_LAGS, FRAME_TIME, WINDOW_THIRD_OCTAVES, WindowBatch
from cgid.measure.spectra import EVEN_BANDS, MEL_BANDS, third_octave
from cgid.recordings import read_recording

RATE = 44_100.0
N_SAMPLES = 4410
ALL = choose(None, "window")
NAMES = supported(ALL, RATE, N_SAMPLES)
TIME = np.arange(N_SAMPLES) / RATE


def measure(samples, names=NAMES, rate=RATE, **options):
    """One window's features by name."""
    return dict(zip(names, extract_array(samples, rate, names, **options)[0].tolist(), strict=True))


@pytest.fixture(scope="module")
def rustle():
    """Windows of noise through a resonance, with blows of all strengths."""
    random = np.random.default_rng(3)
    force = random.normal(size=40 * N_SAMPLES) * (random.random(40 * N_SAMPLES) < 0.01)
    rung = signal.lfilter([1.0], [1.0, -1.6, 0.9], force) + 0.05 * random.normal(size=force.size)
    return rung.reshape(40, N_SAMPLES).astype(np.float32)


# -- closed forms ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frequency", [400.0, 2150.0, 9800.0])
def test_a_tone_is_what_the_textbook_says(frequency):
    found = measure(3.0 * np.sin(2 * np.pi * frequency * TIME) + 5.0)
    assert found["window_level"] == pytest.approx(np.log10(4.5), abs=1e-4)
    assert found["window_peak"] == pytest.approx(3.0, rel=0.02)
    assert found["window_crest_factor"] == pytest.approx(np.sqrt(2), rel=0.02)
    assert found["window_kurtosis"] == pytest.approx(1.5, rel=1e-3)
    assert found["window_zero_crossing_rate"] == pytest.approx(2 * frequency, abs=11)
    for name in ("centroid", "rolloff_50", "dominant_frequency"):
        assert found[f"window_{name}"] == pytest.approx(frequency, abs=30), name
    # A Hann bell of T has a line of standard deviation 1 / (sqrt(3) T).
    assert found["window_spread"] == pytest.approx(1 / (np.sqrt(3) * FRAME_TIME), rel=0.1)
    assert found["window_envelope_variation"] < 0.25
    assert found["window_blow_rate"] == 0


def test_white_noise_is_flat():
    random = np.random.default_rng(1)
    table = extract_array(random.normal(0, 2.0, (80, N_SAMPLES)), RATE, NAMES)
    found = dict(zip(NAMES, table.mean(axis=0), strict=True))
    assert found["window_level"] == pytest.approx(np.log10(4.0), abs=0.005)
    assert found["window_kurtosis"] == pytest.approx(3, abs=0.03)
    assert found["window_centroid"] == pytest.approx(RATE / 4, rel=0.01)
    assert found["window_spread"] == pytest.approx(RATE / 2 / np.sqrt(12), rel=0.01)
    assert found["window_spectral_skewness"] == pytest.approx(0, abs=0.02)
    assert found["window_spectral_kurtosis"] == pytest.approx(1.8, abs=0.03)
    assert found["window_rolloff_85"] == pytest.approx(0.85 * RATE / 2, rel=0.01)
    assert found["window_zero_crossing_rate"] == pytest.approx(RATE / 2, rel=0.01)
    for name in ("1000", "4000", "12500"):
        low, high = third_octave(WINDOW_THIRD_OCTAVES.index(name))
        # The mean of a logarithm lies below the logarithm of a mean: less, the more bins a band has.
        assert found[f"window_level_{name}_hz"] == pytest.approx(np.log10(4 * (high - low) / (RATE / 2)), abs=0.06)
    widths = (EVEN_BANDS.corners[2:] - EVEN_BANDS.corners[:-2]) / 2
    assert found["window_even_6000_hz"] < np.log10(4 * widths[39] / (RATE / 2)) < found["window_even_6000_hz"] + 0.25
    # Levels of one band of one frame: as of chi-square with few degrees of freedom, narrower bands the fewer.
    assert found["window_even_deviation_6000_hz"] > found["window_mel_deviation_12385_hz"]


def test_a_gain_moves_levels_only(rustle):
    once, louder = (measure(gain * rustle[:1].astype(float)) for gain in (1.0, 2.0))
    for name in NAMES:
        if name == "window_peak":
            assert louder[name] == pytest.approx(2 * once[name])
        elif name.startswith(("window_level", "window_mel", "window_even")) and "deviation" not in name:
            assert louder[name] == pytest.approx(once[name] + np.log10(4.0), abs=1e-9), name
        else:
            assert louder[name] == pytest.approx(once[name], rel=1e-9, abs=1e-9), name


def test_flatness_is_that_of_the_mean_spectrum(rustle):
    batch = WindowBatch(rustle, RATE)
    for row, flatness in zip(batch.spectrum.energy, batch.spectrum.flatness, strict=True):
        assert flatness == pytest.approx(np.log10(stats.gmean(row[1:]) / row[1:].mean()))


def test_blows_are_counted_and_envelopes_decay():
    blows = np.zeros(N_SAMPLES)
    blows[np.arange(8) * 540 + 200] = 1.0
    decay, tone = 1.5e-3, 6000.0
    pole = np.exp((-1 / decay + 2j * np.pi * tone) / RATE)
    found = measure(signal.lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], blows))
    assert found["window_blow_rate"] == pytest.approx(80, abs=1)
    assert found["window_dominant_frequency"] == pytest.approx(tone, abs=30)
    assert found["window_envelope_correlation_2_ms"] > found["window_envelope_correlation_5_ms"]
    slower = np.exp((-1 / 6e-3 + 2j * np.pi * tone) / RATE)
    longer = measure(signal.lfilter([1.0], [1.0, -2 * slower.real, abs(slower) ** 2], blows))
    assert longer["window_envelope_correlation_2_ms"] > found["window_envelope_correlation_2_ms"]
    assert longer["window_envelope_range"] < found["window_envelope_range"]


def test_envelope_statistics_are_those_of_the_envelope(rustle):
    """By hand, in steps of 44 samples."""
    for row in rustle[:5].astype(np.float64):
        found = measure(row)
        row = row - row.mean()
        envelope = np.array([np.sqrt(np.mean(row[44 * k : 44 * k + 44] ** 2)) for k in range(100)])
        assert found["window_envelope_variation"] == pytest.approx(envelope.std() / envelope.mean())
        assert found["window_envelope_skewness"] == pytest.approx(stats.skew(envelope))
        assert found["window_envelope_kurtosis"] == pytest.approx(stats.kurtosis(envelope, fisher=False))
        low, middle, high = np.log10(np.quantile(envelope, [0.1, 0.5, 0.9]))
        assert found["window_envelope_range"] == pytest.approx(high - low, abs=0.02)
        assert found["window_envelope_crest"] == pytest.approx(np.log10(envelope.max()) - middle, abs=0.01)
        shifted = envelope - envelope.mean()
        for lag in CORRELATION_LAGS:
            steps = round(lag * 1e3)
            expected = np.sum(shifted[steps:] * shifted[:-steps]) / np.sum(shifted**2)
            assert found[f"window_envelope_correlation_{steps}_ms"] == pytest.approx(expected)


# -- bands ----------------------------------------------------------------------------------------------------


def dense(bands, frequency):
    """Weights of every band at every frequency, one triangle after the other."""
    corners = zip(bands.corners, bands.corners[1:], bands.corners[2:], strict=False)
    return np.array([np.interp(frequency, three, [0.0, 1.0, 0.0]) for three in corners])


def test_log_bands_are_those_of_scipys_spectrogram(rustle):
    """Mean and deviation over the frames, from scipy's short-time transform and plain weights."""
    length = round(FRAME_TIME * RATE)
    bell = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
    table = dict(zip(NAMES, extract_array(rustle, RATE, NAMES).T, strict=True))
    swing = rustle - rustle.mean(axis=1, keepdims=True, dtype=np.float64)
    frequency, _, power = signal.spectrogram(
        swing, RATE, window=bell, noverlap=length - length // 2, nfft=896, detrend=False, scaling="density"
    )
    for of, bands in (("mel", MEL_BANDS), ("even", EVEN_BANDS)):
        bands = bands.within(RATE / 2)
        levels = np.log10(np.einsum("rft,bf->rbt", power, dense(bands, frequency)) * frequency[1])
        for number in range(0, len(bands), 7):
            name = f"{bands.centres[number]:.0f}_hz"
            np.testing.assert_allclose(table[f"window_{of}_{name}"], levels[:, number].mean(axis=1), atol=1e-9)
            np.testing.assert_allclose(table[f"window_{of}_deviation_{name}"], levels[:, number].std(axis=1), atol=1e-9)


# -- nothing but what is asked, and each row by itself --------------------------------------------------------


def test_a_row_is_the_same_whatever_else_is_in_the_batch(rustle):
    whole = extract_array(rustle, RATE, NAMES)
    for rows in ([0], [7], [3, 4], list(range(30))):
        np.testing.assert_array_equal(extract_array(rustle[rows], RATE, NAMES), whole[rows])
    np.testing.assert_array_equal(extract_array(rustle[::-1], RATE, NAMES)[::-1], whole)


# -- bad input ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, 1.0, -7.5e30, 1e-300])
def test_a_window_without_signal_is_refused(value):
    with pytest.raises(BadData, match="a window must contain a signal, all its samples are"):
        extract_array(np.full(N_SAMPLES, value), RATE, NAMES)


def test_good_windows_are_measured_beside_bad_ones(rustle):
    spoilt = rustle.copy()
    spoilt[[0, 17, 39]] = 0
    found = extract_array(spoilt, RATE, NAMES, invalid="nan")
    assert np.isnan(found[[0, 17, 39]]).all()
    good = np.setdiff1d(np.arange(40), [0, 17, 39])
    np.testing.assert_array_equal(found[good], extract_array(rustle, RATE, NAMES)[good])
    with pytest.raises(BadData, match=r"signal 0: a window must contain a signal.*\(3 of 40 signals"):
        extract_array(spoilt, RATE, NAMES)


@pytest.mark.parametrize("shape", ["click", "half silence", "square", "ramp", "clipped", "quantised", "tiny", "huge"])
@pytest.mark.parametrize("rate", [10_000.0, 44_100.0, 100_000.0])
def test_whatever_moves_has_numbers(shape, rate):
    n = round(0.05 * rate)
    noise = np.random.default_rng(0).normal(size=n)
    samples = {
        "click": np.eye(1, n, n // 2)[0],
        "half silence": np.where(np.arange(n) < n // 2, 0.0, noise),
        "square": np.where(np.arange(n) % 40 < 20, 1.0, -1.0),
        "ramp": np.arange(n, dtype=np.float64),
        "clipped": np.clip(100 * noise, -1, 1),
        "quantised": np.round(0.4 * noise),
        "tiny": 1e-60 * noise,
        "huge": 1e60 * noise,
    }[shape]
    names = supported(ALL, rate, n)
    assert np.isfinite(extract_array(samples, rate, names)).all()


@settings(max_examples=40, deadline=None)
@given(arrays(np.float32, (2, 500), elements=st.floats(-1e6, 1e6, width=32)))
def test_any_finite_window_is_measured_or_refused(samples):
    names = supported(ALL, 20_000.0, 500)
    found = extract_array(samples, 20_000.0, names, invalid="nan")
    for row in found:
        assert np.isfinite(row).all() or np.isnan(row).all()


def test_materials_on_a_ramp_are_told_apart(real_data):
    """Each of 15 recordings of five materials judged by the others; what tells them needs finer bands than mel ones."""
    files = sorted((real_data / "bulk_ramp").glob("*_[0-9].wav"))
    rows, labels, group = [], [], []
    for number, file in enumerate(files):
        samples = read_recording(file, channel=1)[0].samples
        windows = samples[: samples.size // N_SAMPLES * N_SAMPLES].reshape(-1, N_SAMPLES)
        rows.append(extract_array(windows, RATE, NAMES))
        labels += [file.stem[:-2]] * len(windows)
        group += [number] * len(windows)
    table, truth, left_out = np.concatenate(rows), np.array(labels), np.array(group)
    share = {}
    for of in ("mel", "even"):
        names = [name for name in NAMES if name.startswith((f"window_relative_{of}", f"window_{of}_deviation"))]
        columns = table[:, [NAMES.index(name) for name in names]]
        hits = []
        for number in range(len(files)):
            learner = make_pipeline(StandardScaler(), LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"))
            test = left_out == number
            hits.append(learner.fit(columns[~test], truth[~test]).predict(columns[test]) == truth[test])
        share[of] = np.concatenate(hits).mean()
    assert share["mel"] > 0.7
    assert share["even"] > 0.87
