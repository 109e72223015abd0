"""Impacts solved by finite elements: what the file holds, that it can be made again, what the family makes of them."""

import importlib.util
import io
import warnings

import numpy as np
import pytest

from cgid import shipped
from cgid.errors import BadData, InvalidValue
from cgid.identification.model.model import StoredModel
from cgid.identification.training import measure
from cgid.physics import STEEL, Elastic, HalfSpace, HertzRangeWarning, Impact, Material, Sphere, Viscoelastic
from cgid.physics.contact.sampled import SampledPulses, shares_of_contact
from cgid.scene.synthesis.impacts import draw
from studies.finite_element import ElasticPlate, FiniteElementImpact
from studies.finite_element.solved import MAKING, PARAMETERS, SolvedImpacts, radii, smoothed
from studies.impactor.estimation import estimate
from studies.paper.sensitivity import dissipative_constant

PATH = shipped.path_of("datasets", "finite_element.npz")


@pytest.fixture(scope="module")
def solved():
    return SolvedImpacts.load(PATH)


def sphere_of(solved, rows, radius=1.0):
    names = ("density", "youngs_modulus", "poisson_ratio")
    return Sphere(material=Material(**{name: solved.columns[name][rows] for name in names}), radius=radius)


def run(solved, row, *, radius=1.0, elements=7, steps=200, size=60.0, method="implicit"):
    """Solve one of them again, of another size, on another mesh, or without its loss (explicitly)."""
    sphere, velocity = sphere_of(solved, row, radius), float(solved.columns["velocity"][row])
    law = Impact(
        sphere=sphere, target=HalfSpace(material=STEEL), velocity=velocity, stiffness="hertz", dissipation=Elastic()
    )
    contact_radius = float(np.sqrt(radius * law.peak_displacement))
    block = ElasticPlate(
        material=STEEL, thickness=size * contact_radius, radius=size * contact_radius, lower_face="fixed"
    )
    damped = method == "implicit"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HertzRangeWarning)
        return FiniteElementImpact(
            sphere=sphere,
            plate=block,
            velocity=velocity,
            retardation_time=float(solved.columns["retardation_time"][row]) * radius if damped else 0.0,
            elements=elements,
            method=method,
            time_step=float(law.contact_duration) / steps if damped else None,
        ).run()


def course(history, times):
    """The force over times [s], drawn smoothly as in the file."""
    shares = np.clip(times / history.contact_duration, 0, 1)
    return smoothed(history.times, history.contact_force.samples, history.contact_duration, shares)


def apart(one, other):
    return np.sqrt(np.mean((one - other) ** 2)) / one.max()


