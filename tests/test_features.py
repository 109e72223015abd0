"""Features against exact pulses of the family, slow twins, their own units, noise, and bad input."""

import re
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import integrate, optimize, signal

from cgid.errors import BadData
from cgid.identification.detection import find_impacts
from cgid.measure.features import FEATURES as ALL_FEATURES
from cgid.measure.features.extraction import choose, extract, extract_array
from cgid.measure.features.pulses import MAX_RINGING, MAX_UNEXPLAINED, PulseBatch
from cgid.measure.fit import family
from cgid.physics import STEEL, YANG2018_SPHERES, Elastic, HalfSpace, HuntCrossley, Impact, Sphere
from cgid.recordings import read_recording
from tests import few, naive
from tests.beside import SHARED

REAL_SHOCK = SHARED / "realdata" / "shock"
MEGAHERTZ = 1e6
FEATURES = {name: feature for name, feature in ALL_FEATURES.items() if feature.kind == "pulse"}
SPECTRAL = [name for name in FEATURES if name.startswith(("spectral", "cutoff", "band"))]
#: Powers of the amplitude and of time in each unit.
POWERS = {"U": (1, 0), "s": (0, 1), "1": (0, 0), "U s": (1, 1), "U^2 s": (2, 1), "U/s^2": (1, -2), "Hz": (0, -1)}


def impact(restitution=1.0, radius=0.025):
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[1], radius=radius),
        target=HalfSpace(material=STEEL),
        velocity=2.0,
        stiffness="hertz",
        dissipation=Elastic() if restitution == 1 else HuntCrossley(restitution=restitution),
    )


def recorded(hit, rate=MEGAHERTZ, before=200, shift=0.0):
    """Sample an impact's force; touch lies `shift` samples before sample number `before`."""
    n_samples = int(2 * before + hit.contact_duration * rate)
    return hit.force((np.arange(n_samples) - before + shift) / rate)


def family_pulse(restitution, duration, rate, n_samples, before, peak=1000.0):
    """Sample the family's pulse, stretched to a contact duration and a peak."""
    contact, top, _ = family.times(restitution)
    tau = (np.arange(n_samples) - before) / rate * contact / duration
    return peak * family.force(tau, restitution) / family.force(np.atleast_1d(top), restitution)


def measure(samples, rate=MEGAHERTZ, features=None, **options):
    """One signal's features by name."""
    names = choose(features)
    return dict(zip(names, extract_array(samples, rate, names, **options)[0].tolist(), strict=True))


@pytest.mark.parametrize("share", [0.01, 0.05])
def test_what_rings_after_a_force_is_strange(share):
    """A tone whose half period is the contact: differences over 1.5 contacts have the rms of the tone."""
    duration, rate = 100e-6, MEGAHERTZ
    pulse = family_pulse(0.6, duration, rate, 4000, 300.0)
    after = (np.arange(pulse.size) - 300) / rate - duration
    tone = share * pulse.max() * np.sin(np.pi * after / duration) * (after > 0)
    seen = PulseBatch((pulse + tone)[None], rate, pre_trigger=250)
    assert seen.ringing[0] == pytest.approx(share / np.sqrt(2), rel=0.05)
    assert (seen.residual.unexplained[0] > MAX_UNEXPLAINED) == (share / np.sqrt(2) > MAX_RINGING)


def test_hum_and_noise_do_not_ring():
    rng, rate = np.random.default_rng(4), MEGAHERTZ
    pulse = family_pulse(0.6, 100e-6, rate, 4000, 300.0, peak=1.0)
    hum = 0.1 * np.sin(2 * np.pi * 50 * np.arange(4000) / rate + rng.uniform(0, 6, (200, 1)))
    noise = rng.normal(0, 0.1, (200, 4000))
    for disturbed in (pulse + hum, pulse + noise):
        assert np.mean(PulseBatch(disturbed, rate, pre_trigger=250).ringing < MAX_RINGING) > 0.98


# -- exact pulses ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("restitution", [1.0, 0.8, 0.6, 0.5])
def test_peak_is_the_closed_form(restitution):
    hit = impact(restitution)
    found = measure(recorded(hit), features=["peak_force"])
    assert found["peak_force"] == pytest.approx(float(hit.peak_force), rel=3e-5)


