"""The independent impacts of `benchmarks/impact/rock_pulses.py`.

They judge the package, so first they are judged themselves: by closed forms, by DOP853 away from the nodes of the
tables, and by the package's own physics, which they share nothing with.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from benchmarks.identification import rock
from benchmarks.impact import rock_pulses
from benchmarks.impact.rock_pulses import CASES, LAWS, RATE, record, viscous
from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.physics import (
    STEEL,
    HalfSpace,
    HuntCrossley,
    Impact,
    Material,
    PowerLaw,
    Sphere,
    Thornton,
    Viscoelastic,
    WaltonBraun,
)


def test_hunt_crossley_has_its_exact_restitution():
    table = viscous("hunt-crossley")
    e = table.restitution[(table.restitution > 0.1) & (table.restitution < 1)]
    loss = table.loss(e)
    # v dv / (1 + D v) = -x^1.5 dx, integrated over loading and unloading
    assert loss * (1 + e) == pytest.approx(np.log((1 + loss) / (1 - loss * e)), rel=1e-9)


@pytest.mark.parametrize("law", ["hunt-crossley", "kuwabara-kono"])
@pytest.mark.parametrize("e", [0.1123, 0.1512, 0.353, 0.707, 0.934])
def test_interpolated_pulse_is_that_of_an_integration(law, e):
    table = viscous(law)
    delivered, duration, force = rock_pulses.integrate(law, float(table.loss(e)))
    assert delivered == pytest.approx(e, abs=3e-7)
    assert table.duration(e) == pytest.approx(duration, rel=3e-7)
    share = np.linspace(0, 1, 3001)[1:-1]
    curve = table.peak(e) * table.force.ev(e, 2 / np.pi * np.arcsin(np.sqrt(share)))
    assert np.abs(curve - force(share * duration)).max() < 3e-6 * table.peak(e)


@pytest.mark.parametrize("ratio", [1e-3, 0.05, 0.3, 0.8, 0.999, 1.0, 3.0])
def test_thornton_by_branches_is_the_closed_form(ratio):
    found = rock_pulses.thornton(np.array([ratio]))
    assert found.restitution[0] == pytest.approx(rock_pulses.thornton_restitution(ratio), rel=1e-12)
    row = np.zeros(1, np.intp)
    ends = (0, found.first[0], found.second[0], found.third[0])
    impulse = sum(
        quad(lambda t: found.force(np.array([t]), row)[0], low, high, epsabs=1e-11)[0]
        for low, high in pairwise(ends)
        if high > low
    )
    assert found.peak[0] * impulse == pytest.approx(1 + found.restitution[0], rel=1e-8)


def test_thornton_is_its_equation_of_motion():
    ratio = 0.3
    found, row = rock_pulses.thornton(np.array([ratio])), np.zeros(2000, np.intp)
    depth = 1.25**0.4 * ratio**0.8

    def load(x):
        return x**1.5 if x < depth else depth**1.5 + 1.5 * np.sqrt(depth) * (x - depth)

    t = np.linspace(0, found.second[0], 2000)
    run = solve_ivp(
        lambda _, s: [s[1], -load(max(s[0], 0))], (0, t[-1]), [0, 1], "DOP853", t, rtol=1e-11, atol=1e-13, max_step=1e-2
    )
    expected = np.array([load(max(x, 0)) for x in run.y[0]])
    assert found.peak[0] * found.force(t, row) == pytest.approx(expected, abs=1e-7)


def loss_of(law, rock, k):
    e = rock.restitution[k]
    depth = (rock.mass[k] * rock.speed[k] ** 2 / (4 / 3 * rock.modulus[k] * np.sqrt(rock.radius[k]))) ** 0.4
    match law:
        case "hunt-crossley":
            return HuntCrossley(restitution=e)
        case "kuwabara-kono":
            return Viscoelastic(dissipative_constant=viscous(law).loss(e) * depth / rock.speed[k])
        case "thornton":
            at_yield = depth * (1.25 * rock_pulses.yield_ratio(rock.restitution[k : k + 1])[0] ** 2) ** 0.4
            return Thornton(yield_pressure=2 * rock.modulus[k] / np.pi * np.sqrt(at_yield / rock.radius[k]))
        case "thornton by strength":
            return Thornton(yield_pressure=rock.yield_pressure[k])
        case "cone":  # of half angles of 60 to 80 degrees
            slope = np.tan(np.radians(60 + 20 * rock.other[k, 0]))
            return PowerLaw(restitution=e, exponent=2, contact_radius=2 / slope)
        case "face":  # of .1 to .4 of the radius
            return PowerLaw(restitution=e, exponent=1, contact_radius=0.1 * 4 ** rock.other[k, 0])
        case "fragmentation":
            breaks, left = 0.4 + 0.5 * rock.other[k, 0], 0.3 + 0.4 * rock.other[k, 1]
            return PowerLaw(restitution=e, breaking_force=breaks, remaining_force=left)
    return WaltonBraun(restitution=e)


@pytest.mark.filterwarnings("ignore::cgid.physics.HertzRangeWarning")  # sharp corners
@pytest.mark.parametrize("law", [*LAWS, "cone", "face", "fragmentation"])
def test_package_makes_the_same_pulses(law):
    """Two programs, one physics: eight rocks with sharp corners and eccentric blows."""
    stepped = law not in LAWS  # by steps of a fixed length, here and there across a kink
    case = replace(
        CASES[f"{law}, 1%" if stepped else law], curvature=("log-uniform", 0.1, 1.0), mass_share=("uniform", 0.4, 1.0)
    )
    rock = rock_pulses.rocks(case, 8, np.random.default_rng(3))
    pulse = rock_pulses.pulses(rock)
    for k in range(8):
        # A sphere of the contact's radius, as heavy as the share of the rock, of the same effective modulus.
        modulus = 1 / (1 / rock.modulus[k] - (1 - 0.3**2) / 210e9)
        density = rock.mass[k] / (4 / 3 * np.pi * rock.radius[k] ** 3)
        lump = Material(density=density, youngs_modulus=modulus * (1 - 0.25**2), poisson_ratio=0.25)
        impact = Impact(
            sphere=Sphere(material=lump, radius=rock.radius[k]),
            target=HalfSpace(material=STEEL),
            velocity=rock.speed[k],
            stiffness="hertz",
            dissipation=loss_of(law, rock, k),
        )
        if law != "fragmentation":
            assert float(impact.restitution) == pytest.approx(pulse.restitution[k], abs=2e-6)
        assert float(impact.peak_force) == pytest.approx(pulse.peak[k], rel=5e-3 if stepped else 2e-6)
        assert float(impact.contact_duration) == pytest.approx(pulse.duration[k], rel=5e-3 if stepped else 2e-6)
        t = np.linspace(0, 1, 500)[1:-1] * pulse.duration[k]
        own = pulse.force(t, np.full(len(t), k))
        error = np.abs(own - impact.force(t) / pulse.peak[k])
        assert (np.quantile(error, 0.98) < 5e-3) if stepped else (error.max() < 1e-5)


# -- recorder -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_signal_is_quiet_before_touch_and_holds_the_peak(name):
    case, impacts = CASES[name], record(CASES[name], 64, 8)
    assert impacts.signals.shape == (64, 2048)
    assert np.isfinite(impacts.signals).all()
    noise = max(case.noise, case.pink, case.hum)
    # The bits of the fixed range are a coarse noise of their own.
    step = 2 * rock_pulses.largest_peak(case) / 2**12 if case.range == "fixed" else 0.0
    room = (6 * noise + 1e-3) * impacts.peak + step
    assert (np.abs(impacts.signals[:, : case.trigger]).max(axis=1) <= room).all()
    top = impacts.signals.max(axis=1)
    if case.clipped:
        assert top == pytest.approx(case.clipped * impacts.peak, rel=1e-6)
    elif case.edge:
        assert (top < (1.1 + 5 * noise) * impacts.peak).all()
    else:
        samples = impacts.duration * RATE
        assert (np.abs(top - impacts.peak) <= room + impacts.peak * 3 / samples).all()


def test_recorded_force_is_that_of_the_pulse_at_each_sample():
    impacts = record(replace(CASES["walton-braun"], noise=0.0), 16, 2)
    for k in range(16):
        t = np.arange(2048) - impacts.touch[k]
        rise = impacts.duration[k] * RATE / (1 + impacts.restitution[k])
        fall = rise * impacts.restitution[k]
        up = np.where((t > 0) & (t <= rise), np.sin(np.pi / 2 * t / rise), 0)
        down = np.where((t > rise) & (t < rise + fall), np.cos(np.pi / 2 * (t - rise) / fall), 0)
        assert impacts.signals[k] / impacts.peak[k] == pytest.approx(up + down, abs=1e-6)


def test_anti_alias_filter_holds_what_is_far_below_its_edge():
    """A contact that is long beside the filter comes through delayed by its delay at low frequencies, and unchanged."""
    case = replace(CASES["anti-alias 20 kHz"], noise=0.0)
    filtered, plain = record(case, 256, 4), record(replace(case, edge=None), 256, 4)
    k = int(np.argmax(plain.duration))
    delay = 5.126 / (2 * np.pi * 20e3) * RATE  # the sum of 2 sin over the poles of order 8
    t = np.arange(2048)
    moved = np.interp(t - delay, t, plain.signals[k])
    assert np.abs(filtered.signals[k] - moved).max() < 0.01 * plain.peak[k]


# -- tables -------------------------------------------------------------------------------------------------


def test_figures_of_answers_by_hand():
    coal = np.array([0.95, 0.95, 0.85, 0.2, 0.5])
    labels = np.array(["coal", "gangue", "coal", "gangue", "gangue"])
    unknown = np.array([False, True, False, False, True])  # the last could not be measured
    found = rock.Answered(coal, unknown, labels).figures()
    assert found["accuracy"] == pytest.approx(3 / 5)
    assert found["unknown"] == pytest.approx(2 / 5)
    assert found["of the answered"] == 1
    assert found["forced"] == pytest.approx(3.5 / 5)
    assert found["recall of gangue"] == pytest.approx((0 + 1 + 0.5) / 3)
    # bins: .95 and .95 hold one coal, .85 one, .2 and .5 none
    assert found["calibration error"] == pytest.approx((abs(1.9 - 1) + abs(0.85 - 1) + 0.2 + 0.5) / 5)
    chance = np.sqrt([2 * 0.95 * 0.05, 0.85 * 0.15, 0.2 * 0.8, 0.25]).sum() * np.sqrt(2 / np.pi) / 5
    assert found["by chance"] == pytest.approx(chance)


def test_rows_of_a_scene_come_apart_by_law(reference_scene):
    crushed = tuple(one.model_copy(update={"dissipation": "walton-braun"}) for one in reference_scene.populations)
    scene = reference_scene.model_copy(update={"populations": (*reference_scene.populations, *crushed)})
    rows = rock.rows_by_law([(scene, 128)], ("fitted_restitution", "misfit"), 1)
    assert [law for law, _ in rows] == ["hunt-crossley", "walton-braun"]
    misfit = {law: np.median(own.columns(("misfit",))) for law, own in rows}
    assert misfit["hunt-crossley"] < 1.3 < misfit["walton-braun"]
    both = rock.joined([own for _, own in rows])
    assert len(both.labels) == 128
    assert len(np.unique(both.group)) == 128
    assert np.bincount(both.source).tolist() == [64, 64]


def test_learner_and_model_know_the_laws_of_two_cases():
    model = StoredModel.load(shipped.path_of("models", shipped.DEFAULT_MODEL))
    lines = list(rock.table_of_cases(model, ["hunt-crossley", "walton-braun"], 300, 1000))
    assert lines[0]["accuracy"] > 0.83
    assert min(line["learner"] for line in lines) > 0.83
