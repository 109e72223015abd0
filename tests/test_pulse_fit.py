"""The global search for a pulse, the colour of noise, and what a fitted pulse leaves, against slow twins."""

import numpy as np
import pytest
from scipy import linalg, optimize

from cgid.measure.features.extraction import extract_array, extract_truncated
from cgid.measure.fit.ar_noise import ORDER, ARNoise, ar_noise_of
from cgid.measure.fit.residual import N_SHAPES
from cgid.measure.fit.search import NODES
from cgid.measure.fit.template import SHAPES_PATH, TEMPLATE_PATH, curve, relative_times
from studies.impactor.estimation import estimate
from studies.impactor.pulses import pulse_and_slopes
from tests import few, naive
from tests.references import make_shapes
from tests.test_estimation import BEFORE, frames_of, squared

REMAINDER = [*(f"pulse_shape_{k + 1}" for k in range(N_SHAPES)), "unexplained"]


# -- the template -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("s", [-2.9, -1.6, -0.7, -0.011, 0.0, 0.4, 2.5])
@pytest.mark.parametrize("known", [False, True])
def test_template_is_the_exact_pulse(s, known):
    """Values to 4e-5 except at the very ends, slopes as differences of the exact pulse."""
    times = np.linspace(-5, 130, 1213)[None]
    width = 40.0

    def slow(p):
        duration, lead, *_ = relative_times(p[3:4])
        own = np.exp(p[1])
        start = 7.3 if known else p[2] - lead[0] * own
        return p[0] * curve((times - start) / (duration[0] * own), p[3:4])[0]

    p = np.array([2.0, np.log(width), 7.3 + relative_times(np.array([s]))[1][0] * width, s])
    value, slopes = pulse_and_slopes(p[None], times, known)
    share = (times[0] - 7.3) / (relative_times(np.array([s]))[0][0] * width)
    inner = np.minimum(np.abs(share), np.abs(1 - share)) > 1e-3
    assert np.abs(value[0] - slow(p))[inner].max() < (4e-5 if s > -2 else 2.5e-4)
    assert np.abs(value[0] - slow(p)).max() < (2e-4 if s > -2 else 6e-4)
    smooth = np.minimum(np.abs(share), np.abs(1 - share)) > 0.05
    for k, column in enumerate([0, 1, 3] if known else [0, 1, 2, 3]):
        size = 0.4 if column == 2 else 0.01
        step = size * np.eye(4)[column]
        found = (slow(p + step) - slow(p - step)) / (2 * size)
        assert (
            np.abs(slopes[0, k] - found)[smooth].max() < 0.02 * np.abs(found).max() + (1e-4 if s < -2 else 2e-5) / size
        )
    outside = (share < 0) | (share > 1)
    assert np.abs(value[0][outside]).max() < 1e-6
    assert np.abs(slopes[0][:, outside]).max() < 1e-3


# -- the global optimum -------------------------------------------------------------------------------------------


def slow_search(frame, times, contact, touch):
    """The least squared residual of exact pulses from many starts, and its parameters, by scipy."""

    def residual(p):
        return frame - naive.damped_pulse(times, p[0], p[1], p[2], np.exp(p[3]))

    best = None
    for s in np.log([0.06, 0.15, 0.25, 0.45, 0.8]):
        stretch = relative_times(np.array([s]))[0][0] / relative_times(np.array([np.log(0.2)]))[0][0]
        found = optimize.least_squares(
            residual,
            [1.0, contact * stretch, touch, s],
            bounds=([0.1, 2, 0, np.log(0.05)], [9, 9 * contact, 999, np.log(20)]),
            x_scale=[1, contact, contact, 1],
            max_nfev=40,
        )
        if best is None or found.cost < best.cost:
            best = found
    return 2 * best.cost, best.x


@pytest.mark.parametrize(("e", "contact", "noise"), few([(0.2, 30, 0.03), (0.15, 100, 0.03), (0.15, 30, 0.01)]))
def test_the_fit_of_a_dull_impact_is_the_global_optimum(e, contact, noise):
    frames, touch = frames_of(e, contact, noise, n=8, seed=40)
    found = estimate(frames, 1.0, pre_trigger=BEFORE - 4, noise=noise, remove_baseline=False)
    for row, frame in enumerate(frames):
        least, _ = slow_search(frame, np.arange(frame.size), contact, touch[row])
        assert (squared(found, row, frame) - least) / noise**2 < 0.3