@pytest.mark.parametrize("restitution", [1.0, 0.8, 0.6, 0.5])
@pytest.mark.parametrize("level", [10, 50])
def test_widths_agree_with_scipy(restitution, level):
    samples = recorded(impact(restitution))
    expected = signal.peak_widths(samples, [int(samples.argmax())], rel_height=1 - level / 100)[0][0] / MEGAHERTZ
    assert measure(samples, features=[f"width_{level}"])[f"width_{level}"] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("restitution", "error"), [(1.0, 1e-5), (0.8, 1e-5), (0.6, 1e-5), (0.5, 1e-5), (0.3, 4e-4)])
def test_impulse_is_the_change_of_momentum(restitution, error):
    hit = impact(restitution)
    found = measure(recorded(hit), features=["impulse"])["impulse"]
    assert found == pytest.approx(float((1 + hit.restitution) * hit.reduced_mass * hit.velocity), rel=error)


@pytest.mark.parametrize("restitution", [1.0, 0.8, 0.6, 0.5])
def test_energy_is_the_integral_of_the_square(restitution):
    hit = impact(restitution)
    expected = integrate.quad(lambda t: float(hit.force(t)) ** 2, 0, float(hit.contact_duration), epsrel=1e-9)[0]
    assert measure(recorded(hit), features=["energy"])["energy"] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("restitution", "shortest", "longest"),
    [
        (1.0, -1e-4, 1e-4),
        (0.8, -1e-4, 1e-4),
        (0.6, -5e-4, 0),
        (0.5, -0.0018, -0.0016),
        (0.4, -0.0122, -0.0114),
        (0.3, -0.092, -0.084),
    ],
)
@pytest.mark.parametrize("shift", [0.0, 0.3, 0.7])
def test_contact_duration_errs_as_stated_for_damped_pulses(restitution, shortest, longest, shift):
    hit = impact(restitution)
    found = measure(recorded(hit, shift=shift), features=["contact_duration"])["contact_duration"]
    assert shortest < found / float(hit.contact_duration) - 1 < longest


@pytest.mark.parametrize("restitution", [1.0, 0.5])
def test_time_features_agree_with_the_slow_twin(restitution):
    samples = recorded(impact(restitution))
    found, slow = measure(samples), samples.tolist()
    assert found["rise_time"] == pytest.approx(naive.rise_time(slow, MEGAHERTZ), rel=1e-12)
    assert found["fall_time"] == pytest.approx(naive.fall_time(slow, MEGAHERTZ), rel=1e-12)
    assert found["width_10"] == pytest.approx(naive.width(slow, MEGAHERTZ, 0.1), rel=1e-12)
    assert found["impulse"] == pytest.approx(naive.impulse(slow, MEGAHERTZ), rel=1e-6)
    assert found["energy"] == pytest.approx(naive.energy(slow, MEGAHERTZ), rel=1e-9)
    assert found["skewness"] == pytest.approx(naive.skewness(slow), abs=2e-4)


@pytest.mark.parametrize("restitution", [1.0, 0.5])
def test_spectral_features_agree_with_the_slow_twin(restitution):
    samples = recorded(impact(restitution), rate=2e5, before=40)
    found = measure(samples, 2e5)
    spectrum = naive.power_spectrum(samples.tolist(), 2e5, found["contact_duration"])
    expected = {
        "spectral_centroid": naive.centroid(*spectrum),
        "spectral_bandwidth": naive.bandwidth(*spectrum),
        "spectral_rolloff": naive.rolloff(*spectrum),
        "cutoff_10db": naive.cutoff_10db(*spectrum),
        "band_energy_0_500_hz": naive.band_power(*spectrum, 0, 500),
        "band_energy_1000_2000_hz": naive.band_power(*spectrum, 1000, 2000),
        "band_energy_4000_8000_hz": naive.band_power(*spectrum, 4000, 8000),
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-4)


def test_cutoff_of_a_half_sine_is_that_of_its_closed_form_spectrum():
    # |F(f)| of sin(pi t/T) is |cos(pi f T) / (1 - (2 f T)^2)| of its value at 0.
    samples = np.sin(np.pi * np.clip((np.arange(3000) - 1000) / 1000, 0, 1))
    root = optimize.brentq(lambda x: abs(np.cos(np.pi * x) / (1 - (2 * x) ** 2)) - 10**-0.5, 0.6, 1.4)
    found = measure(samples, 1e6, ["cutoff_10db"])["cutoff_10db"]
    assert found * 1e-3 == pytest.approx(root, rel=5e-3)


# -- units ----------------------------------------------------------------------------------------------------


