"""`cgid.predict`, `load_model` and `load_scene` by name, against the command line and the detector."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import cgid
from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue, MissingOption

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "datasets" / "sample.csv"


def sample() -> np.ndarray:
    return np.loadtxt(SAMPLE, skiprows=2)


def test_the_table_agrees_with_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["predict", str(SAMPLE), "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    rows = [line for line in lines if line["kind"] == "impact"]
    table = cgid.predict(sample(), 200e3, "N")
    assert list(table) == [
        *("channel", "time_s", "label", "p_coal", "p_gangue", "novelty"),
        *("overlapping", "clipped", "cut_off", "problem"),
    ]
    assert table["label"].tolist() == [row["label"] for row in rows]
    for label in ("coal", "gangue"):
        assert table[f"p_{label}"].tolist() == pytest.approx([row["probabilities"][label] for row in rows], abs=1e-12)
    assert table["time_s"].tolist() == pytest.approx([row["time_s"] for row in rows])
    assert table["overlapping"].dtype == bool


def test_channels_are_columns_and_units_do_not_matter() -> None:
    one = cgid.predict(sample(), 200e3, "N")
    both = pd.DataFrame({"left": sample() / 1e3, "right": -sample() / 1e3})
    with pytest.warns(UserWarning, match="samples channel right: "):
        named = cgid.predict(both, 200e3, "kN", model="default")
    assert set(named["channel"]) == {"left"}
    np.testing.assert_allclose(named["p_coal"], one["p_coal"], rtol=1e-9)
    two = cgid.predict(np.stack([sample(), sample()], axis=1), 200e3, "N")
    assert two["channel"].value_counts().to_dict() == {"1": 6, "2": 6}
    with pytest.warns(UserWarning, match="samples channel left"):
        assert cgid.predict(both, 200e3, "kN", invert=True)["channel"].unique().tolist() == ["right"]


def test_volts_become_what_the_sensor_measured() -> None:
    """A hammer of 2 mV/N behind an amplifier of 10, and a recorder of 16 bit and 400 V."""
    force = cgid.predict(sample(), 200e3, "N")["p_coal"]
    volts = sample() * 2e-3 * 10
    stated = {"sensitivity": "2 mV/N", "gain": "20 dB"}
    np.testing.assert_allclose(cgid.predict(volts, 200e3, "V", **stated)["p_coal"], force, rtol=1e-9)
    both = pd.DataFrame({"left": volts, "right": volts / 10})
    named = cgid.predict(both, 200e3, "V", sensitivity="2 mV/N", gain={"left": 10})
    assert named["p_coal"].to_numpy() == pytest.approx(np.repeat(force, 2), rel=1e-9)
    counts = np.round(volts / 400 * 2**15).astype(np.int16)
    np.testing.assert_allclose(cgid.predict(counts, 200e3, full_scale="400 V", **stated)["p_coal"], force, atol=0.02)
    with pytest.raises(MissingOption, match="unit='V'"):
        cgid.predict(volts, 200e3, **stated)
    with pytest.raises(InvalidValue, match="for samples in volts or coulombs, they are in N"):
        cgid.predict(volts, 200e3, "N", **stated)


def test_signals_bring_their_rate_unit_and_name() -> None:
    expected = cgid.predict(sample(), 200e3, "N")
    (signal,) = cgid.read_recording(SAMPLE)
    for given in (signal, [signal], replace(signal, samples=signal.samples / 1e3, unit="kN")):
        pd.testing.assert_frame_equal(cgid.predict(given), expected)
    left, right = replace(signal, channel="left"), replace(signal, channel="right", samples=signal.samples / 1e3)
    table = cgid.predict([left, replace(right, unit="kN")])
    assert table["channel"].value_counts().to_dict() == {"left": 6, "right": 6}
    assert set(cgid.predict([signal, replace(signal, source="b.csv")])["channel"]) == {str(SAMPLE), "b.csv"}
    for wrong, rate, says in (
        ([signal, replace(signal, sampling_rate=1e5)], None, "the sampling rate must be one to 0.01 %"),
        ([signal, replace(signal, samples=signal.samples[:-1])], None, "channels of one length"),
        ([signal, sample()], None, "got a ndarray among Signals"),
    ):
        with pytest.raises(BadData, match=says):
            cgid.predict(wrong, rate)
    batch = next(cgid.synthesise("reference", 4))
    for wrong in ([batch], [str(SAMPLE)], iter([batch])):
        with pytest.raises(InvalidValue, match="one Batch, Dataset or path a call"):
            cgid.predict(wrong)  # type: ignore[arg-type]
    with pytest.raises(BadData, match="one impact a row"):
        cgid.predict(batch.signals, batch.sampling_rate, "N")
    with pytest.raises(MissingOption, match="the unit must be known"):
        cgid.predict(replace(signal, unit=None))
    with pytest.raises(MissingOption, match="give sampling_rate"):
        cgid.predict(sample())
    with pytest.raises(MissingOption, match="unit"):  # newtons would be taken for an acceleration's
        cgid.predict(sample(), 200e3)


#: Runs `cgid` where neither of these can be imported, as after `pip install --no-deps cgid` with numpy and click.
LIGHT = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split(","):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
from cgid.cli.main import run
sys.exit(run(sys.argv[2:]))
"""
#: All libraries that cgid depends on but numpy and click, and what they bring.
HEAVY = "scipy,sklearn,pandas,numba,llvmlite,h5py,tqdm,pydantic,joblib,filelock,threadpoolctl,matplotlib"


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("predict", "datasets/sample.csv"), 0, "6 impacts: coal 3, gangue 3"),
        (("predict", "datasets/sample_acceleration.csv"), 0, "6 impacts: coal 3, gangue 3"),
        (("features", "datasets/sample.csv", "--features", "fitted_peak"), 0, "fitted_peak_N"),
        (("info", "datasets/sample.csv"), 0, "impacts: 6"),
        (("generate", "reference", "-o", "new.h5"), 69, f"which is not installed: pip install '{ROOT}'"),
        (("train", "reference", "-o", "new.npz"), 69, f"which is not installed: pip install '{ROOT}'"),
    ],
    ids=lambda value: "-".join(value[:2]).replace("/", "-") if isinstance(value, tuple) else None,
)
def test_recordings_need_numpy_and_click_alone(arguments: tuple[str, ...], code: int, says: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LIGHT, HEAVY, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
    assert says in done.stdout + done.stderr
    assert not code or (done.stderr.startswith("cgid: error: this needs ") and done.stderr.count("\n") == 1)


def test_python_answers_with_numpy_alone() -> None:
    """Without click, and without pandas for the table."""
    code = LIGHT.replace(
        "from cgid.cli.main import run\nsys.exit(run(sys.argv[2:]))",
        "from cgid import identify_recording, load_model, open_recording\n"
        "recording = open_recording('datasets/sample.csv')\n"
        "print([answer.label for answer in identify_recording(recording, load_model())])",
    )
    done = subprocess.run(
        [sys.executable, "-c", code, f"{HEAVY},click"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout == "['coal', 'gangue', 'coal', 'gangue', 'coal', 'gangue']\n", done.stderr