@pytest.mark.parametrize(("e", "contact", "noise"), few([(0.15, 100, 0.02), (0.2, 100, 0.03), (0.2, 30, 0.01)], 2))
def test_deviations_of_dull_impacts_are_honest(e, contact, noise):
    frames, _ = frames_of(e, contact, noise, n=400, seed=41, after=2.5)
    found = estimate(frames, 1.0, pre_trigger=BEFORE - 4, noise=noise, remove_baseline=False)
    z = (found.restitution - e) / found.restitution_deviation
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.25
    assert np.median(found.restitution) == pytest.approx(e, abs=0.02 + 2 * found.restitution_deviation.mean() / 20)
    longer = np.log(found.contact_duration / contact) / np.sqrt(found.covariance[:, 1, 1])
    assert np.sqrt(np.mean(longer**2)) < 1.3


@pytest.mark.parametrize("level", [0.5, 0.7, 0.9])
def test_a_clipped_pulse_is_fitted_within_its_deviations(level):
    """Samples at the limit are lower bounds: as honest as the whole pulse, and surer the less is cut off."""
    frames, _ = frames_of(0.5, 80, 0.01, n=300, seed=43)
    whole, cut = (
        estimate(samples, 1.0, pre_trigger=BEFORE - 4, noise=0.01, remove_baseline=False)
        for samples in (frames, np.minimum(frames, level))
    )
    for found in (whole, cut):
        peak = np.log(found.peak) / np.sqrt(found.covariance[:, 0, 0])
        length = np.log(found.contact_duration / 80) / np.sqrt(found.covariance[:, 1, 1])
        shape = (found.restitution - 0.5) / found.restitution_deviation
        for z in (peak, length, shape):
            assert np.ptp(np.quantile(z, [0.16, 0.84])) / 2 == pytest.approx(1, abs=0.25)
            assert abs(np.median(z)) < 0.3
    assert (cut.restitution_deviation > 0.98 * whole.restitution_deviation).mean() > 0.9
    assert (cut.overload > 0).all()
    assert cut.of_family.mean() > 0.97


# -- the colour of noise ------------------------------------------------------------------------------------------


def pink(n, samples, rng, period=4096):
    """Noise of power density 1/f and standard deviation 1, (n, samples)."""
    frequency = np.fft.rfftfreq(period)
    frequency[0] = frequency[1]
    waves = rng.normal(size=(n, frequency.size)) + 1j * rng.normal(size=(n, frequency.size))
    noise = np.fft.irfft(waves * frequency**-0.5)[:, :samples]
    return noise / np.sqrt(np.mean(noise**2))


@pytest.mark.parametrize("samples", [60, 100, 300])
def test_white_noise_stays_white_and_pink_noise_is_recognised(samples):
    rng = np.random.default_rng(44)
    for noise, low, high in ((rng.normal(size=(2000, samples)), 0, 0.015), (pink(400, samples, rng), 0.8, 1)):
        n = len(noise)
        assert low <= len(ar_noise_of(noise, np.full(n, float(samples)), np.full(n, 1e-3)).rows) / n <= high


def test_whitening_is_that_of_the_dense_covariance():
    """An autoregression's covariance matrix, its Cholesky factor, and the samples after the first `ORDER`."""
    coefficients = np.array([0.9, -0.5, 0.3, 0.1])
    response = np.zeros(4000)  # of the noise to one innovation
    response[0] = 1.0
    for t in range(1, response.size):
        back = response[max(t - 4, 0) : t][::-1]
        response[t] = coefficients[: back.size] @ back
    n = 80
    covariance = linalg.toeplitz([response[: response.size - lag] @ response[lag:] for lag in range(n)])
    curves = np.random.default_rng(45).normal(size=(1, 3, n))
    expected = linalg.solve_triangular(linalg.cholesky(covariance, lower=True), curves[0].T, lower=True).T
    padded = np.zeros((1, ORDER))
    padded[0, :4] = coefficients
    found = ARNoise(padded, np.ones(1)).whitened(curves, np.array([0]))
    assert found[0, :, ORDER:] == pytest.approx(expected[:, ORDER:], abs=1e-9)
    assert (found[0, :, :ORDER] == 0).all()


@pytest.mark.parametrize("e", [0.35, 0.6])
def test_in_pink_noise_deviations_are_honest(e):
    """Fitted as if the noise were white, they are less than half of the errors."""
    rng = np.random.default_rng(46)
    touch = 100 + rng.uniform(size=400)
    times = np.arange(600)
    clean = np.stack([naive.damped_pulse(times, 1.0, 60, start, e) for start in touch])
    frames = clean + 0.02 * pink(400, 600, rng)
    spread = []
    for options in ({}, {"noise": 0.02}):  # a given noise is white
        found = estimate(frames, 1.0, pre_trigger=100, **options)
        longer = np.log(found.contact_duration / 60) / np.sqrt(found.covariance[:, 1, 1])
        spread.append((np.std((found.restitution - e) / found.restitution_deviation), longer.std()))
    assert max(spread[0]) < 1.7
    assert max(spread[1]) > 2.2


# -- what the fitted pulse leaves -----------------------------------------------------------------------------------