def scalable():
    # Without noise, how sure a fit is says only how fine its template is.
    unsure = ("misfit", "fitted_restitution_deviation", "shrunken_restitution_deviation", "fitted_peak_deviation")
    return [name for name in FEATURES if not name.startswith("band") and name not in unsure]


@pytest.mark.parametrize("name", scalable())
def test_amplitude_scales_each_feature_as_its_unit_says(name):
    samples = recorded(impact(0.6))
    power = POWERS[FEATURES[name].unit][0]
    once, more = (extract_array(factor * samples, MEGAHERTZ, [name])[0, 0] for factor in (1.0, 7.0))
    assert more == pytest.approx(once * 7.0**power, rel=1e-9)


@pytest.mark.parametrize("name", scalable())
def test_time_scales_each_feature_as_its_unit_says(name):
    samples = recorded(impact(0.6))
    power = POWERS[FEATURES[name].unit][1]
    once, more = (extract_array(samples, MEGAHERTZ / factor, [name])[0, 0] for factor in (1.0, 7.0))
    assert more == pytest.approx(once * 7.0**power, rel=1e-9)


def test_size_free_index_does_not_know_the_radius():
    small, large = (
        measure(recorded(impact(0.6, radius)), features=["size_free_index", "peak_force"]) for radius in (0.01, 0.05)
    )
    assert large["peak_force"] / small["peak_force"] == pytest.approx(25, rel=1e-3)
    assert large["size_free_index"] == pytest.approx(small["size_free_index"], rel=1e-3)


# -- batches and columns --------------------------------------------------------------------------------------


def mixed_batch(n_signals=300):
    """Pulses of very different lengths and shapes with noise, more of them than are measured at once."""
    random = np.random.default_rng(3)
    durations = np.exp(random.uniform(np.log(1e-4), np.log(1.5e-3), n_signals))
    rows = [family_pulse(random.uniform(0.3, 1.0), duration, 1e5, 400, 100) for duration in durations]
    return np.array(rows) + random.normal(0, 5, (n_signals, 400))


# -- baseline -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [-5000.0, -300.0, 10.0, 300.0, 5000.0])
@pytest.mark.parametrize("pre_trigger", [None, 200])
def test_a_constant_changes_nothing(offset, pre_trigger):
    samples = recorded(impact(0.6))
    plain = measure(samples, pre_trigger=pre_trigger)
    assert measure(samples + offset, pre_trigger=pre_trigger) == pytest.approx(plain, rel=1e-6)


# -- noise ----------------------------------------------------------------------------------------------------

#: Measured on 500 noisy copies of a pulse of 60 samples: largest bias and spread [% of the clean value]. The
#: largest sample of a flat top is too large; the tail of a damped pulse drowns, and its duration comes out short.
NOISE_LIMITS = {
    (1.0, 1): {"peak_force": (1.1, 1.0), "width_10": (0.4, 1.0), "width_50": (0.8, 1.2), "contact_duration": (0.5, 2)},
    (1.0, 2): {"peak_force": (2.5, 1.7), "width_10": (0.7, 1.7), "width_50": (1.9, 2.1), "contact_duration": (1, 3)},
    (0.5, 1): {"peak_force": (0.8, 1.0), "width_10": (0.7, 2.0), "width_50": (0.6, 1.4), "contact_duration": (5, 4)},
    (0.5, 2): {"peak_force": (1.8, 1.8), "width_10": (2.0, 3.4), "width_50": (1.6, 2.7), "contact_duration": (11, 5.5)},
}


@pytest.mark.parametrize(("restitution", "percent"), NOISE_LIMITS)
@pytest.mark.parametrize("pre_trigger", [None, 100])
def test_noise_moves_features_no_further_than_measured(restitution, percent, pre_trigger):
    limits = NOISE_LIMITS[restitution, percent]
    clean = family_pulse(restitution, 6e-4, 1e5, 300, 100)
    noisy = clean + np.random.default_rng(11).normal(0, 10 * percent, (500, 300))
    expected = extract_array(clean, 1e5, limits)[0]
    found = 100 * (extract_array(noisy, 1e5, limits, pre_trigger=pre_trigger) / expected - 1)
    bias, spread = np.array(list(limits.values())).T
    assert np.all(np.abs(found.mean(axis=0)) <= bias), found.mean(axis=0)
    assert np.all(found.std(axis=0) <= spread), found.std(axis=0)


# -- what cannot be measured ----------------------------------------------------------------------------------


