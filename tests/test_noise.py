"""Noise by address: its numbers, its statistics, and that they do not depend on what is asked for.

White noise, and noise of a sensor coloured by an exponent or a spectrum.
"""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal, stats

from cgid.errors import InvalidValue
from cgid.scene import Scene, load_scene, parse_scene, record, synthesise
from cgid.scene.file.sensor import CHUNK
from cgid.scene.synthesis._noise import LANES, TILE, random_words, to_normal
from cgid.scene.synthesis.draws import BLOCK, NOISE, TAPS
from cgid.scene.synthesis.noise import MAX_SAMPLES, add_noise
from tests.plan_scenes import scene_of
from tests.test_stream import RATE as STREAM_RATE
from tests.test_stream import content as stream_content

#: Numbers of the statistical tests; what their mean is off by is about 1 / sqrt(MANY).
MANY = 1 << 23


def noise(n_samples, rows=1, seed=1, block=0, dtype="float32", **options):
    frames = np.zeros((rows, n_samples), dtype)
    add_noise(frames, np.ones(rows), seed, block, **options)
    return frames


# ---- the numbers -----------------------------------------------------------------------------------------------------


def philox(counter, key):
    """Philox4x32-10 word by word, as in Salmon et al. (2011)."""
    (a, b, c, d), (k, m) = counter, key
    for _ in range(10):
        p, q = 0xD2511F53 * a, 0xCD9E8D57 * c
        a, b, c, d = (q >> 32) ^ b ^ k, q % 2**32, (p >> 32) ^ d ^ m, p % 2**32
        k, m = (k + 0x9E3779B9) % 2**32, (m + 0xBB67AE85) % 2**32
    return [a, b, c, d]


# The published answers: kat_vectors of Random123.
KNOWN = [
    ([0] * 4, [0] * 2, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
    ([0xFFFFFFFF] * 4, [0xFFFFFFFF] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
        [0xA4093822, 0x299F31D0],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ),
]


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN)
def test_random_words_are_the_published_ones(counter, key, answer):
    words = np.zeros((4, LANES), np.uint32)
    random_words(counter[0], *(np.uint64(word) for word in (*counter[1:], *key)), words)
    assert words[:, 0].tolist() == answer == philox(counter, key)
    if counter[0] < 0xFFFFFFFF:
        last = [counter[0] + LANES - 1, *counter[1:]]
        assert words[:, -1].tolist() == philox(last, key)


def normal(word, angle):
    radius = math.sqrt(-2 * math.log((word + 0.5) / 2**32)) * (-1) ** (angle % 2)
    turn = math.pi * ((angle + 2**31) % 2**32 - 2**31) / 2**32
    return radius * math.cos(turn), radius * math.sin(turn)


def test_normal_numbers_are_box_and_mullers():
    corners = [0, 1, 2, 2**23, 2**31 - 1, 2**31, 3037000500, 2**32 - 2**20, 2**32 - 2, 2**32 - 1]
    rng = np.random.default_rng(3)
    words, angles = rng.integers(0, 2**32, (2, 40, LANES), np.uint32)
    words[0, : len(corners)] = angles[1, : len(corners)] = corners
    out, scratch = np.empty((2, LANES), np.float32), np.empty((2, LANES), np.float32)
    for some, turns in zip(words, angles, strict=True):
        to_normal(some, turns, scratch, out)
        expected = np.array([normal(int(w), int(a)) for w, a in zip(some, turns, strict=True)]).T
        # Rounding a word to 24 bits moves small radii most, by 2^-25 / radius.
        radius = np.hypot(*expected)
        assert (np.abs(out - expected) <= 5e-7 * radius + 2.0**-25 / np.maximum(radius, 2.0**-12.5)).all()


