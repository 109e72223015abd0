"""Fitted pulses, and their bound against exact pulses, scipy's least squares, and many noisy draws."""

import numpy as np
import pytest

from cgid.errors import BadData, InvalidValue
from cgid.measure.features.extraction import extract_array
from cgid.measure.features.pulses import PulseBatch
from cgid.measure.fit import family
from cgid.measure.fit.fit import PulseStart, fit_pulses
from cgid.measure.fit.fit_samples import strongest_run
from cgid.measure.fit.template import curve, relative_times
from cgid.scene import load_scene, synthesise
from studies.impactor.estimation import estimate
from studies.impactor.likelihood import cramer_rao_bound
from tests import few, naive
from tests.conftest import ROOT

BEFORE = 40
FITTED = ["fitted_peak", "misfit"]


def shape_of(e):
    return np.array([np.log(e)])


def exact(share, e):
    return naive.damped_pulse(np.asarray(share), 1.0, 1.0, 0.0, e)


def frames_of(e, contact, noise=0.0, n=1, seed=0, after=1.5):
    """Pulses of peak 1, touch up to a sample behind `BEFORE`, in white noise: samples, times of touch."""
    rng = np.random.default_rng(seed)
    touch = BEFORE + rng.uniform(size=n)
    times = np.arange(BEFORE + int(after * contact) + 10)
    clean = np.stack([naive.damped_pulse(times, 1.0, contact, start, e) for start in touch])
    return clean + noise * rng.normal(size=clean.shape), touch


def fitted(frames, noise, rate=1.0, **options):
    return estimate(frames, rate, pre_trigger=BEFORE - 4, noise=noise, remove_baseline=False, **options)


def squared(found, row, frame):
    """The squared residual of a found pulse, worked out anew."""
    times = np.arange(len(frame))
    force = naive.damped_pulse(
        times, found.peak[row], found.contact_duration[row], found.onset[row], found.restitution[row]
    )
    return float(np.sum((frame - force) ** 2))


# -- the template -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("e", [0.05, 0.1, 0.3, 0.5, 0.8, 0.999])
@pytest.mark.parametrize("turned", [False, True])
def test_curve_is_the_exact_pulse(e, turned):
    share = np.linspace(-0.1, 1.1, 2401)
    e = 1 / e if turned else e
    assert np.abs(curve(share[None], shape_of(e))[0] - exact(share, e)).max() < 1e-9


@pytest.mark.parametrize("e", [0.05, 0.07, 0.2, 0.35, 0.65, 0.9, 1.0])
def test_times_of_the_template_are_those_of_the_pulse(e):
    """The impulse is the change of momentum, m x' from 1 to -e."""
    contact, top, _ = (float(time) for time in family.times(e))
    width = (1 + e) / float(family.force(np.array([top]), e)[0])
    share = (np.arange(200_000) + 0.5) / 200_000
    assert exact(share, e).mean() * contact == pytest.approx(width, rel=1e-8)  # the same by quadrature
    duration, lead, *_ = relative_times(shape_of(e))
    assert duration[0] == pytest.approx(contact / width, rel=1e-6)
    assert lead[0] == pytest.approx(top / width, abs=1e-6)
    duration, lead, *_ = relative_times(shape_of(1 / e))
    assert duration[0] == pytest.approx(contact / width, rel=1e-6)
    assert lead[0] == pytest.approx((contact - top) / width, abs=2e-5)


# -- the fit against scipy ----------------------------------------------------------------------------------------


CASES = [(0.45, 60, 0.01), (0.5, 30, 0.01), (0.65, 30, 0.02), (0.8, 100, 0.02), (0.95, 200, 0.02), (1.2, 60, 0.01)]


@pytest.mark.parametrize(("e", "contact", "noise"), few(CASES, 2))
def test_fit_is_that_of_scipy(e, contact, noise):
    """No less likely than scipy's by a fiftieth of a standard deviation squared; so within a seventh of one."""
    frames, touch = frames_of(e, contact, noise, n=12, seed=3)
    found = fitted(frames, noise)
    apart = []
    for row, frame in enumerate(frames):
        twin, cost = naive.fitted_pulse(frame, (1.0, contact, touch[row], e))
        assert squared(found, row, frame) - cost < 0.02 * noise**2
        apart.append((found.restitution[row] - twin[3]) / found.restitution_deviation[row])
        assert found.peak[row] == pytest.approx(twin[0], abs=0.15 * noise / np.sqrt(contact / 3))
    assert np.abs(apart).max() < 0.15