def test_too_few_samples_and_the_cure_works():
    with pytest.raises(BadData, match=r"sampling_rate 100000 Hz gives this .* ms pulse 2 samples above 10 %") as caught:
        extract(family_pulse(1.0, 2.8e-5, 1e5, 100, 50), 1e5)
    rate = float(re.search(r"use ([\d.e+]+) Hz", str(caught.value))[1])
    found = measure(family_pulse(1.0, 2.8e-5, rate, 2000, 1000), rate, ["contact_duration", "peak_force"])
    assert found == pytest.approx({"contact_duration": 2.8e-5, "peak_force": 1000}, rel=0.05)


def spoilt_batch():
    batch = mixed_batch()
    bad = [3, 100, 280, 299]
    batch[3], batch[100], batch[280], batch[299] = 0.0, -batch[100], np.roll(batch[280], -105), np.roll(batch[299], 295)
    return batch, bad


def test_bad_rows_become_nan_and_no_other():
    batch, bad = spoilt_batch()
    found = extract_array(batch, 1e5, invalid="nan")
    assert np.flatnonzero(np.isnan(found).all(axis=1)).tolist() == bad
    good = np.setdiff1d(np.arange(len(batch)), bad)
    assert found[good] == pytest.approx(extract_array(batch[good], 1e5), rel=1e-9, abs=1e-12)


def test_the_first_bad_row_is_named_and_the_others_counted():
    batch, _ = spoilt_batch()
    with pytest.raises(BadData, match=r"^signal 3: no impact.*\(4 of 300 signals cannot be measured\)"):
        extract_array(batch, 1e5)


# -- real shocks ----------------------------------------------------------------------------------------------


def real_shock(name):
    if not REAL_SHOCK.is_dir():
        pytest.skip("the real shocks are not beside this checkout (../shared/realdata/shock)")
    (recording,) = read_recording(REAL_SHOCK / name)
    return recording


@pytest.mark.parametrize("remove_baseline", [True, False])
def test_real_shock_has_the_published_peak_and_width(remove_baseline):
    (event,) = find_impacts(real_shock("acc_base_a0.txt"))
    found = extract(
        event.signal.samples, event.signal.sampling_rate, ["peak_force", "width_10"], remove_baseline=remove_baseline
    )
    assert event.signal.unit == "g"
    # The recording begins in the foot of the shock and rests at -1.1 g behind it.
    assert 478 <= found["peak_force"][0] <= (487.2 if remove_baseline else 486)
    assert 0.39e-3 <= found["width_10"][0] <= 0.41e-3


# -- anything at all ------------------------------------------------------------------------------------------


@st.composite
def smooth_pulses(draw):
    """A few bells close to each other, of any size, on any offset."""
    t = np.arange(300.0)
    samples = np.zeros(300)
    for _ in range(draw(st.integers(1, 4))):
        centre, spread = draw(st.floats(120, 180)), draw(st.floats(0.3, 25))
        samples += draw(st.floats(0.1, 1.0)) * np.exp(-0.5 * ((t - centre) / spread) ** 2)
    return draw(st.sampled_from([1e-6, 1.0, 1e9])) * (samples + draw(st.sampled_from([0.0, -3.0, 2.0])))


@settings(max_examples=60, deadline=None)
@given(smooth_pulses(), st.sampled_from([np.float32, np.float64]))
def test_smooth_pulses_have_finite_features(samples, kind):
    try:
        found = extract_array(samples.astype(kind), 1e5)
    except BadData:
        return
    assert np.isfinite(found).all()
    assert found[0, 0] > 0


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_shape_that_nothing_determines_is_reported_without_nan(kind):
    t = np.arange(300.0)
    # The fit ends at a shape whose standard deviation is 16,000: as a restitution that overflows.
    bells = [(0.5, 120, 2), (0.25, 123, 1), (0.25, 120, 1), (1, 134, 1)]
    # The likelihood of these lies at restitution 20, where the density of any material is 0 to rounding.
    late = [(0.3, 120.78252823042533, 19.014648953038257), (0.8580561027147163, 158.9256576017263, 2.0763599410584277)]
    for scale, offset, pulses in ((1e-6, 0, bells), (1, 2, late)):
        samples = scale * sum(a * np.exp(-0.5 * ((t - centre) / spread) ** 2) for a, centre, spread in pulses) + offset
        assert np.isfinite(extract_array(samples.astype(kind), 1e5)).all()
    # Nothing at all is known of the second-best shape of these.
    steps = np.full((1, 27), 0.9473683905885226)
    steps[0, [0, 5, 6]] = 0.0, -0.2802392079359967, 0.25937238819329297
    assert np.isfinite(extract_array(1e12 * steps.astype(kind), 1e5, remove_baseline=False)).all()


