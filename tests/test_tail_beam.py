"""Modes of the tail beam against closed forms, published plates, quadrature and the infinite plate."""

import csv
import math
from pathlib import Path

import mpmath
import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from threadpoolctl import threadpool_limits

from cgid.errors import BadData, InvalidValue
from cgid.measure.modal import read_modes
from cgid.physics import STEEL, Material, Response, ThinPlate
from cgid.physics.structure.tail_beam import Ribs, TailBeam, modes_of

PLATES = Path(__file__).parent / "references" / "plates.csv"
RIBS = Ribs(number=6, depth=0.18, thickness=0.016)
PAPER = {"length": 0.4584, "width": 0.36, "thickness": 0.008}  # Yang 2018, Table 2
TABLE = "frequency [Hz],damping_ratio [1],modal_mass [kg],shape_impact [1],shape_sensor [1]"


def beam_of(edges="simply-supported", **changes):
    given = {"material": STEEL, "length": 1.6, "width": 1.4, "thickness": 0.025, "damping_ratio": 0.02}
    return TailBeam(**{**given, "edges": edges, **changes})


def rigidity(thickness):
    """Return `E h^3 / (12 (1 - nu^2))` of steel and its mass per area."""
    return 210e9 * thickness**3 / 12 / (1 - 0.3**2), 7850 * thickness


# --- rigidities and impedance ---


def test_without_ribs_the_plate_is_zeners():
    beam = beam_of()
    assert beam.plate == ThinPlate(material=STEEL, thickness=0.025)
    assert beam.impedance == beam.plate.impedance
    assert beam.rigidities.impedance == pytest.approx(beam.impedance, rel=1e-14)
    bending, mass = rigidity(0.025)
    assert beam.rigidities.mixed == pytest.approx(bending, rel=1e-14)
    assert beam.mass == pytest.approx(mass * 1.6 * 1.4, rel=1e-14)
    assert beam.highest_smeared_frequency == math.inf


def test_t_section_bends_about_its_own_neutral_axis():
    """By integrating over the depth, the neutral axis where the stretch vanishes."""
    beam, spacing = beam_of(ribs=RIBS), 1.4 / 6
    with mpmath.workdps(30):
        wide = mpmath.mpf(210e9) / (1 - mpmath.mpf(0.3) ** 2)
        layers = [(wide * spacing, 0, mpmath.mpf(0.025)), (mpmath.mpf(210e9) * 0.016, 0.025, mpmath.mpf(0.205))]
        stretch, first = (
            sum(mpmath.quad(lambda z, s=stiff, n=n: s * z**n, [low, high]) for stiff, low, high in layers)
            for n in (0, 1)
        )
        axis = first / stretch
        bending = sum(mpmath.quad(lambda z, s=s: s * (z - axis) ** 2, [low, high]) for s, low, high in layers)
    assert beam.rigidities.along == pytest.approx(float(bending / spacing), rel=1e-12)
    assert beam.rigidities.across == pytest.approx(rigidity(0.025)[0], rel=1e-14)
    # A thin bar twists by depth thickness^3 / 3 nearly, less .63 of a square at its ends: Timoshenko & Goodier.
    twist = 210e9 / 2.6 * (0.18 * 0.016**3 / 3) * (1 - 0.63 * 0.016 / 0.18) / (2 * spacing)
    assert beam.rigidities.mixed - beam.rigidities.across == pytest.approx(twist, rel=1e-3)
    assert beam.mass == pytest.approx(7850 * 1.6 * (1.4 * 0.025 + 6 * 0.18 * 0.016), rel=1e-14)


@pytest.mark.parametrize("ribs", [RIBS, Ribs(number=3, depth=0.02, thickness=0.1)])
def test_ribbed_impedance_is_the_integral_over_all_directions(ribs):
    beam = beam_of(ribs=ribs)
    r = beam.rigidities

    def slowness(theta):
        c, s = mpmath.cos(theta) ** 2, mpmath.sin(theta) ** 2
        return 1 / mpmath.sqrt(r.mass * (r.along * c**2 + 2 * r.mixed * c * s + r.across * s**2))

    quarter = mpmath.quad(slowness, np.linspace(0, np.pi / 2, 9).tolist())
    assert beam.impedance == pytest.approx(float(16 * mpmath.pi / (4 * quarter)), rel=1e-12)


