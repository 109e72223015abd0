"""The independent beam of `benchmarks/beam/independent_beam.py` and its finite elements.

It judges the package, so first it is judged itself: by closed forms, a finer mesh, the balance of energy, Newmark's
method on the full matrices, and the package's own physics, which it shares nothing with.
"""

import tempfile
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg, signal, sparse, stats
from scipy.sparse.linalg import splu

from benchmarks.beam import independent_beam, independent_modes
from benchmarks.beam.independent_beam import Attached, Variant
from benchmarks.beam.independent_contact import Contact, Stepped, hunt_crossley_loss, residual, summary
from benchmarks.beam.independent_modes import Beam, lowest, model
from benchmarks.impact import rock_pulses
from cgid.measure.modal import Modes as MeasuredModes
from cgid.physics import (
    STEEL,
    HalfSpace,
    HuntCrossley,
    LowPass,
    Material,
    ModalImpact,
    Resonance,
    Response,
    Ribs,
    Sphere,
    TailBeam,
)
from cgid.scene import load_scene
from cgid.scene.synthesis.draws import drawn_block


def frequencies(beam, highest):
    return np.sort(np.concatenate([lowest(*model(beam, parity)[:2], highest)[0] for parity in ("even", "odd")]))


# --- modes ---


def test_a_simply_supported_plate_has_mindlins_frequencies():
    """`(D k^2 + S - J w^2)(S k^2 - m w^2) = S^2 k^2` for half waves i and j, its lower root."""
    beam = Beam(edges="simply-supported", ribs="none", length=0.9, width=0.7, thickness=0.06, element=0.2)
    i, j = np.meshgrid(np.arange(1, 8), np.arange(1, 8))
    k2 = (np.pi**2 * ((i / beam.length) ** 2 + (j / beam.width) ** 2)).ravel()
    h, density = beam.thickness, beam.density
    bending = beam.youngs_modulus * h**3 / (12 * (1 - beam.poisson_ratio**2))
    shear, mass, rotary = 5 / 6 * beam.shear_modulus * h, density * h, density * h**3 / 12
    b = -(mass * (bending * k2 + shear) + rotary * shear * k2)
    omega = np.sqrt((-b - np.sqrt(b**2 - 4 * rotary * mass * bending * shear * k2**2)) / (2 * rotary * mass))
    exact = np.sort(omega / (2 * np.pi))
    found = frequencies(beam, 7000.0)
    assert len(found) == np.searchsorted(exact, 7000.0) > 20
    np.testing.assert_allclose(found, exact[: len(found)], rtol=3e-4)
    thin = np.sort(np.sqrt(bending / mass) * k2 / (2 * np.pi))[: len(found)]
    assert (found / thin)[-1] < 0.9  # shear matters in this plate


def test_a_thin_cantilever_has_the_packages_frequencies():
    beam = Beam(ribs="none", length=0.8, width=0.7, thickness=0.004, element=0.1)
    thin = TailBeam(material=STEEL, length=0.8, width=0.7, thickness=0.004, edges="cantilever", damping_ratio=0.02)
    expected = thin.modes(500.0).frequency
    np.testing.assert_allclose(frequencies(beam, 500.0)[: len(expected)], expected, rtol=3e-3)


def test_without_shear_and_rotary_inertia_the_smeared_beam_is_the_packages():
    panel = load_scene("tail_beam").panel
    expected = panel.modes(2000.0).frequency
    found = frequencies(Beam(ribs="smeared", mindlin=1e-4, element=0.2), 2100.0)
    np.testing.assert_allclose(found[: len(expected)], expected, rtol=2e-3)


@pytest.mark.parametrize("ribs", ["shells", "beams"])
def test_low_ribs_are_as_the_packages_smeared_ones(ribs):
    """Ribs as deep as the skin is thick, and waves of many spacings."""
    sizes = {"length": 1.6, "width": 1.4, "thickness": 0.012}
    panel = TailBeam(
        material=STEEL, edges="cantilever", damping_ratio=0.02, ribs=Ribs(number=8, depth=0.03, thickness=0.01), **sizes
    )
    expected = panel.modes(120.0).frequency[:6]
    beam = Beam(ribs=ribs, depth=0.03, rib_thickness=0.01, element=0.4, **sizes)
    np.testing.assert_allclose(frequencies(beam, 130.0)[:6], expected, rtol=0.03)