JUNK = st.one_of(
    arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(6, 40)), elements=st.integers(-3, 9).map(float)),
    arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(6, 40)), elements=st.floats(-1e12, 1e12)),
    arrays(np.float32, st.tuples(st.integers(1, 4), st.integers(6, 40)), elements=st.floats(-1, 1, width=32)),
)


def measured_or_refused(samples, pre_trigger, remove_baseline):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = extract_array(samples, 1e5, pre_trigger=pre_trigger, remove_baseline=remove_baseline, invalid="nan")
    refused = np.isnan(found).all(axis=1)
    assert np.isfinite(found[~refused]).all()


@pytest.mark.long
@pytest.mark.parametrize("n", few([60, 300]))
def test_junk_is_measured_or_refused(n):
    junk = given(JUNK, st.one_of(st.none(), st.integers(0, 5)), st.booleans())
    settings(max_examples=n, deadline=None)(junk(measured_or_refused))()


# -- an AC coupling of the recorder -----------------------------------------------------------------------


def coupled_pulses(edge, noise=0.0, n=12):
    """Pulses of several restitutions and durations, and the same behind a high-pass of first order by scipy."""
    rate, rng = 2e5, np.random.default_rng(5)
    plain = np.stack(
        [family_pulse(0.25 + 0.06 * k, (0.2 + 0.06 * k) * 1e-3, rate, 2048, 200.3 + 0.05 * k) for k in range(n)]
    )
    coupled = signal.lfilter(*signal.butter(1, edge, "high", fs=rate), plain, axis=1)
    added = noise * 1000 * rng.standard_normal(plain.shape)
    return plain + added, coupled + added, rate


@pytest.mark.parametrize(("edge", "noise"), [(20.0, 1e-4), (80.0, 1e-4), (80.0, 0.01)])
def test_an_ac_coupling_is_undone(edge, noise):
    plain, coupled, rate = coupled_pulses(edge, noise)
    names = choose(("fitted_peak", "fitted_width", "fitted_restitution", "unexplained"))
    wanted, found = (extract_array(one, rate, names, pre_trigger=200) for one in (plain, coupled))
    off = np.abs(found[:, :3] / wanted[:, :3] - 1)
    assert (np.median(off, axis=0) < [0.01, 0.01, 0.05]).all()
    assert (found[:, 3] < MAX_UNEXPLAINED).all()
    # Left as they are, they look like other rock: so this is what undoes it.
    left = PulseBatch(coupled, rate, 200)
    assert np.median(np.abs(left.fit.restitution / wanted[:, 2] - 1)) > 3 * np.median(off[:, 2])


def test_what_is_no_ac_coupling_is_left_alone():
    plain, coupled, rate = coupled_pulses(80.0, 0.01, n=10)
    time = np.arange(2048) / rate
    rng = np.random.default_rng(3)
    for changed in (
        plain,
        np.minimum(coupled, 700.0),  # clipped: what was above the limit is unknown
        plain - 3e4 * time,  # drifts
    ):
        pulses = PulseBatch(changed, rate, 200)
        assert pulses.uncoupled() is pulses
    # A level that wanders may look like it.
    walk = np.tile(plain, (40, 1)) + 0.4 * rng.standard_normal((400, 2048)).cumsum(axis=1)
    pulses = PulseBatch(walk, rate, 200)
    assert (pulses.uncoupled().samples != walk).any(axis=1).mean() < 0.15
    # Without samples before onset, or with the level that the user states, nothing says what 0 is.
    assert (kept := PulseBatch(coupled, rate)).uncoupled() is kept
    assert (kept := PulseBatch(coupled, rate, 200, False)).uncoupled() is kept


def test_undoing_a_coupling_does_not_depend_on_the_other_rows():
    plain, coupled, rate = coupled_pulses(50.0, 0.003)
    mixed = np.concatenate([plain[:4], coupled[4:8], np.zeros((1, 2048)), coupled[8:]])
    together = extract_array(mixed, rate, choose(("fitted_peak", "fitted_width")), pre_trigger=200, invalid="nan")
    for row in (0, 5, 9, 12):
        alone = extract_array(mixed[row : row + 1], rate, choose(("fitted_peak", "fitted_width")), pre_trigger=200)
        np.testing.assert_array_equal(alone[0], together[row])
