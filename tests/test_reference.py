"""Reference runs: what a gain and an unknown response cost, what makes up for them, and what drift is warned of."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from cgid.identification.model.reference import MAX_DRIFT, MeanSpectrum, drift
from cgid.identification.prediction.stream import Drifts
from cgid.measure.features.extraction import choose, extract_array, supported
from cgid.measure.filters import Equalisation
from cgid.measure.spectra import MEL_BANDS
from cgid.recordings import read_recording

RATE = 25_600.0
N_BANDS = len(MEL_BANDS)
WINDOW = supported(choose(None, "window"), RATE, 2560)


def flow(seed, frequency, n_windows=120, rate=RATE, decay=400.0, noise=0.3):
    """A record of blows that come at random, ring about a frequency and overlap, in windows of .1 s."""
    random = np.random.default_rng(seed)
    n = int(0.1 * rate)
    force = random.exponential(1.0, n_windows * n) * (random.random(n_windows * n) < 100 / rate)
    pole = np.exp((-decay + 2j * np.pi * frequency) / rate)
    struck = signal.lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], force)
    return (struck + noise * random.normal(size=struck.size)).reshape(n_windows, n)


def spectrum_of(windows, rate=RATE):
    run = MeanSpectrum(rate)
    run.feed(windows)
    return run


def sensor(seed, rate=RATE, deviation=4.0):
    """Taps of an FIR filter with random gains [dB] in each third octave; nothing of the package makes it."""
    random = np.random.default_rng(seed)
    edges = np.append(0.0, 100 * 2 ** (np.arange(24) / 3))
    edges = np.append(edges[edges < 0.99 * rate / 2], rate / 2)
    return signal.firwin2(1023, edges, 10 ** (random.normal(0, deviation, edges.size) / 20), fs=rate)


def heard(windows, taps):
    return signal.oaconvolve(windows.ravel(), taps, mode="same").reshape(windows.shape)


# -- the spectrum of a run ------------------------------------------------------------------------------------


def test_levels_are_those_of_welch():
    windows = flow(1, 3000.0)
    frequency, density = signal.welch(windows.ravel(), RATE, nperseg=256, nfft=4096, detrend=False)
    expected = []
    for low, centre, high in zip(MEL_BANDS.corners, MEL_BANDS.corners[1:], MEL_BANDS.corners[2:], strict=False):
        weight = np.interp(frequency, [low, centre, high], [0.0, 1.0, 0.0], left=0, right=0)
        expected.append(10 * np.log10(np.sum(weight * density) * frequency[1]) if high <= RATE / 2 else expected[-1])
    # What is slower than a window is taken for its baseline, and leaks into the lowest bands of the record as a whole.
    assert 10 * spectrum_of(windows).levels[4:] == pytest.approx(np.array(expected)[4:], abs=0.15)


def test_a_run_is_the_same_in_portions():
    windows = flow(2, 3000.0)
    run = MeanSpectrum(RATE)
    for part in (windows[:7], windows[7:8], windows[8:]):
        run.feed(part)
    assert run.n_windows == len(windows)
    np.testing.assert_allclose(run.levels, spectrum_of(windows).levels, rtol=1e-12)


def test_standard_errors_are_how_runs_scatter():
    runs = [spectrum_of(flow(seed, 3000.0, n_windows=60)) for seed in range(24)]
    scatter = np.std([10 * run.levels for run in runs], axis=0, ddof=1)
    told = np.mean([run.deviations for run in runs], axis=0)
    assert np.median(scatter / told) == pytest.approx(1, abs=0.25)
    assert (spectrum_of(flow(1, 3000.0, n_windows=1)).deviations == np.inf).all()


# -- the filter -----------------------------------------------------------------------------------------------


def test_gain_at_a_centre_is_that_of_its_band():
    random = np.random.default_rng(0)
    one = Equalisation(gains=random.normal(0, 5, N_BANDS))
    time = np.arange(8192) / RATE
    for band in (3, 10, 20, 28):
        tone = np.sin(2 * np.pi * MEL_BANDS.centres[band] * time)
        middle = slice(2048, 6144)
        found = 20 * np.log10(one.apply(tone[None], RATE)[0, middle].std() / tone[middle].std())
        assert found == pytest.approx(one.gains[band], abs=0.15)
    assert one.gain(MEL_BANDS.centres) == pytest.approx(one.gains, abs=1e-9)


def test_nothing_comes_before_its_cause():
    click = np.zeros((1, 4096))
    click[0, 2000] = 1.0
    found = Equalisation(gains=np.random.default_rng(1).normal(0, 5, N_BANDS)).apply(click - click.mean(), RATE)
    assert np.abs(found[0, :1990]).max() < 1e-3 * np.abs(found).max()
    assert np.square(found[0, 2000:2200]).sum() > 0.98 * np.square(found).sum()


# -- what is lost, what is cured ------------------------------------------------------------------------------


def test_gain_cancels_in_level_free_features_only():
    windows = flow(5, 3000.0, n_windows=6)
    once, louder = (dict(zip(WINDOW, extract_array(f * windows, RATE, WINDOW).T, strict=True)) for f in (1.0, 2.0))
    for name in WINDOW:
        if name == "window_peak":
            assert louder[name] == pytest.approx(2 * once[name])
        elif name.startswith(("window_level", "window_mel", "window_even")) and "deviation" not in name:
            assert louder[name] == pytest.approx(once[name] + np.log10(4.0), abs=1e-9), name
        else:
            assert louder[name] == pytest.approx(once[name], rel=1e-9, abs=1e-9), name


MEL = tuple(name for name in WINDOW if name.startswith("window_mel"))
FREE = tuple(name for name in WINDOW if name.startswith(("window_relative_mel", "window_mel_deviation")))


def learner():
    return make_pipeline(StandardScaler(), LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"))


def test_a_response_is_cured_by_a_reference_run():
    """Two materials a tone apart; the sensor in use hears 4 dB (standard deviation) otherwise in each third octave."""
    labels = np.repeat(["a", "b"], 80)

    def both(seed, n_windows):
        soft = flow(seed, 2850.0, n_windows, decay=5000.0, noise=0.05)
        return np.concatenate([soft, 1.2 * flow(seed + 1, 3150.0, n_windows, decay=5000.0, noise=0.05)])

    train, test, reference, again = both(10, 80), both(20, 80), both(30, 40), both(40, 40)
    models = {names: learner().fit(extract_array(train, RATE, names), labels) for names in (MEL, FREE)}
    target = spectrum_of(reference).levels

    def share(windows, names, **options):
        return models[names].score(extract_array(windows, RATE, names, **options), labels)

    assert share(test, MEL) > 0.97
    assert share(test, FREE) > 0.97
    # A gain of 6 dB: absolute levels lose, relative ones cannot.
    assert share(2 * test, MEL) < 0.9
    assert share(2 * test, FREE) == share(test, FREE)
    lost, cured = [], []
    for seed in range(4):
        taps = sensor(seed)
        session = heard(test, taps)
        made_up = Equalisation.between(spectrum_of(heard(again, taps)).levels, target)
        lost.append(share(session, FREE))
        cured.append(share(session, FREE, equalisation=made_up))
    assert np.mean(lost) < 0.9
    assert min(cured) > 0.95


# -- drift ----------------------------------------------------------------------------------------------------


def test_drift_is_warned_of_beyond_three_decibels():
    reference = spectrum_of(flow(50, 3000.0, 300)).levels
    same = drift(spectrum_of(flow(51, 3000.0, 300)), reference)
    assert same.warning("A1") is None
    assert abs(same.level) < 0.5
    louder = drift(spectrum_of(10**0.25 * flow(51, 3000.0, 300)), reference)
    assert louder.level == pytest.approx(same.level + 5.0, abs=1e-9)
    assert louder.certain > MAX_DRIFT
    assert "sensor A1 must be within 3 dB of its reference run, it is +5" in louder.warning("A1")
    # One band alone: 8 dB less at 5 kHz, as of a loose mount.
    notch = signal.firwin2(513, [0, 3500, 4200, 5800, 6500, RATE / 2], [1, 1, 10**-0.4, 10**-0.4, 1, 1], fs=RATE)
    worn = drift(spectrum_of(heard(flow(51, 3000.0, 300), notch)), reference)
    assert worn.frequency == pytest.approx(5000, abs=800)
    assert worn.largest == pytest.approx(-8, abs=1.5)
    assert worn.warning("A1") is not None


def test_few_windows_are_no_proof_of_drift():
    reference = spectrum_of(flow(60, 3000.0, 300)).levels
    alone = drift(spectrum_of(3 * flow(61, 3000.0, 1)), reference)
    assert abs(alone.largest) > MAX_DRIFT
    assert alone.warning("A1") is None


def test_responses_of_real_recordings_are_made_up_for(real_data):
    """A ramp heard through another response: its reference run is of other recordings of the same five materials."""
    files = {k: sorted((real_data / "bulk_ramp").glob(f"*_{k}.wav")) for k in (1, 2, 3)}
    rate = 44_100.0

    def windows(numbers, taps=None):
        parts, labels = [], []
        for file in (file for number in numbers for file in files[number]):
            samples = read_recording(file, channel=1)[0].samples.astype(np.float64)
            samples = samples if taps is None else signal.oaconvolve(samples, taps, mode="same")
            part = samples[: samples.size // 4410 * 4410].reshape(-1, 4410)
            parts.append(part)
            labels += [file.stem[:-2]] * len(part)
        return np.concatenate(parts), np.array(labels)

    names = supported(FREE, rate, 4410)
    train, labels = windows((1, 2))
    model = learner().fit(extract_array(train, rate, names), labels)
    target = spectrum_of(windows((1,))[0], rate).levels
    plain = model.score(extract_array(windows((3,))[0], rate, names), windows((3,))[1])
    lost, cured = [], []
    for seed in range(6):
        taps = sensor(seed, rate)
        session, truth = windows((3,), taps)
        made_up = Equalisation.between(spectrum_of(windows((2,), taps)[0], rate).levels, target)
        lost.append(model.score(extract_array(session, rate, names), truth))
        cured.append(model.score(extract_array(session, rate, names, equalisation=made_up), truth))
    assert np.mean(lost) < plain - 0.06
    assert np.mean(cured) > plain - 0.03


@pytest.mark.parametrize(("hop", "kept"), [(0.1, range(30)), (0.05, range(0, 30, 2)), (0.03, range(0, 30, 4))])
@pytest.mark.parametrize("portion", [1, 7, 30])
def test_windows_that_overlap_count_once(hop, kept, portion):
    windows = np.random.default_rng(3).normal(size=(30, 1, 800))
    reference = MeanSpectrum(8000.0)
    reference.feed(windows[list(kept), 0])
    model = SimpleNamespace(
        n_channels=1,
        window_time=0.1,
        hop_time=hop,
        sensors=("left",),
        arrays={"reference.spectra": reference.levels[None, None] - 0.5},
    )
    drifts = Drifts(model, ["left"], 8000.0)
    for first in range(0, 30, portion):
        drifts.see(0, windows[first : first + portion])
    (said,) = drifts.warnings()
    assert "+5.0 dB off" in said
    assert "(+5.0 dB in the mean)" in said