@pytest.mark.parametrize("ribs", ["shells", "beams"])
def test_a_slender_cantilever_with_ribs_is_a_beam(ribs):
    """Euler and Bernoulli about the neutral axis of the whole section, ten lengths of it long."""
    beam = Beam(ribs=ribs, number=2, length=6.0, width=0.2, depth=0.15, element=1.0, poisson_ratio=0.0)
    areas = np.array([beam.width * beam.thickness, 2 * beam.depth * beam.rib_thickness])
    heights = np.array([0.0, -(beam.thickness + beam.depth) / 2])
    own = areas * np.array([beam.thickness, beam.depth]) ** 2 / 12
    axis = (areas * heights).sum() / areas.sum()
    inertia = (own + areas * (heights - axis) ** 2).sum()
    expected = 1.8751040687**2 * np.sqrt(beam.youngs_modulus * inertia / (beam.density * areas.sum())) / 6.0**2
    found = lowest(*model(beam, "even")[:2], 50.0)[0][0]
    assert found == pytest.approx(expected / (2 * np.pi), rel=3e-3)


# --- impacts ---


@pytest.fixture
def few_modes(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(independent_beam, "HIGHEST", 3000.0)
    independent_beam.modes_for.cache_clear()
    yield Beam(element=0.3)
    independent_beam.modes_for.cache_clear()


def test_the_package_strikes_the_same_modes_alike(few_modes):
    """Its coupled contact, its response by poles, of the same modes."""
    n, modes = 6, independent_beam.modes_for(Variant(ribs="smeared"), few_modes)
    made = independent_beam.generate(n, 1, Variant(ribs="smeared"), noise=0.0, beam=few_modes)
    rock = independent_beam.rocks(n, np.random.default_rng([1, 0]))
    shape = modes.shape(rock.x, rock.y)
    alike = rock.stiffness / (4 / 3 * np.sqrt(rock.radius))
    impact = ModalImpact(
        sphere=Sphere(
            material=Material(
                density=rock.mass / (4 / 3 * np.pi * rock.radius**3),
                youngs_modulus=(1 - 0.3**2) / (1 / alike - (1 - 0.3**2) / 210e9),
                poisson_ratio=0.3,
            ),
            radius=rock.radius,
        ),
        target=HalfSpace(material=Material(density=7850.0, youngs_modulus=210e9, poisson_ratio=0.3)),
        velocity=rock.speed,
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=rock.restitution),
        frequency=modes.frequency,
        damping_ratio=0.02,
        compliance=shape**2,
        residual_compliance=residual(2 * np.pi * modes.frequency, shape),
    )
    assert made["restitution"] == pytest.approx(impact.restitution, abs=5e-5)
    for name in ("peak_force", "end_of_contact"):
        assert made[name] == pytest.approx(getattr(impact, name), rel=1e-4)
    # The beam leaves one rock for a moment: Hunt and Crossley's force would pull, and is 0, at a depth above 0.
    steady = made["contact_duration"] == made["end_of_contact"]
    assert steady.sum() == n - 1
    assert made["contact_duration"][steady] == pytest.approx(impact.contact_duration[steady], rel=1e-4)
    measured = MeasuredModes(
        frequency=modes.frequency,
        damping_ratio=np.full(len(modes.frequency), 0.02),
        at_impact=shape[0],
        at_sensor=modes.shape(*independent_beam.SENSOR)[0],
    )
    response = Response(
        sampling_rate=independent_beam.RATE,
        quantity="acceleration",
        modes=measured,
        filters=(Resonance(frequency=25e3, damping_ratio=0.05), LowPass(frequency=10e3)),
        tolerance=1e-5,
    )
    frames = np.zeros((n, independent_beam.SAMPLES))
    response.add_to_frames(frames, impact, made["onset"], shape * measured.at_sensor)
    off = np.abs(made["acceleration"] - frames).max(axis=1) / np.abs(frames).max(axis=1)
    assert off.max() < 1e-3


