"""White noise by address: its numbers, its statistics, and that they do not depend on what is asked for."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from cgid.errors import InvalidValue
from cgid.scene._noise import LANES, TILE, random_words, to_normal
from cgid.scene.draws import BLOCK, NOISE, TAPS
from cgid.scene.noise import MOST_SAMPLES, add_noise

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
    """Box and Muller's transform in double precision."""
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


def test_a_block_is_the_same_with_fewer_rows():
    np.testing.assert_array_equal(noise(WHOLE.shape[1], 1), WHOLE[:1])


def test_a_long_recording_in_pieces_by_threads():
    whole, pieces = noise(100_000, block=9), np.zeros((1, 100_000), np.float32)
    starts = list(range(0, 100_000, 7001))

    def piece(first):
        add_noise(pieces[:, first : first + 7001], np.ones(1), 1, 9, first_sample=first)

    with ThreadPoolExecutor(3) as threads:
        list(threads.map(piece, reversed(starts)))
    np.testing.assert_array_equal(pieces, whole)


def test_double_precision_holds_the_same_numbers():
    np.testing.assert_array_equal(noise(1000, 2, dtype="float64"), noise(1000, 2).astype(np.float64))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_noise_is_added_at_the_level_of_each_row(dtype):
    level = np.array([0.0, 0.1, 1e6])
    signal = np.arange(3 * 600, dtype=dtype).reshape(3, 600)
    noisy = signal.copy()
    add_noise(noisy, level, 1, 0)
    expected = signal + level.astype(dtype)[:, None] * noise(600, 3, dtype=dtype)
    np.testing.assert_array_equal(noisy, expected)


def test_frames_need_not_lie_side_by_side():
    wide = np.zeros((2, 900), np.float32)
    add_noise(wide[:, ::2], np.ones(2), 1, 0, first_sample=50)
    np.testing.assert_array_equal(wide[:, ::2], WHOLE[:, 50:500])
    assert not wide[:, 1::2].any()


def test_the_last_sample_that_has_an_address():
    assert noise(1, first_sample=MOST_SAMPLES - 1)[0, 0] != 0


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


# ---- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"seed": -1}, "seed must lie between 0 and 2^63 - 1, got -1"),
        ({"seed": 2**63}, "seed must lie"),
        ({"block": -1}, "block must lie between 0 and 2^56 - 1, got -1"),
        ({"block": 2**56}, "block must lie"),
        ({"first_sample": -1}, "got -1 to 8"),
        ({"first_sample": MOST_SAMPLES - 9}, f"must lie between 0 and {MOST_SAMPLES - 1}"),
    ],
)
def test_out_of_range(options, says):
    with pytest.raises(InvalidValue) as caught:
        noise(10, **options)
    assert says in str(caught.value)