def test_the_error_of_a_removed_baseline_is_in_the_covariance():
    """Of the impulse of long pulses: a mean of few samples, times the duration, counts as much as the noise."""
    frames, _ = frames_of(0.6, 150, 0.01, n=500, seed=8)
    found = estimate(frames + 0.3, 1.0, pre_trigger=BEFORE - 4)
    shape = np.log(found.restitution)
    relative, _, slope, *_ = relative_times(shape)
    true = np.log(150 / relative_times(np.log([0.6]))[0])
    slopes = np.zeros((500, 4))
    slopes[:, :2], slopes[:, 3] = 1.0, -slope / relative
    deviation = np.sqrt(np.einsum("ni,nij,nj->n", slopes, found.covariance, slopes))
    away = np.log(found.peak * found.contact_duration / relative) - true
    assert np.std(away / deviation) == pytest.approx(1, abs=0.12)


@pytest.mark.parametrize("e", [0.5, 0.65, 0.95])
def test_fit_of_a_clipped_pulse_is_that_of_scipy(e):
    frames, touch = frames_of(e, 60, 0.01, n=10, seed=7)
    frames = np.minimum(frames, 0.6)
    found = fitted(frames, 0.01)
    for row, frame in enumerate(frames):
        twin, _ = naive.fitted_pulse(frame, (1.0, 60, touch[row], e), clip_level=0.6)
        assert abs(found.restitution[row] - twin[3]) < 0.2 * found.restitution_deviation[row]
        assert found.peak[row] == pytest.approx(twin[0], rel=0.2 * np.sqrt(found.covariance[row, 0, 0]))


#: What is found errs without noise, by restitution: of the peak, the restitution, the duration, relatively. Windows of
#: more than 320 samples are averaged before they are fitted, which flattens the top.
EXACT = [(0.1, 1e-4, 1e-3, 1e-3), (0.2, 1e-5, 2e-4, 2e-4), (0.35, 1e-5, 2e-5, 2e-5), (0.5, 1e-5, 2e-5, 2e-5),
         (0.65, 1e-5, 2e-5, 2e-5), (0.95, 1e-5, 2e-5, 2e-5), (1.0, 1e-5, 2e-5, 2e-5), (1.5, 1e-5, 2e-5, 2e-5),
         (5.0, 1e-5, 3e-4, 3e-4)]  # fmt: skip


# -- what must not matter -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def noisy():
    parts = [frames_of(e, contact, 0.01, n=6, seed=11)[0] for e in (0.4, 0.65, 0.95) for contact in (30, 40, 80)]
    long = max(part.shape[1] for part in parts)
    return np.concatenate([np.pad(part, ((0, 0), (0, long - part.shape[1]))) for part in parts])


def same(found, other, relative=1e-6, rows=slice(None)):
    for name in ("peak", "contact_duration", "onset", "restitution"):
        assert getattr(found, name)[rows] == pytest.approx(getattr(other, name), rel=relative), name


@pytest.mark.parametrize("options", [{}, {"clip_level": 0.7}])
def test_a_row_does_not_depend_on_its_neighbours(noisy, options):
    found = fitted(noisy, 0.01, **options)
    for row in (0, 7, 20, 35):
        alone = fitted(noisy[row], 0.01, **options)
        same(found, alone, rows=slice(row, row + 1))
        assert found.misfit[row] == pytest.approx(alone.misfit[0], rel=1e-6)


_BROKEN = [
    ({"noise": 1e300}, "noise"),
    ({"noise": [1.0, 2.0]}, r"noise must be one number or one for each signal \(1\), got shape \(2,\)"),
    *(({"pre_trigger": before}, "pre_trigger must be a whole number") for before in (-5, 10**9, 2.5, np.nan, "x")),
    ({"noise": -1.0}, "noise"),
    ({"clip_level": 0.0}, "clip_level"),
]


@pytest.mark.parametrize(("options", "name"), _BROKEN)
def test_estimate_names_the_number_that_breaks_its_rule(options, name):
    with pytest.raises(InvalidValue, match=name):
        estimate(frames_of(0.65, 60)[0], 2e5, **options)