@pytest.mark.parametrize("ribs", [None, RIBS])
def test_driving_point_mobility_is_on_average_that_of_the_infinite_plate(ribs):
    """Real part of the mobility over 6 kHz and 40 points: (1/Z) within the scatter of so many, 2 %."""
    beam = beam_of(length=6.0, width=5.0, ribs=ribs and Ribs(number=21, depth=0.18, thickness=0.016))
    modes = beam.modes(10000.0)
    generator = np.random.default_rng(3)
    points = generator.uniform(1.0, 5.0, 40), generator.uniform(1.0, 4.0, 40)
    frequency = np.arange(2000.0, 8000.0, 15.0)
    mobility = Response(sampling_rate=1e6, quantity="velocity", modes=modes).frequency_response(
        frequency, (modes.shape(*points) ** 2).mean(axis=0)
    )
    assert mobility.real.mean() * beam.impedance == pytest.approx(1.0, abs=0.02)


# --- simply supported ---


def test_simply_supported_frequencies_to_twelve_digits():
    beam = beam_of(**PAPER)
    modes = beam.modes(12800.0)
    with mpmath.workdps(40):
        length, width, thickness = (mpmath.mpf(PAPER[name]) for name in PAPER)
        bending = mpmath.mpf(210e9) * thickness**3 / (12 * (1 - mpmath.mpf(0.3) ** 2))
        wave = mpmath.pi / 2 * mpmath.sqrt(bending / (7850 * thickness))
        exact = sorted(wave * ((i / length) ** 2 + (j / width) ** 2) for i in range(1, 40) for j in range(1, 40))
        exact = [float(value) for value in exact if value <= 12800]
    np.testing.assert_allclose(modes.frequency, exact, rtol=1e-12)
    assert modes.frequency[0] == pytest.approx(245, abs=1)
    assert np.all(modes.damping_ratio == 0.02)


def test_ribbed_simply_supported_modes_obey_the_plate_equation():
    """`Dx wxxxx + 2 H wxxyy + Dy wyyyy = m omega^2 w`, the derivatives taken from the shapes in 30 digits."""
    beam = beam_of(ribs=RIBS)
    modes, r = beam.modes(1500.0), beam.rigidities
    x, y = 0.71, 0.32
    shape = modes.shape(x, y)
    for mode, (i, j) in enumerate(zip(modes.at_impact.square.along, modes.at_impact.square.across, strict=True)):
        with mpmath.workdps(30):
            w = lambda x, y, i=i, j=j: mpmath.sin(i * mpmath.pi * x / 1.6) * mpmath.sin(j * mpmath.pi * y / 1.4)  # noqa: E731
            left = sum(
                factor * mpmath.diff(w, (x, y), orders)
                for factor, orders in ((r.along, (4, 0)), (2 * r.mixed, (2, 2)), (r.across, (0, 4)))
            )
            expected = float(mpmath.sqrt(left / (r.mass * w(x, y))) / (2 * mpmath.pi))
        assert modes.frequency[mode] == pytest.approx(expected, rel=1e-9)
        assert shape[mode] * math.sqrt(beam.mass / 4) == pytest.approx(float(w(x, y)), abs=1e-14)


# --- clamped and cantilever ---


def plates():
    with PLATES.open(newline="") as file:
        for row in csv.DictReader(file):
            yield row["edges"], float(row["length_over_width"]), [float(row[f"lambda_{k}"]) for k in range(1, 7)]


@pytest.mark.parametrize(("edges", "ratio", "published"), list(plates()))
def test_leissas_plates(edges, ratio, published):
    """His 36 products of beam functions lie above the truth, by .1 % and .9 % at most; we lie below them."""
    bending, mass = rigidity(0.01)
    to_parameter = 2 * np.pi * ratio**2 * math.sqrt(mass / bending)
    beam = beam_of(edges, length=ratio, width=1.0, thickness=0.01)
    found = to_parameter * beam.modes(1.02 * published[-1] / to_parameter).frequency[:6]
    excess = np.array(published) / found - 1
    assert excess.min() > -2e-5  # five printed digits
    assert excess.max() < (0.001 if edges == "clamped" else 0.009)