def test_noise_around_a_pulse_of_the_family_leaves_nothing_unexplained():
    for e in (0.2, 0.5, 0.8):
        frames, _ = frames_of(e, 100, 0.02, n=300, seed=47, after=6)
        found = extract_array(frames, 1.0, REMAINDER, pre_trigger=BEFORE - 4)
        # The noise counts, and a hundredth of the peak beside it.
        per_bin = 0.02**2 / (0.1 * 100 / 1.9)
        assert found[:, -1].mean() == pytest.approx(per_bin / (per_bin + 1e-4), rel=0.35)
        assert np.sqrt(np.mean(found[:, :-1] ** 2)) < 0.02


@pytest.mark.filterwarnings("ignore::cgid.physics.HertzRangeWarning")
def test_components_tell_other_laws_from_the_family():
    """Pulses of other laws leave what the components explain; some law is far from the family."""
    clean = make_shapes.pulses()
    frames = clean + 0.003 * np.random.default_rng(49).normal(size=clean.shape)
    found = extract_array(frames, 1e5, REMAINDER, pre_trigger=make_shapes.SAMPLES - 60)
    sizes = np.sqrt(np.sum(found[:, :-1] ** 2, axis=1))
    assert np.quantile(sizes, 0.9) > 0.2
    assert np.median(found[:, -1]) < 1
    own, _ = frames_of(0.5, make_shapes.SAMPLES, 0.003, n=50, seed=50)
    of_family = extract_array(own, 1e5, REMAINDER, pre_trigger=BEFORE - 4)[:, :-1]
    assert np.mean(sizes > 3 * np.sqrt(np.sum(of_family**2, axis=1)).max()) > 0.7


def test_tables_are_what_their_maker_makes():
    assert np.load(TEMPLATE_PATH) == pytest.approx(make_shapes.template(), abs=1e-6)
    peak_time, width = make_shapes.coordinates()
    with np.load(SHAPES_PATH) as stored:
        assert stored["times"] == pytest.approx(make_shapes.times(), abs=1e-6)
        # An optimisation finds them, on another processor to 2e-12.
        assert stored["place"] == pytest.approx(peak_time, abs=1e-10)
        assert stored["width"] == pytest.approx(width, rel=1e-10)
        assert stored["tangents"] == pytest.approx(make_shapes.tangents_at(NODES, peak_time, width), abs=1e-9)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::cgid.physics.HertzRangeWarning")
def test_components_are_those_of_the_pulses_of_other_laws(tmp_path, monkeypatch):
    with np.load(SHAPES_PATH) as stored:
        held = dict(stored)
    for name in ("SHAPES_PATH", "TEMPLATE_PATH"):
        monkeypatch.setattr(make_shapes, name, tmp_path / getattr(make_shapes, name).name)
    make_shapes.main()
    with np.load(tmp_path / "shapes.npz") as made:
        assert np.abs(np.sum(made["components"] * held["components"], axis=1)).min() > 1 - 1e-6
        assert made["spreads"] == pytest.approx(held["spreads"], abs=1e-3)


# -- what must not matter -----------------------------------------------------------------------------------------


def test_samples_far_from_the_pulse_do_not_matter_to_the_last_bit():
    """Truncated frames, as the generator makes them, tell what whole ones do wherever they say so."""
    frames = np.concatenate([frames_of(e, 90, 0.02, n=40, seed=51, after=8)[0] for e in (0.2, 0.5, 0.8)])
    names = ("fitted_peak", "fitted_restitution", "fitted_peak_deviation", "shrunken_restitution", *REMAINDER[:-1])
    whole = extract_array(frames, 1.0, names, pre_trigger=BEFORE - 4)
    for kept in (230, 300, 500):
        cut = frames[:, :kept].copy()
        found, certain = extract_truncated(cut, 1.0, names, BEFORE - 4, frames[:, kept:].max(axis=1))
        assert (found[certain] == whole[certain]).all()
    assert certain.all()


def test_a_row_does_not_depend_on_clipped_cut_off_or_coloured_neighbours():
    rng = np.random.default_rng(52)
    frames, _ = frames_of(0.4, 70, 0.02, n=12, seed=53, after=3)
    frames[2] = np.minimum(frames[2], 0.6)
    frames[5] = np.roll(frames[5], 150)
    frames[7] += 0.03 * pink(1, frames.shape[1], rng)[0]
    names = ["fitted_restitution", "fitted_peak_deviation", *REMAINDER]
    together = extract_array(frames, 1.0, names, pre_trigger=BEFORE - 4, invalid="nan")
    alone = [extract_array(frame[None], 1.0, names, pre_trigger=BEFORE - 4, invalid="nan")[0] for frame in frames]
    np.testing.assert_array_equal(together, np.array(alone))
