"""A site file: the same answers as by options, names in every output, and what is refused."""

from __future__ import annotations

import csv
import io
import json
import re
import shlex
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest

import cgid
from cgid.cli.main import cli, run
from cgid.cli.site import sections_of
from cgid.errors import CgidError, InvalidValue
from cgid.recordings.site import KEYS, Site, site_text
from tests.streams_of_pulses import RATE, ROOT, stream

LABELS = ["coal", "gangue"] * 6
#: Sensitivity [mV/N] and gain of each of twelve channels; the seventh is upside down.
SENSITIVITIES = [2.0 + 0.1 * number for number in range(12)]
GAINS = [10 if number == 2 else 1 for number in range(12)]


def volts(newtons: np.ndarray) -> np.ndarray:
    """Return what the recorder of the twelve supports writes of one force [V], (n_samples, 12)."""
    signs = [-1 if number == 6 else 1 for number in range(12)]
    factors = np.array(SENSITIVITIES) * 1e-3 * GAINS * signs
    return newtons[:, np.newaxis] * factors


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of twelve supports in volts, its raw stream, and the site file that states it."""
    folder = tmp_path_factory.mktemp("plant")
    force = stream(LABELS, 0.02, seed=5)
    data = volts(force)
    np.save(folder / "minute.npy", data.T.astype(np.float64))
    data.astype("<f4").tofile(folder / "minute.f32")
    rows = [
        f'{number} = {{ name = "support {40 + number}", sensitivity = "{value:g} mV/N", gain = {gain}'
        + ("" if number != 7 else ", invert = true")
        + " }"
        for number, (value, gain) in enumerate(zip(SENSITIVITIES, GAINS, strict=True), 1)
    ]
    recorder = f'[recorder]\nrate = {RATE}\nunit = "V"\nchannels = 12\nsample_format = "f32le"\n'
    (folder / "face.toml").write_text(f"{recorder}[channels]\n" + "\n".join(rows) + '\n[decision]\nwindow = "0.24s"\n')
    return folder


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert run([*arguments]) == 0
    return capsys.readouterr().out


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def by_options() -> list[str]:
    """Return the options that state what the site does."""
    words = ["--rate", str(RATE), "--unit", "V", "--set", "window=0.24"]
    for number, (value, gain) in enumerate(zip(SENSITIVITIES, GAINS, strict=True), 1):
        words += ["--sensitivity", f"{number}={value:g} mV/N", "--set", f"channels.{number}.gain={gain}"]
    return [*words, "--set", "channels.7.invert=true"]


def test_answers_are_those_of_the_options_row_by_row(plant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, site = str(plant / "minute.npy"), str(plant / "face.toml")
    named = rows_of(printed(capsys, "--site", site, "predict", file))
    plain = rows_of(printed(capsys, "predict", file, *by_options()))
    assert len(named) == len(plain) > 100
    names = {f"support {40 + number}" for number in range(1, 13)}
    assert {row["channel"] for row in named} == names
    for own, other in zip(named, plain, strict=True):
        assert own | {"channel": ""} == other | {"channel": ""}
        assert own["channel"] == f"support {40 + int(other['channel'])}"


def test_monitor_hears_what_predict_hears_by_name(plant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site = str(plant / "face.toml")
    live = rows_of(printed(capsys, "monitor", str(plant / "minute.f32"), "--site", site))
    read = rows_of(printed(capsys, "predict", str(plant / "minute.npy"), "--site", site))
    key = "channel", "label"
    assert sorted([row[name] for name in key] for row in live) == sorted([row[name] for name in key] for row in read)
    apart = [abs(float(a["time_s"]) - float(b["time_s"])) for a, b in zip(live[:50], live[:50], strict=True)]
    assert max(apart) == 0


def test_every_output_has_the_names(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rows and records, the page of monitor, and the report; MQTT and Prometheus make theirs of these records."""
    site, page, report = str(plant / "face.toml"), tmp_path / "page.html", tmp_path / "report.html"
    names = {f"support {40 + number}" for number in range(1, 13)}
    lines = printed(capsys, "monitor", str(plant / "minute.f32"), "--site", site, "--json", "--live", str(page))
    assert {
        one["channel"] for one in map(json.loads, lines.splitlines()) if one["kind"] in ("impact", "state")
    } == names
    assert all(name in page.read_text() for name in names)
    assert run(["predict", str(plant / "minute.npy"), "--site", site, "--report", str(report), "--summary"]) == 0
    told = capsys.readouterr().out
    assert all(f"channel {name}: gangue fraction" in told for name in names)
    assert report.read_text().count("support 41") >= 1