# -- the bound ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("e", [0.2, 0.35, 0.65, 0.95, 1.5])
@pytest.mark.parametrize("contact", [12.3, 30.0, 200.4])
def test_bound_is_the_inverse_of_numerical_information(e, contact):
    found = cramer_rao_bound(contact, e, 1.0, 1.0, onset=0.37).covariance
    times = np.arange(1, np.ceil(0.37 + contact))
    expected = naive.pulse_covariance(times, contact, 0.37, e)
    size = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    assert np.abs(found - expected).max() / size.max() < 0.02
    assert np.abs((found - expected) / size).max() < (0.02 if e > 0.3 else 0.05)


def test_bound_is_as_published():
    """2 % noise and 30 samples: .07 at .35, .016 at .65."""
    found = cramer_rao_bound(150e-6, [0.35, 0.65], 0.02, 200e3).restitution_deviation
    assert found == pytest.approx([0.07, 0.016], abs=0.0025)
    assert found == pytest.approx([0.0723, 0.0155], rel=0.005)


# -- many noisy pulses --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("e", "contact", "noise"), few([(0.5, 60, 0.01), (0.95, 60, 0.02), (0.65, 30, 0.01), (0.8, 100, 0.02)], 2)
)
def test_estimates_are_unbiased_and_reach_the_bound(e, contact, noise):
    """Of 1200 pulses: the mean is known to .029 standard deviations, the standard deviation to 2 %."""
    frames, _ = frames_of(e, contact, noise, n=1200, seed=14)
    found = fitted(frames, noise)
    bound = cramer_rao_bound(contact, e, noise, 1.0).restitution_deviation
    error = found.restitution - e
    assert abs(error.mean()) < 0.1 * error.std()
    assert 0.95 < error.std() / bound < 1.1
    assert np.sqrt(np.mean((error / found.restitution_deviation) ** 2)) == pytest.approx(1, abs=0.08)
    assert found.misfit.mean() == pytest.approx(1, abs=0.02)
    assert found.of_family.all()


@pytest.fixture(scope="module")
def peers():
    return load_scene(ROOT / "datasets" / "peers.toml")


@pytest.fixture(scope="module")
def peers_estimates(peers):
    batches = list(synthesise(peers, 2048, seed=15))
    drawn = {name: np.concatenate([b.parameters[name] for b in batches]) for name in batches[0].parameters}
    signals = np.concatenate([b.signals[:, :1024] for b in batches])
    found = estimate(signals, 2e5, pre_trigger=100)
    bound = cramer_rao_bound(drawn["contact_duration"], drawn["restitution"], 0.02, 2e5, onset=0.0)
    return drawn, found, bound


def test_over_a_population_estimates_are_unbiased_and_reach_the_bound(peers_estimates):
    drawn, found, bound = peers_estimates
    told = bound.restitution_deviation <= 0.03
    assert told.sum() > 1000
    error = ((found.restitution - drawn["restitution"]) / bound.restitution_deviation)[told]
    # In 2 % the likelihood has two tops, and the noise makes the dull one the higher. The deviations say so.
    stray = np.abs(error) > 7
    assert stray.mean() < 0.03
    wrong = (found.restitution - drawn["restitution"])[told][stray]
    assert (wrong < 0).all() and (np.abs(wrong) < 6 * found.restitution_deviation[told][stray]).mean() > 0.8
    assert abs(error[~stray].mean()) < 0.1 * error[~stray].std()
    assert error[~stray].std() < 1.15
    for name, value, deviation in (
        ("peak_force", found.peak, bound.peak_deviation),
        ("contact_duration", found.contact_duration, bound.duration_deviation),
    ):
        relative = (np.log(value / drawn[name]) / deviation)[told][~stray]
        assert abs(np.median(relative)) < 0.1, name  # a dull top pulls the mean
        assert relative.std() < 1.2, name


# -- where the search begins --------------------------------------------------------------------------------------


@pytest.mark.parametrize("contact", [20, 60, 200])
def test_the_strongest_run_is_the_pulse(contact):
    """10 dB: the peak is three times the noise, and single samples of 2000 are as high."""
    noise = 10**-0.5
    frames, touch = frames_of(0.5, contact, noise, n=200, seed=22, after=8)
    peak, width, peak_time = strongest_run(frames, np.zeros(200))
    lead, length = relative_times(shape_of(0.5))[1][0], relative_times(shape_of(0.5))[0][0]
    true_width = contact / length
    near = np.abs(peak_time - touch - lead * true_width) < true_width
    assert near.mean() >= (0.97 if contact > 20 else 0.9)
    assert np.median(width[near]) == pytest.approx(true_width, rel=0.25)
    assert np.median(peak[near]) == pytest.approx(1, rel=0.15)