@pytest.fixture(scope="module")
def coarse():
    """All modes of a coarse beam, dense; both halves side by side, with w at points of the skin."""
    beam = Beam(ribs="beams", number=2, element=0.8, degree=4)
    halves = [model(beam, parity) for parity in ("even", "odd")]
    stiffness = sparse.block_diag([2 * half.stiffness for half in halves]).tocsc()
    mass = sparse.block_diag([2 * half.mass for half in halves]).tocsc()

    def at(x, y):
        """Return the unit force at a point: w there, by every unknown."""
        columns = []
        for sign, half in zip((1.0, -1.0), halves, strict=True):
            rows, along = independent_modes.weights_at(half.x, np.array([x]))
            lines, across = independent_modes.weights_at(half.y, np.array([min(y, beam.width - y)]))
            out = np.zeros(half.stiffness.shape[0])
            numbers = half.skin[rows[0]][:, lines[0]]
            weights = np.outer(along[0], across[0]) * (sign if y > beam.width / 2 else 1.0)
            np.add.at(out, numbers[numbers >= 0], weights[numbers >= 0])
            columns.append(out)
        return np.concatenate(columns)

    values, vectors = linalg.eigh(stiffness.toarray(), mass.toarray())
    return stiffness, mass, at, np.sqrt(values), vectors


def test_energy_is_kept_in_an_elastic_impact_without_damping(coarse):
    *_, at, omega, vectors = coarse
    shape = at(1.2, 0.9) @ vectors
    ready = Stepped(omega[:120], np.zeros(120), np.zeros((0, 120)), np.zeros((0, 3)), independent_beam.RATE)
    off = []
    for steps in (300, 1200):
        hit = ready.strike(shape[:120], 0.0, 1.5, 1.2e10, 0.0, 4.0, steps)
        rest = 0.5 * np.sum(hit.state[1, :120] ** 2 + (omega[:120] * hit.state[0, :120]) ** 2)
        off.append(rest / (0.5 * 1.5 * 4.0**2) + (hit.velocity / 4.0) ** 2 - 1)
    assert rest > 0.02 * 0.5 * 1.5 * 4.0**2  # the beam does take energy
    assert abs(off[0]) < 1e-4
    assert abs(off[1]) < 1e-5
    impulse = hit.force.sum() * hit.step
    assert impulse == pytest.approx(1.5 * (4.0 - hit.velocity), rel=1e-9)


@pytest.mark.parametrize("law", ["cone", "face", "fragmentation"])
def test_a_contact_that_is_no_sphere_is_that_of_a_rigid_wall_on_a_beam_that_hardly_gives(law):
    n, ready = (
        8,
        Stepped(np.full(1, 400.0), np.full(1, 0.02), np.zeros((0, 1)), np.zeros((0, 3)), independent_beam.RATE),
    )
    rock = independent_beam.rocks(n, np.random.default_rng(4))
    depth = (rock.mass * rock.speed**2 / rock.stiffness) ** 0.4
    peak, duration, _ = rock_pulses.stepped(
        law, np.random.default_rng(5).random((n, 7)), rock.restitution, depth / rock.radius
    )
    touching = independent_beam.contacts(law, rock, np.random.default_rng(5))
    loss = hunt_crossley_loss(rock.restitution)
    for k in range(n):
        hit = ready.strike(
            np.full(1, 1e-6), 0.0, rock.mass[k], touching.stiffness[k], loss[k], rock.speed[k], 600,
            touching.exponent[k], touching.breaks[k], touching.left[k],
        )  # fmt: skip
        top, first, _, velocity = summary(hit)
        assert top == pytest.approx(peak[k] * rock.mass[k] * rock.speed[k] ** 2 / depth[k], rel=0.01)
        assert first == pytest.approx(duration[k] * depth[k] / rock.speed[k], rel=0.01)
        if law != "fragmentation":
            assert -velocity / rock.speed[k] == pytest.approx(rock.restitution[k], abs=2e-3)