def test_python_takes_the_site(plant: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = cgid.Site(plant / "face.toml")
    table = cgid.predict(plant / "minute.npy", site=site)
    assert set(table["channel"]) == {f"support {40 + number}" for number in range(1, 13)}
    signals = cgid.read_recording(plant / "minute.npy", site=plant / "face.toml")
    force = stream(LABELS, 0.02, seed=5)
    for signal in signals:  # one force through twelve chains, to the rounding of ten bits of a sensitivity
        np.testing.assert_allclose(signal.samples, force, rtol=1e-9, atol=1e-6)
    samples = np.load(plant / "minute.npy").T
    assert cgid.predict(samples, RATE, "V", site=site).equals(table)


def test_labels_made_by_a_site_train_by_it(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The table names the site, so that training reads sensitivities and inversion as the events were found."""
    site, table = str(plant / "face.toml"), tmp_path / "labels.csv"
    assert run(["--site", site, "events", str(plant / "minute.npy"), "--channel", "support 47", "-o", str(table)]) == 0
    rows = rows_of(table.read_text())
    assert len(rows) == len(LABELS) and {(tmp_path / row["site"]).resolve() for row in rows} == {Path(site).resolve()}
    assert {row["channel"] for row in rows} == {"support 47"} and {row["peak_unit"] for row in rows} == {"N"}
    for row, label in zip(rows, LABELS, strict=True):
        row["label"] = label
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    from cgid.cli.answering import prediction_by
    from cgid.cli.reading import ReadingOptions
    from cgid.identification.prediction.prediction import read_model
    from cgid.identification.training.manifest import read_manifest
    from cgid.identification.training.recordings import opened

    manifest = read_manifest(table)
    read = opened(tuple(manifest.annotations), ReadingOptions().of_manifest()).recording
    # The same volts, sign and name as in the events; and the next command states the site.
    np.testing.assert_allclose(read.samples()[0], stream(LABELS, 0.02, seed=5), rtol=1e-9, atol=1e-6)
    assert [channel.name for channel in read.channels] == ["support 47"]
    words = shlex.split(prediction_by(Path("m.npz"), read_model("default"), manifest, ReadingOptions()))
    assert Path(words[words.index("--site") + 1]).resolve() == Path(site).resolve()


def test_a_site_states_what_a_manifest_does_not(tmp_path: Path) -> None:
    labelled = ROOT / "datasets" / "labelled"
    rows = list(csv.DictReader((labelled / "labels.csv").read_text().splitlines()))
    for name, columns in (("stated", rows[0].keys()), ("bare", rows[0].keys() - {"full_scale"})):
        with (tmp_path / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, sorted(columns), extrasaction="ignore")
            writer.writeheader()
            writer.writerows({**row, "path": str(labelled / row["path"])} for row in rows)
    site = _written(tmp_path / "s.toml", f'[recorder]\nfull_scale = "{rows[0]["full_scale"]}"\n')
    names = ["level_total", "decay_time"]
    stated = cgid.train_on_groups(tmp_path / "stated.csv", features=names)
    by_site = cgid.train_on_groups(tmp_path / "bare.csv", features=names, site=site)
    for name, array in stated.model.arrays.items():
        np.testing.assert_array_equal(by_site.model.arrays[name], array)
    assert cgid.train_on_groups(tmp_path / "bare.csv", features=names).model.unit == "FS" != by_site.model.unit


def test_beams_of_a_site_are_one_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    force = stream(LABELS[:4], 0.02, seed=3)
    np.save(tmp_path / "two.npy", np.stack([force, 0.8 * force]))
    (tmp_path / "s.toml").write_text(
        '[channels]\n1 = { name = "left", beam = "A" }\n2 = { name = "right", beam = "A" }'
    )
    given = [str(tmp_path / "two.npy"), "--rate", str(RATE), "--unit", "N"]
    named = rows_of(printed(capsys, "predict", *given, "--site", str(tmp_path / "s.toml")))
    plain = rows_of(printed(capsys, "predict", *given, "--same-beam", "1+2"))
    assert {row["channel"] for row in named} == {"left+right"}
    assert [row | {"channel": ""} for row in named] == [row | {"channel": ""} for row in plain]


def test_the_line_wins(plant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, site = str(plant / "minute.npy"), str(plant / "face.toml")
    shares = [
        [json.loads(line) for line in printed(capsys, "predict", file, "--site", site, "--json", *more).splitlines()]
        for more in ((), ("--set", "window=0.1"))
    ]
    spans = [{round(one["to_s"] - one["from_s"], 6) for one in lines if one["kind"] == "share"} for lines in shares]
    assert max(spans[0]) == 0.24 and max(spans[1]) == 0.1
    other = printed(capsys, "info", file, "--site", site, "--sensitivity", "support 41=1 mV/N", "--json")
    origins = [value["converted"] for name, value in json.loads(other).items() if name.startswith("channel ")]
    assert "sensitivity 1 mV/N" in origins[0] and "sensitivity 2.1 mV/N" in origins[1]


def test_the_environment_states_a_site(
    plant: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CGID_SITE", str(plant / "face.toml"))
    assert "channel support 41:" in printed(capsys, "info", str(plant / "minute.npy"))


def test_the_written_site_reads_its_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    force = stream(LABELS[:4], 0.02, seed=3)
    head = "time (s),left,right\n"
    rows = "".join(f"{k / RATE:.7f},{one * 2e-3:.9f},{one * 4e-3:.9f}\n" for k, one in enumerate(force))
    (tmp_path / "two.csv").write_text(head + rows)
    site, file = tmp_path / "site.toml", str(tmp_path / "two.csv")
    said = ["--unit", "V", "--sensitivity", "2 mV/N"]
    assert run(["info", file, *said, "--write-site", str(site)]) == 0
    assert f"--site {site}" in capsys.readouterr().err
    for line in site.read_text().splitlines():
        assert not line or line.startswith(("#", "[")) or "  # " in line  # a comment a line
    assert printed(capsys, "predict", file, "--site", str(site)) == printed(capsys, "predict", file, *said)
    assert run(["info", file, *said, "--write-site", str(site)]) == 73  # nothing is replaced
    # Values of one channel are those of that channel, and what a site states already stays.
    other = tmp_path / "other.toml"
    said = [
        "--unit",
        "V",
        "--sensitivity",
        "2 mV/N",
        "--sensitivity",
        "right=4 mV/N",
        "--set",
        "channels.1.invert=true",
    ]
    assert run(["info", file, *said, "--write-site", str(other)]) == 0
    capsys.readouterr()
    site_of_two = Site(other)
    assert site_of_two.values["recorder"]["sensitivity"] == "2 mV/N"
    assert site_of_two.channels[2]["sensitivity"] == "4 mV/N" and "sensitivity" not in site_of_two.channels[1]
    assert site_of_two.channels[1]["invert"] is True
    assert printed(capsys, "predict", file, "--site", str(other)) == printed(capsys, "predict", file, *said)
    commented = re.sub(r"(?m)^# (\w+ = )", r"\1", site.read_text())  # each line that is not used could be
    Site(_written(tmp_path / "all.toml", commented))


def _written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_hints_carry_the_site(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _written(tmp_path / "s.toml", '[recorder]\nrate = 200000\nunit = "N"\n')
    np.save(tmp_path / "a.npy", -stream(LABELS[:4], 0.02, seed=3))
    assert run(["predict", str(tmp_path / "a.npy"), "--site", str(tmp_path / "s.toml"), "--set", "hold=3"]) in (0, 65)
    hint = capsys.readouterr().err
    assert f"--site {tmp_path / 's.toml'}" in hint if "cgid predict" in hint else True


WRONG = {
    "[recorder]\nrat = 5": "did you mean 'rate'",
    "[desicion]\nhold = 5": "did you mean 'decision'",
    "[recorder]\nhold = 5": "[decision]",
    "hold = 5\n[recorder]\nrate = 5": "hold",
    '[recorder]\nrate = "fast"': "[recorder] rate must be a number",
    "[recorder]\nunit = 5": "[recorder] unit must be a text",
    '[recorder]\nunit = "Hz"': "[recorder] unit",
    '[channels.1]\nsensitivity = "10 mV/Hz"': "[channels.1] sensitivity",
    '[channels.1]\nname = "a"\n[channels.2]\nname = "a"': "two are called a",
    '[channels.1]\nname = "1+2"': "without",
    '[channels.1]\nnam = "a"': "did you mean 'name'",
    '[model]\nmodel = "../other.npz"': "must be in the folder",
    '[decision]\nhold = "5 m"': "must be a time",
    "[decision]\ntrained_seam = 1": "true or false",
    '[model]\nmiss_cost = "much"': "LABEL=COST",
    "channels = 3\n[recorder]\nrate = 5": "tables such as",
    "[recorder\n": "TOML",
    "[[recorder]]\nrate = 5": "section",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_site_is_one_line(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _written(tmp_path / "s.toml", text)
    with pytest.raises(CgidError) as raised:
        Site(path)
    assert str(path) in str(raised.value) and WRONG[text] in str(raised.value)
    assert run(["predict", "--sample", "--site", str(path)]) == 65
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_channels_are_those_of_the_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    force = stream(LABELS[:2], 0.02, seed=3)
    np.save(tmp_path / "two.npy", np.stack([force, force]))
    given = ["predict", str(tmp_path / "two.npy"), "--rate", str(RATE), "--unit", "N", "--site"]
    many = "".join(f'[channels.{number}]\nname = "support {number}"\n' for number in range(1, 201))
    for text, word in (
        ('[channels.3]\nname = "x"', "channel 3"),
        (many, "channel 3"),
        ('[channels.1]\nname = "2"', "2 is that of two"),
        ('[channels.1]\nname = "x"\n[channels."1"]\nname = "y"', "TOML"),
    ):
        assert run([*given, str(_written(tmp_path / "s.toml", text))]) == 65
        assert word in capsys.readouterr().err
    wide = np.repeat(force[np.newaxis, :2000], 200, axis=0)
    np.save(tmp_path / "wide.npy", wide)
    recording = cgid.open_recording(
        tmp_path / "wide.npy", sampling_rate=RATE, unit="N", site=_written(tmp_path / "m.toml", many)
    )
    assert [channel.name for channel in recording.channels][-1] == "support 200"


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (["--site", "gone.toml"], 66, "gone.toml"),
        (["--site", str(ROOT / "datasets" / "sample.csv")], 65, "site file must be TOML"),
        (["--site", str(ROOT / "datasets" / "caving.toml")], 65, "scene"),
        (["--site", "a.toml", "--site", "b.toml"], 2, "--site must be given once"),
        (["--site", ""], 2, "empty"),
        (["--set", "hold"], 2, "KEY=VALUE"),
        (["--set", "hodl=5"], 65, "did you mean 'hold'"),
        (["--set", "dtype=float32"], 65, "does not use [datasets]"),
        (["--hold=5"], 2, "--set hold=VALUE"),
    ],
)
def test_what_a_line_says_wrong(arguments: list[str], code: int, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    for line in (["predict", "--sample", *arguments], [*arguments, "predict", "--sample"]):
        if line[0] == "--hold=5":
            continue
        assert run(line) == code
        assert word in capsys.readouterr().err


def test_a_site_is_no_output(plant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site = str(plant / "face.toml")
    before = Path(site).read_bytes()
    line = ["info", str(plant / "minute.npy"), "--site", site, "--write-site", site]
    assert run(line) == 73
    assert Path(site).read_bytes() == before


def test_each_command_has_its_sections_and_each_key_a_command() -> None:
    used = {section for name in cli.commands for section in sections_of(cli.commands[name])}
    assert used == set(KEYS)
    flags = {
        max(option.opts, key=len).strip("-").replace("-", "_")
        for name in cli.commands
        for option in cli.commands[name].params
        if isinstance(option, click.Option) and set(sections_of(cli.commands[name])) > {"scene"}
    }
    assert {"rate", "unit", "sensitivity", "full_scale", "model", "mqtt", "coal_until"} <= flags
    assert sum(len(cli.commands[name].params) for name in ("predict", "monitor")) <= 20 + 18 + 2  # and an argument each


def test_all_keys_are_on_the_long_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["predict", "--help"]) == 0
    short = capsys.readouterr().out
    assert len(short.splitlines()) <= 60
    assert run(["predict", "--help-all"]) == 0
    page = capsys.readouterr().out
    assert page.startswith(short.splitlines()[0])
    for section in ("recorder", "model", "decision"):
        assert f"[{section}]" in page
        assert all(re.search(rf"^  {key} ", page, re.MULTILINE) for key in KEYS[section])


def test_the_site_of_the_guide_is_one(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "how-to" / "plant.md").read_text()
    (block,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert len(tomllib.loads(block)["channels"]) == 2
    site = Site(_written(tmp_path / "face3.toml", block))
    assert site.get("cycle_pause") == 120 and site.channels[2]["gain"] == 10
    data = np.random.default_rng(0).normal(0, 1, (2, 4000)).astype(np.int16)
    np.save(tmp_path / "minute.npy", data)
    recording = cgid.open_recording(tmp_path / "minute.npy", site=site)
    assert {channel.unit for channel in recording.channels} == {"m/s^2"}
    text = site_text(recording, {})
    assert Site(_written(tmp_path / "again.toml", text)).channels[2]["name"] == "support 42"


def test_values_replace_those_of_the_file(plant: Path) -> None:
    site = Site(plant / "face.toml", {"window": "2s", "channels.1.gain": "20 dB"})
    assert site.settings["share_time"] == 2 and site.channels[1]["gain"] == "20 dB"
    dotted = Site(values={"channels.face 1.2.gain": 3})
    assert dotted.channels == {"face 1.2": {"gain": 3}}
    with pytest.raises(InvalidValue, match="windo"):
        Site(plant / "face.toml", {"windo": 2})
