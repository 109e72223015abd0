"""Channels that no sensor gives, beside a sound one: no command ends, its rows stay, and the work is bounded."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cgid.cli.main import run
from cgid.identification.inversion.inversion import Inversion
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import PredictionSettings
from cgid.identification.prediction.stream import identify_blocks
from cgid.measure.fit.ar_noise import MIN_SAMPLES, ORDER, ar_noise_of
from cgid.scene import load_scene, synthesise
from tests.streams_of_pulses import RATE, ROOT, stream

N = 51_200


def square(period: int) -> Callable[[NDArray], NDArray]:
    return lambda t: np.where(t % period < period // 2, 32767.0, -32768.0)


def random(make: Callable[[np.random.Generator, int], NDArray]) -> Callable[[NDArray], NDArray]:
    return lambda t: make(np.random.default_rng(1), t.size)


#: Name -> samples at their numbers.
CHANNELS: dict[str, Callable[[NDArray], NDArray]] = {
    "zeros": lambda t: 0.0 * t,
    "stuck": lambda t: 0.0 * t + 500.0,
    "ramp": lambda t: 1.0 * t,
    "counter of 8 bits": lambda t: t % 256.0,
    "counter of 16 bits": lambda t: t % 65536.0 - 32768,
    "slow counter": lambda t: t // 100 % 256.0,
    "sawtooth": lambda t: t % 100 / 100,
    "triangle": lambda t: np.abs(t % 200.0 - 100),
    "parabolas": lambda t: (t % 500.0 - 250) ** 2,
    "alternating": lambda t: 1.0 - 2 * (t % 2),
    "square of 10 Hz": square(2560),
    "square of 50 Hz": square(512),
    "square of 7 Hz": square(3657),
    "random square": random(lambda r, n: np.repeat(r.integers(0, 2, n // 100 + 1), 100)[:n] * 1.0),
    "bits": random(lambda r, n: r.integers(0, 2, n) * 1.0),
    "noise of 1e300": random(lambda r, n: r.normal(0, 1e300, n)),
    "noise of 1e-300": random(lambda r, n: r.normal(0, 1e-300, n)),
    "largest numbers": lambda t: np.where(t % 2560 < 1280, 1.7e308, -1.7e308),
    "smallest numbers": lambda t: np.where(t % 2560 < 1280, 5e-324, 0.0),
    "spike": lambda t: np.where(t == t.size // 2, 1e4, 0.0),
    "spikes": lambda t: np.where(t % 1000 == 500, 1e4, 0.0),
    "step": lambda t: np.where(t > t.size // 2, 1.0, 0.0),
    "growth": lambda t: np.exp(t / t.size * 600 - 300),
    "decays": lambda t: np.exp(-(t % 2000) / 100),
    "sine": lambda t: np.sin(0.1 * t),
    "chirp": lambda t: np.sin(1e-6 * t.astype(float) ** 2),
    "every third sample nan": lambda t: np.where(t % 3 == 0, np.nan, np.sin(t)),
    "gaps": lambda t: np.where(t % 1000 < 100, np.nan, 5.0),
    "nan": lambda t: np.where(t >= 0, np.nan, 0.0),
    "infinite": lambda t: np.where(t % 2 == 0, np.inf, -np.inf),
}


@pytest.fixture(scope="module")
def acceleration() -> NDArray:
    """Seven impacts on the beam of the default model, in noise."""
    (batch,) = synthesise(load_scene("tail_beam"), 7, seed=3)
    samples = np.random.default_rng(0).normal(0, 0.003 * np.abs(batch.signals).max(), N)
    for number, impact in enumerate(batch.signals):
        samples[5000 + 6000 * number :][: impact.size] += impact
    return samples


def rows_of_first(text: str) -> list[dict[str, str]]:
    rows = [row for row in csv.DictReader(io.StringIO(text)) if row["channel"] == "1"]
    return [{name: cell for name, cell in row.items() if name in row and name != "source"} for row in rows]


@pytest.mark.long
@pytest.mark.parametrize(("unit", "rate"), [("m/s^2", 25_600.0), ("N", RATE)])
def test_no_channel_ends_a_command(
    unit: str, rate: float, acceleration: NDArray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """All of them beside the sound channel, and each alone."""
    monkeypatch.chdir(tmp_path)
    sound = acceleration if unit == "m/s^2" else stream(["coal", "gangue"] * 6, 0.02)
    times = np.arange(sound.size)
    with np.errstate(all="ignore"):
        others = [make(times) for make in CHANNELS.values()]
    commands = {
        "predict": ["{}.npy"],
        "features": ["{}.npy"],
        "events": ["{}.npy", "-o", "-"],
        "info": ["{}.npy"],
        "monitor": ["{}.f64", "--sample-format", "f64le"],
    }

    def printed(name: str, channels: list[NDArray], command: str) -> tuple[int, str, str]:
        together = np.stack(channels, axis=1)
        np.save(f"{name}.npy", together)
        together.astype("<f8").tofile(f"{name}.f64")
        files = [argument.format(name) for argument in commands[command]]
        of_stream = ["--channels", str(len(channels))] if command == "monitor" else []
        code = run([command, *files, *of_stream, "--rate", str(rate), "--unit", unit])
        return code, *capsys.readouterr()

    for command in commands:
        code, alone, err = printed("alone", [sound], command)
        assert code == 0, err
        code, beside, err = printed("all", [sound, *others], command)
        assert code == 0, err
        assert "encountered" not in err and "Traceback" not in err
        if command in ("predict", "features", "monitor"):
            expected, got = rows_of_first(alone), rows_of_first(beside)
            assert len(got) == len(expected) > 6
            assert [{name: row[name] for name in want} for row, want in zip(got, expected, strict=True)] == expected
        if command == "predict":
            continue  # as monitor
        for name, channel in zip(CHANNELS, others, strict=True):
            code, _, err = printed("one", [channel], command)
            assert code in (0, 65), (name, err)
            assert "encountered" not in err and "internal" not in err, (name, err)


@pytest.fixture(scope="module")
def default_model() -> StoredModel:
    return StoredModel.load(ROOT / "models" / "default-acceleration.npz")


@pytest.mark.parametrize(
    "name", [name for name in CHANNELS if not name.startswith(("noise of 1e300", "largest", "inf"))]
)
def test_no_channel_costs_more_than_others(
    name: str, default_model: StoredModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Impacts are at least 4 ms apart, and the decomposition for clipped samples is that of 0.3 of a frame."""
    sizes: list[int] = []
    directions = Inversion._directions

    def counted(self: Inversion, clipped: NDArray, weight: NDArray) -> NDArray:
        sizes.extend((clipped.sum(axis=(1, 2)) / self.n_samples).tolist())
        return directions(self, clipped, weight)

    monkeypatch.setattr(Inversion, "_directions", counted)
    with np.errstate(all="ignore"):
        samples = CHANNELS[name](np.arange(N))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        blocks = (samples[None, first : first + 8192] for first in range(0, N, 8192))
        steps = list(identify_blocks(blocks, 25_600.0, default_model, ["1"], PredictionSettings()))
    answers = [answer for step in steps for answer in step.answers]
    assert len(answers) <= N / 25_600 / 4e-3
    assert max(sizes, default=0) <= 0.3
    if "square" in name:
        assert answers and sum(answer.label != "unknown" for answer in answers) <= len(answers) / 20