@pytest.mark.parametrize(
    "attached",
    [
        pytest.param((), marks=pytest.mark.long),
        pytest.param((Attached(1.3, 0.3, 6e3), Attached(0.7, 1.1, 3e3)), marks=pytest.mark.long),
        (Attached(1.25, 0.95, 2.2e4, 60.0, 2e8),),
    ],
)
def test_newmarks_method_on_the_full_matrices_agrees(coarse, attached):
    """A half sine through beam, dampers or a lump, mounting and filter; damping proportional to mass and stiffness."""
    stiffness, mass, at, omega, vectors = coarse
    alpha, beta, step, pulse = 8.0, 3e-6, 1 / (independent_beam.RATE * 32), 1.2e-3
    struck, sensor = at(1.2, 0.9), at(0.5, 0.45)
    n, lumps = stiffness.shape[0], sum(np.isfinite(one.mass) for one in attached)
    damping = alpha * mass + beta * stiffness
    stiffness, mass, damping = (
        sparse.block_diag([part, sparse.csc_array((lumps, lumps))]).tolil() if lumps else part.tolil()
        for part in (stiffness, mass, damping)
    )
    stiffness, mass, damping = (sparse.csc_array(part) for part in (stiffness, mass, damping))
    for one in attached:
        row = np.zeros((1, n + lumps))
        row[0, :n] = at(one.x, one.y)
        if np.isfinite(one.mass):
            row[0, n] = -1.0
            own = sparse.csc_array(([one.mass], ([n], [n])), shape=mass.shape)
            mass, stiffness = mass + own, stiffness + one.spring * sparse.csc_array(row.T @ row)
        damping = damping + one.damper * sparse.csc_array(row.T @ row)
    force = np.sin(np.pi * np.arange(int(pulse / step) + 1) * step / pulse)
    force[-1] = 0.0
    count = 160 * 32
    acceleration = newmark(mass, damping, stiffness, np.pad(struck, (0, lumps)), force, step, count)
    slow = acceleration @ np.pad(sensor, (0, lumps))
    for pole in (*Resonance(frequency=25e3, damping_ratio=0.05).poles, *LowPass(frequency=10e3).poles):
        section = signal.lti([abs(pole) ** 2], [1.0, -2 * pole.real, abs(pole) ** 2]).to_discrete(step, "foh")
        slow = signal.lfilter(np.ravel(section.num), np.ravel(section.den), slow)
    modal = alpha / (2 * omega) + beta * omega / 2
    held = np.array([at(one.x, one.y) @ vectors for one in attached]).reshape(len(attached), len(omega))
    s = independent_beam.laplace_points()
    table = independent_beam.transfer(s, omega, modal, sensor @ vectors, held, attached)
    spectrum = independent_beam.spectra([Contact(force, step, 0.0, np.empty(0))], np.zeros(1), s)
    fast = independent_beam.sampled(spectrum * ((struck @ vectors) @ table), s)[0]
    slow = slow[::32]
    np.testing.assert_allclose(fast[: len(slow)], slow, atol=3e-3 * np.abs(slow).max())


def newmark(mass, damping, stiffness, shape, force, step, count):
    """Return the accelerations (count, n) by the trapezoidal rule, from rest."""
    factor = splu(sparse.csc_matrix(mass + step / 2 * damping + step**2 / 4 * stiffness))
    w, v, a = (np.zeros(len(shape)) for _ in range(3))
    out = np.zeros((count, len(shape)))
    for k in range(1, count):
        drive = force[k] if k < len(force) else 0.0
        v_half, w_half = v + step / 2 * a, w + step * v + step**2 / 4 * a
        a = factor.solve(shape * drive - damping @ v_half - stiffness @ w_half)
        w, v = w_half + step**2 / 4 * a, v_half + step / 2 * a
        out[k] = a
    return out


