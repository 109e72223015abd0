"""Recordings in volts, coulombs and counts against the same blows in N and m/s^2; files by other libraries."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cgid import open_recording, read_recording
from cgid.cli.main import run as main
from cgid.errors import BadData, InvalidValue
from cgid.identification.training.manifest import read_manifest
from cgid.recordings.chain import Chain, FullScale, Gain
from cgid.recordings.live import live_stream
from tests import recording_files
from tests.bad_input import pulse

#: Standard gravity, written out: 17th General Conference on Weights and Measures.
GRAVITY = 9.80665
RATE = 25_600
#: What the accelerometer and the hammer give: 10.2 mV/g and 2.3 mV/N.
BEAM, HAMMER = 10.2e-3 / GRAVITY, 2.3e-3
SENSITIVITY = ("--sensitivity", "beam=10.2 mV/g", "--sensitivity", "hammer=2.3 mV/N")


def blows(n_samples: int = 25_600) -> np.ndarray:
    """Return a beam's motion [m/s^2] and a hammer's force [N] for three blows, (2, n_samples)."""
    random = np.random.default_rng(3)
    motion, force = random.normal(0, 0.3, n_samples), random.normal(0, 1.0, n_samples)
    time = np.arange(n_samples) / RATE
    for onset, peak in ((0.2, 300.0), (0.5, 450.0), (0.8, 200.0)):
        after = np.clip(time - onset, 0, None)
        for frequency, decay in ((620.0, 60.0), (1480.0, 90.0), (3300.0, 160.0)):
            motion += (after > 0) * peak / 3 * np.exp(-decay * after) * np.sin(2 * np.pi * frequency * after)
        force += 8 * peak * np.sin(np.pi * np.clip(after / 2e-3, 0, 1)) ** 1.5
    return np.stack([motion, force])


def tdms(path: Path, rows: np.ndarray, units: list[str], *about: dict) -> None:
    from nptdms import ChannelObject, TdmsWriter

    channels = [
        ChannelObject("rig", name, row, {"wf_increment": 1 / RATE, "wf_start_offset": 0.0, "unit_string": unit, **more})
        for name, row, unit, more in zip(("beam", "hammer"), rows, units, about or ({}, {}), strict=False)
    ]
    with TdmsWriter(str(path)) as writer:
        writer.write_segment(channels)


def uff(path: Path, rows: np.ndarray, units: list[str], *lines: str) -> None:
    recording_files.write_uff(path, rows, RATE, names=("beam", "hammer"), units=units, id4=lines or ("NONE", "NONE"))


def csv(path: Path, rows: np.ndarray, units: list[str], *above: str) -> None:
    import pandas

    names = [f"{name} ({unit})" for name, unit in zip(("beam", "hammer"), units, strict=False)]
    table = pandas.DataFrame({"time (s)": np.arange(rows.shape[1]) / RATE, **dict(zip(names, rows, strict=True))})
    with path.open("w") as file:
        file.writelines(f"# {line}\n" for line in above)
        table.to_csv(file, index=False)


def wav(path: Path, rows: np.ndarray, units: list[str]) -> None:
    import soundfile

    soundfile.write(path, rows.T, RATE, subtype="DOUBLE", format="WAV")


def npz(path: Path, rows: np.ndarray, units: list[str]) -> None:
    np.savez(path, samples=rows, fs=float(RATE), units=np.array(units), channel_names=np.array(["beam", "hammer"]))


WRITERS = {
    "a.csv": csv,
    "a.tdms": tdms,
    "a.uff": uff,
    "a.npz": npz,
}


@dataclass(frozen=True)
class Done:
    """What a command left behind."""

    exit_code: int
    stdout: str
    stderr: str


def run(arguments: list[str]) -> Done:
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = main(arguments)
    return Done(code, out.getvalue(), err.getvalue())


def answers(*arguments: str) -> list[tuple]:
    """Return label, time and probability of the impacts that `cgid predict --json` prints."""
    done = run(["predict", "--json", *arguments])
    assert done.exit_code == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    return [(row["label"], row["time_s"], row["probabilities"]) for row in rows if row["kind"] == "impact"]


def assert_same(found: list[tuple], expected: list[tuple], rel: float = 1e-6) -> None:
    assert len(found) == len(expected) > 1
    for one, other in zip(found, expected, strict=True):
        assert one[0] == other[0]
        assert one[1] == pytest.approx(other[1], abs=1e-9)
        assert one[2] == pytest.approx(other[2], rel=rel)


@pytest.mark.parametrize("name", WRITERS)
def test_volts_and_coulombs_enter_as_what_the_sensors_measured(name: str, tmp_path: Path) -> None:
    measured = blows(5000)
    volts = measured * [[BEAM], [HAMMER]]
    WRITERS[name](tmp_path / name, volts, ["V", "V"])
    recording = open_recording(tmp_path / name, sensitivity={"beam": "10.2 mV/g", 2: "2.3 mV/N"})
    assert [(channel.unit, channel.quantity) for channel in recording.channels] == [
        ("m/s^2", "acceleration"),
        ("N", "force"),
    ]
    assert recording.channels[0].origin == "from V, sensitivity 10.2 mV/g"
    for rows in (np.concatenate(list(recording.blocks(777)), axis=1), [one.samples for one in recording.signals()]):
        np.testing.assert_allclose(rows, measured, rtol=1e-9, atol=1e-9)
    # Of an amplifier of 20 dB, in millivolts; one value for both channels, and one more for the second.
    (tmp_path / name).unlink()
    WRITERS[name](tmp_path / name, 1e4 * volts, ["mV", "mV"])
    found = read_recording(tmp_path / name, sensitivity=["10.2 mV/g", "hammer=2.3 mV/N"], gain="20 dB")
    np.testing.assert_allclose([one.samples for one in found], measured, rtol=1e-9, atol=1e-9)
    # Charge: of a charge sensor as it is, and behind an amplifier of 0.5 mV/pC.
    (tmp_path / name).unlink()
    charges = measured * [[3.1 / GRAVITY], [4.0]]
    WRITERS[name](tmp_path / name, charges * [[1.0], [0.5e-3]], ["pC", "V"])
    found = read_recording(tmp_path / name, sensitivity=["beam=3.1 pC/g", "hammer=4 pC/N"], gain="hammer=0.5 mV/pC")
    np.testing.assert_allclose([one.samples for one in found], measured, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("specimen", recording_files.SPECIMENS, ids=lambda specimen: specimen.name)
def test_volts_enter_from_every_format(
    specimen: recording_files.Specimen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not specimen.is_possible:
        pytest.skip(f"{specimen.writer} is not installed")
    monkeypatch.setattr(recording_files, "UNIT", "V")
    volts, path = recording_files.blows(), tmp_path / f"a{specimen.suffix}"
    specimen.write(path, volts, 51_200.0)
    options = {**specimen.options, **({} if specimen.says_unit else {"unit": "V"})}
    found = read_recording(path, sensitivity="10.2 mV/g", gain=2, **options)
    for signal, row in zip(found, volts, strict=False):
        assert signal.unit == "m/s^2"
        rounding = 1e-6 * np.abs(row).max() / (2 * BEAM)
        assert np.abs(signal.samples - row / (2 * BEAM)).max() <= specimen.resolution / (2 * BEAM) + rounding


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """Answers for the blows in SI units."""
    path = tmp_path_factory.mktemp("si") / "si.npy"
    found = []
    for row, unit in zip(blows(), ("m/s^2", "N"), strict=True):
        np.save(path, row)
        found.append(answers(str(path), "--rate", str(RATE), "--unit", unit))
    return found


@pytest.mark.parametrize("name", ["a.csv", "a.tdms", "a.uff", "a.wav"])
def test_volts_are_answered_like_newtons_and_accelerations(name: str, expected: list[Any], tmp_path: Path) -> None:
    measured = blows()
    write = {**WRITERS, "a.wav": wav}[name]
    write(tmp_path / name, measured * [[BEAM], [HAMMER]], ["V", "V"])
    if name == "a.wav":
        sensitivity = ("--full-scale", "1 V", "--sensitivity", "1=10.2 mV/g", "--sensitivity", "2=2.3 mV/N")
    else:
        sensitivity = SENSITIVITY
    for channel, same in enumerate(expected, start=1):
        assert_same(answers(str(tmp_path / name), "--channel", str(channel), *sensitivity), same)


def test_integers_of_a_recorder_are_right_to_their_rounding(tmp_path: Path) -> None:
    from scipy.io import wavfile

    measured = blows()
    volts = measured * [[BEAM], [HAMMER]]
    counts = np.rint(volts / 10 * 2**15).astype(np.int16)
    assert np.abs(counts).max() > 3000
    wavfile.write(tmp_path / "a.wav", RATE, counts.T)
    np.save(tmp_path / "a.npy", counts)
    np.savetxt(tmp_path / "a.csv", counts.T, fmt="%d", delimiter=",", header="beam,hammer", comments="")
    tdms(tmp_path / "a.tdms", counts, ["", ""])
    half_a_step = 10 / 2**16
    np.save(tmp_path / "a.i4", counts.astype(np.int32))
    (tmp_path / "a.i4.npy").rename(tmp_path / "a.i4")
    scales = {"wav": "10 V", "npy": "±10 V", "csv": "10 V at 16 bit", "i4": "10 V at 16 bit", "tdms": "10 V"}
    for name, scale in scales.items():
        given = {} if name in ("wav", "tdms") else {"sampling_rate": RATE}
        found = read_recording(
            tmp_path / f"a.{name}", full_scale=scale, sensitivity={1: "10.2 mV/g", 2: "2.3 mV/N"}, **given
        )
        assert [one.unit for one in found] == ["m/s^2", "N"]
        for one, row, sensitivity in zip(found, measured, (BEAM, HAMMER), strict=True):
            error = np.abs(one.samples - row)
            assert error.max() <= half_a_step / sensitivity * (1 + 1e-9)
            assert error.max() > 0.99 * half_a_step / sensitivity
    # A recorder of 50 g needs no sensitivity.
    (motion, _) = read_recording(tmp_path / "a.wav", full_scale="50 g")
    assert motion.unit == "g"
    np.testing.assert_allclose(motion.samples, counts[0] / 2**15 * 50)
    np.save(tmp_path / "si.npy", (counts[1] / 2**15 * 10 / HAMMER))
    stated = ("--full-scale", "10 V", "--sensitivity", "2.3 mV/N", "--channel", "2")
    expected = answers(str(tmp_path / "si.npy"), "--rate", str(RATE), "--unit", "N")
    assert_same(answers(str(tmp_path / "a.wav"), *stated), expected)


def test_clipping_is_seen_behind_a_sensitivity(tmp_path: Path) -> None:
    from scipy.io import wavfile

    volts = np.clip(blows()[1] * HAMMER, -5.0, 5.0)
    wavfile.write(tmp_path / "a.wav", RATE, np.clip(np.rint(volts / 5 * 2**15), -(2**15), 2**15 - 1).astype(np.int16))
    done = run(
        ["predict", "--json", str(tmp_path / "a.wav"), "--full-scale", "5 V", "--sensitivity", "2.3 mV/N"],
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["clipped"] for row in rows if row["kind"] == "impact"] == [True, True, False]


def test_files_that_state_the_sensitivity_need_no_option(tmp_path: Path) -> None:
    measured = blows(5000)
    volts = measured * [[BEAM], [HAMMER]]
    csv(tmp_path / "a.csv", volts, ["V", "V"], "sensitivity: 10.2 mV/g, 2.3 mV/N")
    tdms(
        tmp_path / "a.tdms",
        volts,
        ["Volts", "V"],
        {"Sensor_Sensitivity": 10.2, "Sensor_Sensitivity_Units": "mVolts/g"},
        {"Sensitivity": "2.3 mV/N"},
    )
    uff(tmp_path / "a.uff", volts, ["V", "V"], "Sensitivity: 10.2 mV/g", "sensitivity [mV/N] = 2.3")
    for name in ("a.csv", "a.tdms", "a.uff"):
        found = read_recording(tmp_path / name)
        assert [one.unit for one in found] == ["m/s^2", "N"], name
        np.testing.assert_allclose([one.samples for one in found], measured, rtol=1e-9, atol=1e-9)
        # An option that says the same is used, one that says another is refused.
        read_recording(tmp_path / name, channel=1, sensitivity="10.2 mV/g")
        with pytest.raises(InvalidValue, match=r"must agree with the file to 0.1 %, got 100 mV/g where it states 10.2"):
            read_recording(tmp_path / name, channel=1, sensitivity="100 mV/g")
    # What is in m/s^2 already keeps it, whatever was the sensitivity of the sensor.
    tdms(tmp_path / "si.tdms", measured[:1], ["g"], {"Sensitivity": "10.2 mV/g"})
    (signal,) = read_recording(tmp_path / "si.tdms")
    assert signal.unit == "g"
    np.testing.assert_array_equal(signal.samples, measured[0])


def test_every_way_to_state_a_chain() -> None:
    for text, factor in (
        ("10", 10.0),
        ("x10", 10.0),
        ("10x", 10.0),
        ("×2.5", 2.5),
        ("20 dB", 10.0),
        ("-6dB", 0.501187),
    ):
        assert Gain.of(text).value == pytest.approx(factor, rel=1e-6)
    assert Gain.of("1 mV/pC").value == pytest.approx(1e9)
    assert Gain.of(np.float32(2.5)).value == 2.5
    assert Gain.of(1.23456789012).value == 1.23456789012
    for nothing in (True, b"1 V/N", [None], float("nan"), np.array([1.0, 2.0]), 1 + 2j):
        for what in ("sensitivity", "gain", "full_scale"):
            with pytest.raises(InvalidValue, match=what):
                Chain.of(**{what: nothing})
    for text in ("10 V", "±10 V", "+/-10 V", "+-10V", "10 volts"):
        assert FullScale.of(text) == FullScale(value=10.0, unit="V", text="")
    for text, factor in (("100 mV/g", 0.1 / GRAVITY), ("10 mV/(m/s^2)", 0.01), ("10 mV/m/s²", 0.01), ("1 V/kN", 1e-3)):
        ((_, sensitivity),) = Chain.of(text).sensitivity.values
        assert sensitivity.value == pytest.approx(factor, rel=1e-12)
    assert Chain.of({"a=b": "1 V/N"}) == Chain.of("a=b=1 V/N") == Chain.of(["a=b=1 V/N"])


def test_live_streams_enter_in_si_units_too() -> None:
    counts = np.array([[16384, -8192], [0, 32767]], "<i2")
    chain = Chain.of(["1=100 mV/g", "2=2 mV/N"], None, "10 V")
    live = live_stream(
        io.BytesIO(counts.tobytes()), sampling_rate=RATE, n_channels=2, sample_format="s16le", chain=chain
    )
    assert [channel.unit for channel in live.channels] == ["m/s^2", "N"]
    found = np.concatenate(list(live), axis=1)
    np.testing.assert_allclose(found, [[50 * GRAVITY, 0.0], [-1250.0, 32767 / 32768 * 5000]], rtol=1e-12)


def test_a_manifest_in_volts_gives_the_rows_of_one_in_newtons(tmp_path: Path) -> None:
    from cgid.identification.training.recordings import Reading, record
    from cgid.identification.training.rows import Slicing

    force = np.concatenate([pulse(4000, duration) for duration in (4e-4, 6e-4)])
    np.save(tmp_path / "n.npy", force)
    np.save(tmp_path / "v.npy", force * HAMMER)
    np.save(tmp_path / "q.npy", force * 4.0 * 0.5e-3)
    rows = []
    for name, columns, cells in (
        ("n", "unit", "N"),
        ("v", "unit,sensitivity", "V,2.3 mV/N"),
        ("q", "unit,sensitivity,gain", "V,1=4 pC/N,0.5 mV/pC"),
    ):
        path = tmp_path / f"{name}.csv"
        path.write_text(f"path,label,rate_Hz,{columns}\n{name}.npy,coal,200000,{cells}\n")
        rows.append(record(read_manifest(path), slicing=Slicing(by="impact")))
    # What a manifest does not state, options may.
    path.write_text("path,label,rate_Hz\nq.npy,coal,200000\n")
    stated = {"unit": "V", "sensitivity": "4 pC/N", "gain": "0.5 mV/pC"}
    rows.append(record(read_manifest(path), slicing=Slicing(by="impact"), reading=Reading(**stated)))
    path.write_text("path,label,rate_Hz,unit,sensitivity,gain\nv.npy,coal,200000,mV,2.3 mV/N,-60 dB\n")
    rows.append(record(read_manifest(path), slicing=Slicing(by="impact"), reading=Reading(**stated)))
    assert len(rows[0].features) == 2
    for other in rows[1:]:
        assert other.unit == rows[0].unit == "N"
        np.testing.assert_allclose(other.features, rows[0].features, rtol=1e-6)
    (tmp_path / "two.csv").write_text(
        "path,label,start_s,end_s,sensitivity\nv.npy,coal,0,0.01,2 mV/N\nv.npy,coal,0.01,0.02,2.3 mV/N\n"
    )
    with pytest.raises(BadData, match=r"must have one sensitivity, got 2 mV/N and 2.3 mV/N"):
        read_manifest(tmp_path / "two.csv")