def test_square_clamped_plate_to_five_digits():
    """35.985, 73.394 (twice) and 108.22, the values Leissa (1973) compares his with."""
    bending, mass = rigidity(0.01)
    found = beam_of("clamped", length=1.0, width=1.0, thickness=0.01).modes(300.0).frequency
    parameters = 2 * np.pi * math.sqrt(mass / bending) * found[:4]
    np.testing.assert_allclose(parameters, [35.985, 73.394, 73.394, 108.22], rtol=4e-5)


def test_no_poisson_ratio_makes_a_strip_of_any_width_a_beam():
    material = Material(density=7850.0, youngs_modulus=210e9, poisson_ratio=0.0)
    beam = beam_of("cantilever", material=material, length=1.0, width=0.6, thickness=0.01)
    expected = 1.8751040687119611**2 * math.sqrt(210e9 * 0.01**2 / 12 / 7850) / (2 * np.pi)
    assert beam.modes(30.0).frequency[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("edges", ["simply-supported", "clamped", "cantilever"])
def test_shapes_are_orthogonal_and_divided_by_the_root_of_the_modal_mass(edges):
    beam = beam_of(edges, ribs=RIBS)
    modes = beam.modes(4000.0)
    nodes, weights = leggauss(60)
    x, y = np.meshgrid(0.8 * (nodes + 1), 0.7 * (nodes + 1), indexing="ij")
    weight = beam.mass / 4 * np.outer(weights, weights)
    shape = modes.shape(x, y)
    product = np.einsum("xy,xym,xyn->mn", weight, shape, shape, optimize=True)
    np.testing.assert_allclose(product, np.eye(len(product)), atol=8e-6)


def test_shapes_keep_to_the_edges():
    along = np.linspace(0, 1.4, 7)
    clamped, cantilever = (beam_of(edges).modes(1500.0) for edges in ("clamped", "cantilever"))
    for place in (0.0, 1.6):
        assert np.abs(clamped.shape(place, along)).max() < 1e-7
        assert np.abs(clamped.shape(abs(place - 1e-4), along)).max() < 1e-5  # no slope either
    assert np.abs(cantilever.shape(0.0, along)).max() < 1e-7
    assert np.abs(cantilever.shape(1.6, along)).max() > 0.05


@pytest.mark.parametrize("edges", ["simply-supported", "clamped", "cantilever"])
@pytest.mark.parametrize("ribs", [None, RIBS])
def test_number_of_modes_follows_the_modal_density(edges, ribs):
    """Far up `4 mass / Z` a hertz; edges add or take a share that falls with the root of frequency."""
    beam = beam_of(edges, ribs=ribs)
    number = beam.modes(6000.0).frequency.size
    perimeter = 0.75 * math.sqrt(beam.modal_density * 6000.0 * np.pi)
    assert number == pytest.approx(beam.modal_density * 6000.0, abs=3 * perimeter)
    if ribs is None:
        bending, mass = rigidity(0.025)
        assert beam.modal_density == pytest.approx(1.6 * 1.4 / 2 * math.sqrt(mass / bending), rel=1e-12)


def test_bits_do_not_depend_on_threads_or_company():
    beam = beam_of("cantilever", ribs=RIBS)
    modes = beam.modes(4000.0)
    assert beam_of("cantilever", ribs=RIBS).modes(4000.0) is modes
    modes_of.cache_clear()
    with threadpool_limits(2):
        again = beam.modes(4000.0)
    points = np.linspace(0, 1.6, 50), np.linspace(1.4, 0, 50)
    shape = modes.shape(*points)
    np.testing.assert_array_equal(again.frequency, modes.frequency)
    np.testing.assert_array_equal(again.shape(*points), shape)
    np.testing.assert_array_equal(modes.shape(points[0][7], points[1][7]), shape[7])


# --- echo and response ---


def test_an_echo_takes_the_way_there_and_back_at_the_group_velocity():
    """Of a wave along x or y, from its dispersion relation by differences."""
    beam, frequency = beam_of("cantilever", ribs=RIBS), 900.0
    omega = 2 * np.pi * frequency
    for rigidity_, distance, point in (
        (beam.rigidities.along, 0.1, (0.1, 0.7)),
        (beam.rigidities.across, 0.05, (0.8, 1.35)),
    ):
        k = (omega**2 * beam.mass_per_area / rigidity_) ** 0.25
        omegas = [math.sqrt(rigidity_ / beam.mass_per_area) * (k * (1 + step)) ** 2 for step in (-1e-5, 1e-5)]
        velocity = (omegas[1] - omegas[0]) / (2e-5 * k)
        along, across, only = np.array([point[0] / beam.length, point[1] / beam.width, frequency])[:, None]
        assert beam.echoes(along, across, only) == pytest.approx(2 * distance / velocity, rel=1e-9)
    wavelength = 2 * np.pi / (2 * np.pi * beam.highest_smeared_frequency) ** 0.5
    wavelength *= (beam.rigidities.across / beam.mass_per_area) ** 0.25
    assert wavelength == pytest.approx(2 * beam.rib_spacing, rel=1e-12)


def test_static_deflection_is_that_of_the_loaded_plate():
    """A simply supported square plate under a central force yields .01160 P a^2 / D: Timoshenko, table 23."""
    beam = beam_of(length=1.0, width=1.0, thickness=0.01)
    modes = beam.modes(100000.0)
    centre = (0.5, 0.5)
    response = Response(sampling_rate=1e6, quantity="displacement", modes=modes)
    yielding = response.frequency_response([0.0], modes.shape(*centre) ** 2)
    assert yielding[0].real == pytest.approx(0.01160 / rigidity(0.01)[0], rel=1e-3)


# --- measured modes and bad input ---


def test_a_table_of_measured_modes_in_any_order_of_columns(tmp_path):
    file = tmp_path / "tap.csv"
    titles = "remark,shape_sensor [1],frequency [Hz],damping_ratio [1],modal_mass [kg],shape_impact [1]"
    file.write_text(f"# tap test\n{titles}\nfirst,.5,100,.01,200,1\n\n,-2,150,.02,100,.25\n", encoding="utf-8-sig")
    modes = read_modes(file)
    np.testing.assert_array_equal(modes.frequency, [100, 150])
    np.testing.assert_allclose(modes.participation(), [0.0025, -0.005], rtol=1e-15)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("", "a line a mode, got 1"),
        ("100,.01,200,1\n", "line 2: shape_sensor must be a number, got ''"),
        ("100,.01,200,1,1\n90,.01,200,1,1\n", "line 3: frequency must ascend .* got 90 Hz after 100 Hz"),
        ("100,.01,200,1,1\n120,1,200,1,1\n", "line 3: damping_ratio must"),
        ("inf,.01,200,1,1\n", "line 2: frequency must be finite"),
    ],
)
def test_bad_tables_name_the_line(tmp_path, rows, message):
    file = tmp_path / "tap.csv"
    file.write_text(f"{TABLE}\n{rows}")
    with pytest.raises(BadData, match=message):
        read_modes(file)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"damping_ratio": 0.0}, "damping_ratio must .*got 0"),
        ({"length": 0.0}, "length must be above 0"),
        ({"edges": "glued"}, "edges must be one of 'simply-supported'"),
        ({"material": Material(density=[1.0, 2.0], youngs_modulus=1e9, poisson_ratio=0.3)}, "density of the beam"),
        ({"ribs": Ribs(number=100, depth=0.1, thickness=0.02)}, "ribs must fit side by side"),
    ],
)
def test_bad_beams(changes, message):
    with pytest.raises(InvalidValue, match=message):
        beam_of(**changes)


def test_points_off_the_beam_and_absurd_bands():
    beam = beam_of(ribs=RIBS)
    modes = beam.modes(1000.0)
    with pytest.raises(InvalidValue, match=r"x must be on the beam, from 0 to 1.6 m, got 1.7 m at index 1"):
        modes.shape([0.1, 1.7], 0.2)
    with pytest.raises(InvalidValue, match=r"y must be on the beam, from 0 to 1.4 m, got -0.1 m"):
        modes.measured_at(0.2, -0.1)
    for edges, number in (("simply-supported", "20000 modes.* means about 131739;"), ("clamped", "1000 modes")):
        with pytest.raises(InvalidValue, match=number):
            beam_of(edges, ribs=RIBS).modes(1e7)