@pytest.mark.long
@pytest.mark.parametrize(("e", "contact"), few([(0.5, 60), (0.8, 200), (0.5, 200), (0.8, 60)], 2))
def test_in_much_noise_the_search_ends_where_it_does_from_the_truth(contact, e):
    """10 dB. Two pulses are one where their curves are closer than a standard deviation of the noise in all."""
    noise = 10**-0.5
    frames, touch = frames_of(e, contact, noise, n=300, seed=24, after=6)
    pulses = PulseBatch(frames, 1.0, BEFORE - 4, remove_baseline=False)
    length, lead, *_ = relative_times(shape_of(e))
    width = contact / length[0]
    truth = PulseStart(np.ones(300), np.full(300, width), touch + lead[0] * width)
    found, best = (fit_pulses(frames, start, np.full(300, noise)) for start in (pulses.fit_start, truth))
    times = np.arange(frames.shape[1])
    apart = np.array([
        np.sum((naive.damped_pulse(times, a.peak[k], a.duration[k], a.onset[k], a.restitution[k])
                - naive.damped_pulse(times, b.peak[k], b.duration[k], b.onset[k], b.restitution[k])) ** 2)
        for a, b in ((found, best),) for k in range(300)
    ])  # fmt: skip
    assert np.mean(apart < noise**2) >= 0.94  # the rest are flat bottoms: where 8 iterations end depends on the start
    top = found.onset + relative_times(found.shape)[1] * found.width
    assert np.mean(np.abs(top - touch - lead[0] * width) < width) >= 0.99


# -- what is no such pulse ----------------------------------------------------------------------------------------


def reason(samples, rate=1e5, pre_trigger=BEFORE - 4):
    with pytest.raises(BadData) as caught:
        extract_array(samples, rate, FITTED, pre_trigger=pre_trigger)
    return str(caught.value)


def test_a_faint_pulse_is_fitted_where_its_samples_tell_nothing():
    frames, _ = frames_of(0.5, 200, 0.3, n=20, seed=26, after=4)
    found = extract_array(frames, 1e5, FITTED, pre_trigger=36)
    assert np.abs(found[:, 0] - 1).max() < 0.5
    with pytest.raises(BadData, match="no impact"):
        extract_array(frames, 1e5, ["peak_force"], pre_trigger=36)


def test_too_narrow_a_pulse_and_the_cure_works():
    said = reason(frames_of(0.8, 2.2, 0.001, seed=28, after=20)[0])
    assert "samples of width; 1.5 are needed" in said
    wanted = float(said.split(" use ")[1].split(" Hz")[0])
    finer = frames_of(0.8, 2.2 * wanted / 1e5, 0.001, seed=28)[0]
    assert extract_array(finer, wanted, FITTED, pre_trigger=36)[0, 0] == pytest.approx(1, abs=0.01)


def taps():
    share = (np.arange(400) - 60.3) / 100
    inside = (share > 0) & (share < 1)
    lump = exact(share, 0.5)
    return {
        "half-sine": np.where(inside, np.sin(np.pi * share), 0.0),
        "square": np.where(inside, 1.0, 0.0),
        "double hit": lump + 0.6 * exact(share - 0.7, 0.5),
        "second hit apart": lump + 0.5 * exact(share - 1.8, 0.5),
        "ringing": lump + 0.1 * np.sin(0.8 * np.arange(400)) * (share > 0),
    }


@pytest.mark.parametrize("name", taps())
def test_misfit_of_what_is_no_impact_is_large(name):
    clean = taps()[name]
    frames = clean + 0.01 * np.random.default_rng(31).normal(size=(20, 400))
    found = estimate(frames, 1e5, pre_trigger=50)
    assert found.misfit.min() > 2.5
    assert not found.of_family.any()


def test_overload_is_the_part_of_the_peak_that_was_cut_off():
    frames, _ = frames_of(0.65, 60, 0.005, n=40, seed=32)
    for level in (0.5, 0.7, 0.9):
        cut = np.minimum(frames, level)
        found = extract_array(cut, 1e5, ["overload", "fitted_peak"], pre_trigger=36)
        assert found[:, 0].mean() == pytest.approx(1 / level - 1, abs=0.01)
        assert estimate(cut, 1e5, pre_trigger=36).overload == pytest.approx(found[:, 0])
    assert (extract_array(frames, 1e5, ["overload"], pre_trigger=36) == 0).all()