def test_a_square_wave_is_no_clipped_vibration(default_model: StoredModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would take a decomposition of all samples of each frame: 29 s of processor for 3 s of stream."""
    monkeypatch.setattr(Inversion, "_directions", lambda *_: pytest.fail("decomposed"))
    samples = CHANNELS["square of 10 Hz"](np.arange(N))
    assert any(step.answers for step in identify_blocks(
        [samples[None]], 25_600.0, default_model, ["1"], PredictionSettings())
    )  # fmt: skip


periodic = st.lists(st.integers(-3, 3), min_size=1, max_size=12)


@given(periodic, periodic, st.sampled_from([1e-160, 1e-30, 1.0, 1e30, 1e140]), st.integers(MIN_SAMPLES, 300))
@settings(deadline=None, max_examples=200)
def test_noise_that_follows_from_its_past_has_a_model(cycle: list[int], steps: list[int], unit: float, n: int) -> None:
    """Any period and any sum of one, as of a counter: finite, and what it leaves is neither nothing nor more."""
    t = np.arange(n)
    samples = unit * np.stack(
        [np.array(cycle)[t % len(cycle)] * 1.0, np.cumsum(np.array(steps)[t % len(steps)]) * 1.0, t % 256 * 1.0]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        noise = ar_noise_of(samples, np.full(3, float(n)), np.zeros(3))
    assert np.isfinite(noise.coefficients).all() and noise.coefficients.shape == (3, ORDER)
    spread = np.sqrt(np.square(samples - samples.mean(axis=1, keepdims=True)).mean(axis=1))
    assert (noise.innovation > 0).all()
    assert (noise.innovation <= 2 * spread + 1e-140).all()