def test_the_file_holds_the_rocks_that_the_scene_draws(solved, reference_scene):
    n = len(solved)
    assert n >= 256
    assert set(solved.labels.tolist()) == {"coal", "gangue"}
    drawn = [draw(reference_scene, solved.made["seed"], block) for block in range(-(-n // 256))]
    np.testing.assert_array_equal(solved.labels, np.concatenate([of.labels for of in drawn])[:n])
    for name in (*PARAMETERS[:-1], "restitution"):
        there = np.concatenate([of.parameters[name] for of in drawn])[:n]
        asked = "restitution_asked" if name == "restitution" else name
        np.testing.assert_allclose(solved.columns[asked], there, rtol=1e-13, err_msg=name)


def test_restitutions_are_those_asked_for_and_impulses_fit_them(solved):
    """The rebound of the solver's sphere and the integral of its force know nothing of each other."""
    columns = solved.columns
    assert np.abs(columns["restitution"] - columns["restitution_asked"]).max() < 0.003
    mass = sphere_of(solved, slice(None)).mass
    impulse = solved.pulses.impulse
    np.testing.assert_allclose(impulse, (1 + columns["restitution"]) * mass * columns["velocity"], rtol=2e-3)


def test_the_maker_makes_the_rows_of_the_file(solved):
    maker = module_of(PATH.with_name("make_finite_element.py"))
    assert solved.made == maker.MADE
    (rock,) = maker.drawn_impacts(1)
    made = maker.solve(solved.made["points"], rock)
    np.testing.assert_allclose(made["forces"], solved.pulses.forces[0], atol=1e-3 * solved.pulses.peak_force[0])
    assert made["label"] == solved.labels[0]
    for name in (*PARAMETERS, *MAKING):
        assert made[name] == pytest.approx(solved.columns[name][0], rel=1e-3), name
    rows = maker.kept(PATH, maker.drawn_impacts(len(solved)))
    assert rows[0].keys() == made.keys()
    require_alike(maker.gathered(rows), solved)


def require_alike(found, expected):
    """Rocks are drawn anew, and a processor may change their last digits; what was solved is kept as it is."""
    np.testing.assert_array_equal(found.labels, expected.labels)
    np.testing.assert_array_equal(found.pulses.forces, expected.pulses.forces)
    assert found.columns.keys() == expected.columns.keys()
    for name, values in expected.columns.items():
        np.testing.assert_allclose(found.columns[name], values, rtol=1e-13, err_msg=name)


def module_of(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_signals_have_sizes_and_noise_of_the_scene(solved, reference_scene):
    batches = list(solved.signals(reference_scene, seed=3))
    assert sum(map(len, batches)) == len(solved)
    radius = np.concatenate([batch.parameters["radius"] for batch in batches])
    assert 0.01 <= radius.min() < 0.012
    assert 0.07 < radius.max() <= 0.08
    np.testing.assert_array_equal(radius, radii(reference_scene, solved.labels, 3))
    drawn = draw(reference_scene, 3, 0)
    n = min(256, len(solved))
    same = drawn.labels[:n] == solved.labels[:n]
    np.testing.assert_array_equal(radius[:n][same], drawn.parameters["radius"][:n][same])
    (first,) = batches[:1]
    peak = solved.pulses.peak_force[:n] * radius[:n] ** 2
    np.testing.assert_allclose(first.parameters["peak_force"], peak, rtol=1e-6)
    noise = first.signals[:, :150].std(axis=1) / peak
    assert np.median(noise) == pytest.approx(0.01, rel=0.05)
    with pytest.raises(InvalidValue, match="label must be one of 'gangue', 'coal', got 'ice'"):
        radii(reference_scene, np.array(["ice"]), 3)


# -- what the family and the model make of them ------------------------------------------------------------------------


def read_off(pulses):
    """The family fitted to pulses without noise, all stretched to one duration."""
    alike = pulses.stretched(1 / pulses.peak_force, 1 / pulses.contact_duration)
    frames = np.zeros((len(pulses), 1600))
    alike.add_to_frames(frames, 400.0, np.full(len(pulses), 1.0))
    return estimate(frames, 400.0, pre_trigger=200, noise=1e-3)


def test_the_restitution_of_a_viscoelastic_sphere_is_read_off_too_high(solved):
    """A force that rises at once, as a viscoelastic sphere's, looks to the family like that of a livelier rock."""
    found = read_off(solved.pulses)
    error = found.restitution - solved.columns["restitution"]
    assert 0.17 < error.mean() < 0.27
    assert error.std() < 0.03
    assert not found.of_family.any()


@pytest.mark.long
def test_elastic_impacts_are_of_the_family(solved):
    """So it is the law of the loss that the family does not know, and not the contact of two bodies."""
    history = run(solved, 0, elements=7, method="explicit")
    shares = shares_of_contact(128)
    forces = smoothed(history.times, history.contact_force.samples, history.contact_duration, shares)
    pulses = SampledPulses(shares=shares, forces=forces[None], contact_duration=np.array([history.contact_duration]))
    assert read_off(pulses).restitution[0] == pytest.approx(1.0, abs=0.05)


def test_the_model_knows_them_though_no_training_saw_them(solved, reference_scene):
    model = StoredModel.load(shipped.path_of("models", shipped.DEFAULT_MODEL))
    measured = measure(solved.signals(reference_scene, seed=5), model.measured)
    inputs, guards = np.split(measured.features, [len(model.features)], axis=1)
    assert measured.left_out == 0
    assert np.mean(model.novelty(inputs, guards) > 1) < 0.02
    found = model.decide(model.probabilities(inputs))
    for label in ("coal", "gangue"):
        assert np.mean(found[measured.labels == label] == label) > 0.85


# -- curves through rippled courses, and bad files ---------------------------------------------------------------------


@pytest.mark.parametrize("restitution", [0.2, 0.5, 0.8])
def test_a_smooth_course_stays_and_its_steps_go(restitution):
    common = {
        "sphere": Sphere(material=Material(density=1400, youngs_modulus=3e9, poisson_ratio=0.3), radius=0.03),
        "target": HalfSpace(material=STEEL),
        "velocity": 4.0,
        "stiffness": "hertz",
    }
    constant = dissipative_constant(restitution, Impact(dissipation=Elastic(), **common))
    impact = Impact(dissipation=Viscoelastic(dissipative_constant=constant), **common)
    duration, peak = float(impact.contact_duration), float(impact.peak_force)
    times, shares = np.linspace(0, 1.2, 400) * duration, shares_of_contact(200)
    force, truth = impact.force(times), impact.force(shares[:-1] * duration)
    smooth = smoothed(times, force, duration, shares)[:-1]
    assert np.abs(smooth - truth).max() < 0.004 * peak
    assert apart(truth, smooth) < 0.001
    steps = 0.02 * peak * ((14 * np.sqrt(np.clip(times / duration, 0, 1))) % 1 - 0.5) * (force > 0)
    assert apart(truth, smoothed(times, force + steps, duration, shares)[:-1]) < 0.003
    curve = smoothed(times, force + steps + 0.01 * peak, duration, shares)
    assert curve[0] == curve[-1] == 0.0
    with pytest.raises(InvalidValue, match="24 samples or more within contact for 8 knots, got 19"):
        smoothed(np.linspace(0, 1, 21), np.ones(21), 1.0, shares)
    with pytest.raises(InvalidValue, match="times must cover the contact for 8 knots"):
        smoothed(np.linspace(0, 0.3, 99), np.ones(99), 1.0, shares)
    with pytest.raises(InvalidValue, match=r"times must rise, got 0\.25 s after 0\.5 s at index 1"):
        smoothed([0.5, 0.25, 1], np.ones(3), 1.0, shares)
    with pytest.raises(InvalidValue, match=r"forces must be one for each of the times, got shape \(2,\) for \(3,\)"):
        smoothed([0.25, 0.5, 1], np.ones(2), 1.0, shares)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"labels": None}, "labels"),
        ({"forces": np.ones((2, 3))}, "forces must have a row for each contact_duration"),
        ({"velocity": np.array([{}], object)}, "allow_pickle"),
        ({"made": np.zeros(3, np.uint8)}, "no solved impacts"),
        ({"labels": np.zeros(256)}, "labels must be text"),
        ({"density": np.full(256, -1.0)}, "density must be above 0"),
    ],
)
def test_other_files_are_refused(solved, tmp_path, change, message):
    with np.load(PATH) as stored:
        arrays = {name: stored[name] for name in stored.files} | change
    stream = io.BytesIO()
    np.savez(stream, **{name: values for name, values in arrays.items() if values is not None})
    path = tmp_path / "other.npz"
    path.write_bytes(stream.getvalue())
    with pytest.raises(BadData, match=message):
        SolvedImpacts.load(path)