def test_rocks_are_those_of_the_scene():
    """Two draws of 4,096, compared label by label by Kolmogorov and Smirnov."""
    drawn = [drawn_block(load_scene("tail_beam"), 11, block) for block in range(16)]
    labels = np.concatenate([block.labels for block in drawn])
    theirs = {name: np.concatenate([block.values[name] for block in drawn]) for name in drawn[0].values}
    theirs["mass"] = 4 / 3 * np.pi * theirs["density"] * theirs["radius"] ** 3
    softness = (1 - theirs["poisson_ratio"] ** 2) / theirs["youngs_modulus"] + (1 - 0.3**2) / 210e9
    theirs["stiffness"] = 4 / 3 / softness * np.sqrt(theirs["radius"])
    ours = independent_beam.rocks(4096, np.random.default_rng(12))
    names = {"speed": "velocity", "x": "impact_x", "y": "impact_y"}
    for label in ("coal", "gangue"):
        assert (ours.labels == label).mean() == pytest.approx(0.5, abs=0.03)
        for name in ("mass", "radius", "stiffness", "speed", "restitution", "x", "y"):
            other = theirs[names.get(name, name)][labels == label]
            assert stats.ks_2samp(getattr(ours, name)[ours.labels == label], other).pvalue > 1e-3, name


def test_frames_are_those_of_the_scene(few_modes):
    made = {
        name: independent_beam.generate(20, 3, Variant(ribs="smeared", **own), noise=noise, beam=few_modes)
        for name, own, noise in (
            ("clean", {}, 0.0),
            ("plain", {}, 1.0),
            ("machine", {"white": 0.1, "pink": 1.0, "hum": (1.0,)}, 1.0),
        )
    }
    clean, plain = made["clean"], made["plain"]
    for name in ("labels", "onset", "impact_x", "peak_force", "restitution"):
        assert all((one[name] == clean[name]).all() for one in made.values())
    assert clean["acceleration"].shape == (20, 2048) and set(clean["labels"]) == {"coal", "gangue"}
    assert (clean["impact_x"] >= 0.8).all() and (clean["impact_x"] <= 1.5).all()
    assert ((clean["onset"] >= 128 / 25600) & (clean["onset"] < 129 / 25600)).all()
    assert clean["restitution"].mean() < clean["material_restitution"].mean()  # the beam takes energy, too
    loudest = np.abs(clean["acceleration"]).max(axis=1, keepdims=True)
    assert np.abs(clean["acceleration"][:, :128]).max() < 1e-5 * loudest.max()
    added = plain["acceleration"] - clean["acceleration"]
    assert added.std() == pytest.approx(independent_beam.NOISE, rel=0.01)
    before = np.abs(np.fft.rfft(made["machine"]["acceleration"] - clean["acceleration"], axis=1)) ** 2
    low, middle, high = (before[:, lines].mean() for lines in (slice(10, 20), slice(100, 200), slice(600, 900)))
    assert low > 3 * middle > 9 * high
    assert before[:, 4].mean() > 10 * before[:, 8:12].mean()  # 50 Hz


def test_several_sensors_and_what_is_attached(few_modes):
    one = Variant(ribs="smeared")
    lump = replace(one, attached=independent_beam.VARIANTS["lump"].attached)
    places = (independent_beam.SENSOR, (0.3, 1.0))
    two = independent_beam.generate(3, 5, one, noise=0.0, sensors=places, beam=few_modes)["acceleration"]
    alone = independent_beam.generate(3, 5, one, noise=0.0, sensors=places[1:], beam=few_modes)["acceleration"]
    np.testing.assert_array_equal(two[:, 1], alone)
    changed = independent_beam.generate(3, 5, lump, noise=0.0, beam=few_modes)["acceleration"]
    assert np.abs(changed - two[:, 0]).max() > 0.02 * np.abs(two[:, 0]).max()
    modes = independent_beam.modes_for(Variant(ribs="smeared"), few_modes)
    bare, losses = independent_beam.poles(modes, one, 3000.0)
    np.testing.assert_allclose(np.sort(bare), modes.frequency, rtol=1e-9)
    np.testing.assert_allclose(losses, 0.02, rtol=1e-6)
    loaded, losses = independent_beam.poles(modes, lump, 3000.0)
    assert len(loaded) == len(bare) + 1 and losses.max() > 0.03