@pytest.mark.parametrize(
    ("seed", "block", "purpose"), [(0, 0, NOISE), (2**63 - 1, 2**56 - 1, 255), (5, 2**32 + 7, TAPS)]
)
def test_every_sample_has_the_number_of_its_address(seed, block, purpose):
    found = noise(2 * TILE, 3, seed, block, purpose=purpose)
    for row, sample in [(0, 0), (1, 1), (2, LANES), (2, 2 * LANES + 5), (1, TILE + 3 * LANES), (2, 2 * TILE - 1)]:
        tile, rest = divmod(sample, TILE)
        part, lane = divmod(rest, LANES)
        counter = [tile * LANES + lane, row, block % 2**32, purpose * 2**24 + block // 2**32]
        words = philox(counter, [seed % 2**32, seed // 2**32])
        pair = words[:2] if part < 2 else words[2:]
        assert found[row, sample] == pytest.approx(normal(*pair)[part % 2], abs=3e-6)


# ---- the same whatever is asked for ----------------------------------------------------------------------------------

WHOLE = noise(4 * TILE + 100, 2)


@given(first=st.integers(0, WHOLE.shape[1] - 1), length=st.integers(1, WHOLE.shape[1]))
def test_a_window_has_the_noise_of_the_whole(first, length):
    length = min(length, WHOLE.shape[1] - first)
    np.testing.assert_array_equal(noise(length, 2, first_sample=first), WHOLE[:, first : first + length])


def test_a_long_recording_in_pieces_by_threads():
    whole, pieces = noise(100_000, block=9), np.zeros((1, 100_000), np.float32)
    starts = list(range(0, 100_000, 7001))

    def piece(first):
        add_noise(pieces[:, first : first + 7001], np.ones(1), 1, 9, first_sample=first)

    with ThreadPoolExecutor(3) as threads:
        list(threads.map(piece, reversed(starts)))
    np.testing.assert_array_equal(pieces, whole)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_noise_is_added_at_the_level_of_each_row(dtype):
    level = np.array([0.0, 0.1, 1e6])
    signal = np.arange(3 * 600, dtype=dtype).reshape(3, 600)
    noisy = signal.copy()
    add_noise(noisy, level, 1, 0)
    expected = signal + level.astype(dtype)[:, None] * noise(600, 3, dtype=dtype)
    np.testing.assert_array_equal(noisy, expected)


# ---- statistics ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many():
    return noise(MANY // BLOCK, BLOCK, seed=7)


def test_moments(many):
    # Deviations of the mean of x^k of n normal numbers: sqrt((E x^2k - (E x^k)^2) / n).
    product = np.ones(many.shape)
    for power, (moment, square) in enumerate([(0, 1), (1, 3), (0, 15), (3, 105), (0, 945), (15, 10395)], 1):
        product *= many
        assert product.mean() == pytest.approx(moment, abs=4.5 * math.sqrt((square - moment**2) / MANY)), power


def test_distribution(many):
    edges = stats.norm.ppf(np.linspace(0, 1, 1001))
    counts = np.histogram(many, np.clip(edges, -10, 10))[0]
    assert stats.chisquare(counts).pvalue > 1e-4


@pytest.mark.parametrize("sigma", [3, 4, 4.5, 5])
@pytest.mark.parametrize("sign", [-1, 1])
def test_tails(many, sigma, sign):
    expected = MANY * stats.norm.sf(sigma)
    found = np.count_nonzero(sign * many > sigma)
    assert 1e-5 < stats.poisson.cdf(found, expected) < 1 - 1e-5


@pytest.fixture(scope="module", params=[1, 2, 3])
def terms(many, request):
    """Powers of the numbers with a mean of 0, and their variance."""
    return {1: (many, 1), 2: (many**2 - 1, 2), 3: (many * many * many, 15)}[request.param]


@pytest.mark.parametrize("lag", [1, 2, LANES - 1, LANES, LANES + 1, 2 * LANES, 3 * LANES, TILE, TILE + LANES, 2 * TILE])
def test_samples_do_not_know_of_each_other(terms, lag):
    # Numbers of one pair, one counter, one tile and neighbouring tiles. A product deviates by its factors' variance.
    powers, variance = terms
    products = np.einsum("ij,ij->i", powers[:, lag:], powers[:, :-lag]).sum(dtype=np.float64)
    assert abs(products) < 4.5 * variance * math.sqrt(powers[:, lag:].size)


def test_rows_do_not_know_of_each_other(many):
    correlation = np.corrcoef(many)[np.triu_indices(BLOCK, 1)] * math.sqrt(many.shape[1])
    assert np.abs(correlation).max() < 6
    assert correlation.std() == pytest.approx(1, abs=5 / math.sqrt(2 * correlation.size))


def test_addresses_do_not_know_of_each_other():
    seeds = [0, 1, 2, 3, 2**31, 2**32, 2**32 + 1, 2**62, 2**63 - 1]
    addresses = [(seed, block, purpose) for seed in seeds for block in (0, 1, 2, 2**32) for purpose in (NOISE, TAPS)]
    found = np.concatenate([noise(4096, 1, seed, block, purpose=purpose) for seed, block, purpose in addresses])
    correlation = np.corrcoef(found)[np.triu_indices(len(found), 1)] * math.sqrt(4096)
    assert np.abs(correlation).max() < 6
    assert correlation.std() == pytest.approx(1, abs=5 / math.sqrt(2 * correlation.size))


def test_spectrum_is_flat(many):
    power = np.mean(np.abs(np.fft.rfft(many.reshape(-1, 512))[:, 1:-1]) ** 2, axis=0) / 512
    # Each is the mean of n exponential numbers.
    assert np.abs(power - 1).max() < 5 / math.sqrt(MANY / 512)


# ---- the colour of a sensor's noise ----------------------------------------------------------------------------------

RATE, SAMPLES = 200e3, 2048
#: Falls and rises; from below one period of the frame to half its sampling rate.
SPECTRUM = {"frequencies": [40, 2e3, 20e3, 100e3], "density": ["3 kN/sqrt(Hz)", 3000, 100, 400]}


def noise_scene(**sensor) -> Scene:
    faint = {"label": "tap", "shape": "half-sine", "peak_force": 1e-6, "contact_duration": "0.1 ms"}
    return scene_of(populations=[], taps=[faint], sensor={"absolute_noise": 2.0, **sensor})


def noise_frames(scene, n_signals=2048, seed=0, **options):
    return np.concatenate([batch.signals for batch in synthesise(scene, n_signals, seed, **options)])


def welch(frames, rate=RATE, length=SAMPLES):
    frequency, density = signal.welch(frames, rate, "hann", length, detrend=False)
    return frequency, density.mean(axis=0) if density.ndim > 1 else density


@pytest.mark.parametrize("exponent", [-1.0, -0.5, 0.5, 1.0, 1.5, 2.0])
def test_noise_has_the_slope_and_the_level_of_its_exponent(exponent):
    frames = noise_frames(noise_scene(noise_exponent=exponent), dtype="float64")
    assert np.sqrt(np.mean(frames**2)) == pytest.approx(2.0, rel=0.01)
    frequency, density = welch(frames)
    inside = (frequency > 8 * RATE / SAMPLES) & (frequency < 0.9 * RATE / 2)
    places = np.log(frequency[inside])
    slope = np.polyfit(places, np.log(density[inside]), 1)[0]
    assert slope == pytest.approx(-exponent, abs=0.01)
    # By octaves: no step anywhere.
    line = np.polyval(np.polyfit(places, np.log(density[inside]), 1), places)
    octave = ((places - places[0]) / np.log(2)).astype(int)
    assert max(abs(np.mean((np.log(density[inside]) - line)[octave == k])) for k in range(octave[-1])) < 0.03


@pytest.mark.parametrize("samples", [1000, 2048])
def test_noise_is_flat_below_one_period_of_the_frame(samples):
    sampling = {"sampling_rate": RATE, "samples": samples, "pre_trigger": 128}
    scene = noise_scene(noise_exponent=1.0)
    frames = noise_frames(parse_scene({**scene.model_dump(exclude_none=True), "sampling": sampling}), 4096)
    # The mean of a frame is what lies below its period. In theory, by fine lines of the density:
    lines = (np.arange(2**20) + 0.5) / 2**20 * RATE / 2
    density = 1 / np.maximum(lines, RATE / samples)
    density *= 4.0 / density.sum()
    theory = np.sum(density * np.sinc(lines * samples / RATE) ** 2)
    assert np.var(frames.mean(axis=1)) == pytest.approx(theory, rel=0.1)
    # The ends of a frame are no neighbours.
    assert abs(np.mean(frames[:, 0] * frames[:, -1])) < 0.25 * np.mean(frames[:, 0] * frames[:, 1])


def test_noise_has_the_shape_of_its_spectrum_and_the_stated_level():
    frames = noise_frames(noise_scene(noise_spectrum=SPECTRUM))
    assert np.sqrt(np.mean(frames**2)) == pytest.approx(2.0, rel=0.01)
    frequency, density = welch(frames)
    shape = np.exp(
        2 * np.interp(np.log(np.maximum(frequency, 1)), np.log(SPECTRUM["frequencies"]), np.log([3e3, 3e3, 100, 400]))
    )
    inside = (frequency > 4 * RATE / SAMPLES) & (frequency < 0.95 * RATE / 2)
    ratio = (density / shape)[inside]
    assert np.abs(ratio / np.median(ratio) - 1).max() < 0.1
    twice = {**SPECTRUM, "density": [6000, 6000, 200, 800]}  # the shape alone counts
    np.testing.assert_allclose(noise_frames(noise_scene(noise_spectrum=twice), 300), frames[:300], atol=1e-6)


def test_coloured_noise_is_relative_to_each_peak():
    scene = scene_of(sensor={"relative_noise": 0.05, "noise_exponent": 1.0})
    silent = scene_of(sensor={})
    noise = noise_frames(scene, 1024, dtype="float64") - noise_frames(silent, 1024, dtype="float64")
    peak = np.concatenate([batch.parameters["peak_force"] for batch in synthesise(silent, 1024)])
    standard = noise / peak[:, None]
    assert np.sqrt(np.mean(standard**2)) == pytest.approx(0.05, rel=0.01)
    of_each = np.sqrt(np.mean(standard**2, axis=1))
    assert abs(np.corrcoef(of_each, np.log(peak))[0, 1]) < 0.1
    assert stats.kurtosis(standard[:, ::64].ravel()) == pytest.approx(0, abs=0.1)


def test_coloured_noise_does_not_depend_on_how_signals_are_split():
    scene = scene_of(sensor={"relative_noise": 0.05, "noise_exponent": 1.3})
    whole = noise_frames(scene, 700, 3)
    np.testing.assert_array_equal(noise_frames(scene, 300, 3, first=200), whole[200:500])
    np.testing.assert_array_equal(noise_frames(scene, 1, 3, first=699), whole[699:])


def test_coloured_noise_of_blocks_and_seeds_is_independent():
    scene = noise_scene(noise_exponent=1.0)
    frames = np.concatenate([noise_frames(scene, 512, seed) for seed in (0, 1)])
    # Rows of the same place in a block of another number, seed; neighbours; white and coloured noise of one address.
    groups = frames.reshape(4, 256, SAMPLES)
    white = noise_frames(noise_scene(), 256)
    lines = 20  # (sum p)^2 / sum p^2 of the powers p of pink noise: independent numbers in a row
    pairs = [(groups[0], groups[1]), (groups[0], groups[2]), (groups[1], groups[3]), (groups[0], white)]
    pairs.append((frames[:-1], frames[1:]))
    for one, other in pairs:
        found = np.mean(one * other) / np.sqrt(np.mean(one**2) * np.mean(other**2))
        assert abs(found) < 5 / np.sqrt(len(one) * lines)


def quiet_stream(**sensor):
    silent = {"arrivals": {"times": ["39 s"]}, "duration": "40 s"}
    return parse_scene(stream_content(sensor={"absolute_noise": 3.0, **sensor}, **silent))


@pytest.mark.parametrize("sensor", [{"noise_exponent": 1.5}, {"noise_exponent": -1.0}])
def test_coloured_noise_of_a_recording_has_no_seams(sensor):
    samples = record(quiet_stream(**sensor), dtype="float64")[0].samples[: int(38 * STREAM_RATE)]
    assert np.std(samples) == pytest.approx(3.0, rel=0.03)
    frequency, density = welch(samples, STREAM_RATE, 4096)
    inside = (frequency > 8 * STREAM_RATE / 4096) & (frequency < 0.4 * STREAM_RATE)
    slope = np.polyfit(np.log(frequency[inside]), np.log(density[inside]), 1)[0]
    assert slope == pytest.approx(-sensor["noise_exponent"], abs=0.03)
    # A seam would be a step between two neighbours at the borders of the chunks.
    steps = np.diff(samples)
    borders = steps[np.arange(1, samples.size // CHUNK + 1) * CHUNK - 1]
    assert np.abs(borders).max() < 4 * np.std(steps)
    # In the middle of a chunk, two segments share the power.
    quarters = samples[: samples.size // CHUNK * CHUNK].reshape(-1, 16, CHUNK // 16)
    rough = np.diff(quarters).std(axis=(0, 2))
    assert rough == pytest.approx(np.full(16, rough.mean()), rel=0.05)


def test_a_spectrum_from_a_file_is_the_same_scene(tmp_path):
    rows = zip(SPECTRUM["frequencies"], (3000, 3000, 100, 400), strict=True)
    table = "# of the empty rig\ndensity [V/sqrt(Hz)], frequency [Hz]\n" + "".join(f"{d},{f}\n" for f, d in rows)
    (tmp_path / "hiss.csv").write_text(table)
    text = (
        'name = "hiss"\n[impact]\nstiffness = "hertz"\ndissipation = "elastic"\ntarget = "rigid"\n'
        '[sampling]\nsampling_rate = "200 kHz"\nsamples = 4096\npre_trigger = 16\n'
        '[sensor]\nrelative_noise = 0.1\nnoise_spectrum = "hiss.csv"\n'
        '[[taps]]\nlabel = "tap"\nshape = "square"\npeak_force = 1\ncontact_duration = "1 ms"\n'
    )
    (tmp_path / "hiss.toml").write_text(text)
    from_file = load_scene(tmp_path / "hiss.toml")
    assert from_file.sensor.noise_spectrum.frequencies == (40, 2e3, 20e3, 100e3)
    inline = "{ frequencies = [40, 2e3, 20e3, 100e3], density = [3e3, 3e3, 100.0, 400.0] }"
    (tmp_path / "inline.toml").write_text(text.replace('"hiss.csv"', inline))
    assert load_scene(tmp_path / "inline.toml").sha256 == from_file.sha256
    (tmp_path / "hiss.csv").unlink()  # the scene holds its numbers
    assert noise_frames(from_file, 2).std() > 0


@pytest.mark.parametrize("first", [-1, MAX_SAMPLES])
def test_samples_without_an_address_are_refused(first):
    with pytest.raises(InvalidValue, match="samples with noise"):
        add_noise(np.zeros((1, 1)), np.ones(1), 1, 0, first_sample=first)
