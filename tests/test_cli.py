"""The command line from outside: what it prints, where, and what it returns."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from scipy.io import wavfile

from cgid.cli.main import cli, run
from cgid.cli.options import OutputName
from cgid.errors import MissingExtra
from cgid.shipped import SCENES, path_of
from tests.bad_input import CASES, Case, make_files

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def bad_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    make_files(folder)
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset and a model made by the commands themselves."""
    folder = tmp_path_factory.mktemp("made")
    assert run(["generate", "reference", "-o", str(folder / "data"), "-n", "3000", "--seed", "4"]) == 0
    assert run(["generate", "reference", "-o", str(folder / "new.h5"), "-n", "400", "--seed", "5"]) == 0
    assert run(["train", str(folder / "data"), "-o", str(folder / "m.npz")]) == 0
    return folder


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input(
    case: Case, bad_files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(bad_files)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = {path: path.lstat().st_mtime_ns for path in bad_files.rglob("*")}
    code = run(list(case.arguments))
    out, err = capsys.readouterr()
    assert code == case.exit_code, err
    errors = [line for line in err.splitlines() if line.startswith("cgid: error: ")]
    assert len(errors) == (3 if "three.toml" in case.arguments else 1), err
    assert all(word in " ".join(errors) for word in case.says), err
    assert "Traceback" not in err
    # A recording without impacts has a table without rows.
    assert out == "" or (out.startswith("source,channel,time_s,") and out.count("\n") == 1)
    assert {path: path.lstat().st_mtime_ns for path in bad_files.rglob("*")} == before


@pytest.mark.parametrize("number", ["0", "-1"])
def test_a_number_of_threads_that_numba_refuses_is_named(number: str) -> None:
    """By a new process: numba looks at it when it is loaded."""
    command = [sys.executable, "-m", "cgid", "check", "reference"]
    asked = {**os.environ, "NUMBA_NUM_THREADS": number}
    done = subprocess.run(command, capture_output=True, text=True, env=asked, cwd=ROOT)
    assert done.returncode == 65
    assert done.stderr == f"cgid: error: NUMBA_NUM_THREADS must be 1 or more, got {number}; unset it\n"


def _led_to(error: Exception, cause: Exception) -> Exception:
    error.__context__ = cause
    return error


_UNMAPPED = ImportError("libblas.so: failed to map segment from shared object")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 72.8 TiB"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
        _UNMAPPED,
        _led_to(OSError("Could not find/load shared object file 'libllvmlite.so'"), OSError(str(_UNMAPPED))),
        _led_to(MissingExtra("pictures need matplotlib; pip install cgid[plot]"), _UNMAPPED),
        RuntimeError("can't start new thread"),
    ],
    ids=str,
)
def test_short_memory_is_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: str) -> None:
        raise error

    monkeypatch.setattr("cgid.scene.load_scene", fail)
    assert run(["check", "reference"]) == 65
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("cgid: error: out of memory")
    assert "smaller input" in line and "--jobs" in line


def test_train_then_predict_on_new_impacts(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["predict", str(made / "new.h5"), "--model", str(made / "m.npz"), "--json"]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(line) for line in out.splitlines()]
    assert len(rows) == 400
    right = np.mean([max(row["probabilities"], key=row["probabilities"].get) == row["truth"] for row in rows])
    assert 0.8 < right < 0.95
    assert f"accuracy of the most probable label {right:.4f} (95 % interval" in err
    assert (made / "m.md").read_text().startswith("# Model card")


@pytest.mark.long
def test_training_from_a_scene_is_training_from_its_dataset(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, data = str(ROOT / "datasets" / "reference.toml"), str(made / "data")
    assert run(["train", scene, "-n", "3000", "--seed", "4", "-o", str(made / "a.npz"), "--json"]) == 0
    from_scene = json.loads(capsys.readouterr().out)
    assert run(["train", data, "--seed", "4", "-o", str(made / "b.npz"), "--json"]) == 0
    from_data = json.loads(capsys.readouterr().out)
    assert from_scene["accuracy"] == from_data["accuracy"]
    assert (made / "a.npz").read_bytes() == (made / "b.npz").read_bytes()


def test_nothing_beside_a_model_is_overwritten_unasked(made: Path) -> None:
    (made / "notes.md").write_text("mine")
    assert run(["train", str(made / "data"), "-o", str(made / "notes.npz")]) == 73
    assert (made / "notes.md").read_text() == "mine"


def test_info_says_what_is_there(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(made / "data"), "--json"]) == 0
    dataset = json.loads(capsys.readouterr().out)
    assert (dataset["signals"], dataset["samples"], dataset["seed"]) == (3000, 2048, 4)
    assert sum(dataset["labels"].values()) == 3000
    assert dataset["dissipation"] == "hunt-crossley"
    assert run(["info", str(made / "m.npz"), "--json"]) == 0
    model = json.loads(capsys.readouterr().out)
    assert model["training"]["sources"] == [dataset["scene_sha256"]]
    assert run(["info", str(made / "m.npz")]) == 0
    assert "family: logistic" in capsys.readouterr().out


def test_info_names_the_laws_that_a_column_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from cgid.scene import generate
    from cgid.store import Dataset

    generate("rock", tmp_path / "rock.h5", 64, 0)
    assert run(["info", str(tmp_path / "rock.h5"), "--json"]) == 0
    laws = json.loads(capsys.readouterr().out)["dissipation"]
    rocks = Dataset(tmp_path / "rock.h5").parameters
    named = rocks["dissipation"].map(lambda number: laws[f"{number:.0f}"])
    assert ((named == "thornton") == rocks["yield_pressure"].notna()).all() and named.nunique() == 4


def test_info_says_what_a_table_of_events_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "events.csv"
    table.write_text("path,start_s,end_s,label\na.wav,0,1,\na.wav,1,2,coal\nb.wav,0,1,\n")
    assert run(["info", str(table), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [content[name] for name in ("kind", "rows", "recordings", "labels", "without_a_label")] == [
        "table of events",
        3,
        2,
        {"coal": 1},
        2,
    ]
    assert f"cgid train {table} -o" in content["next"]
    for scene in (str(ROOT / "datasets" / "caving.toml"), "caving"):
        assert run(["info", scene, "--json"]) == 0
        content = json.loads(capsys.readouterr().out)
        assert (content["kind"], content["name"]) == ("scene", "caving")
    # Without these columns it is a recording, which has no numbers.
    table.write_text("file,text\na.wav,coal\n")
    assert run(["info", str(table)]) == 65


@pytest.mark.parametrize("n_full", [1, 40])
def test_info_counts_samples_at_full_scale(n_full: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sound = np.linspace(-0.9, 0.9, 2000)
    sound[100 : 100 + n_full] = 32767 / 32768
    wavfile.write(tmp_path / "a.wav", 8000, np.round(sound * 32768).astype(np.int16))
    assert run(["info", str(tmp_path / "a.wav"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["warnings"]
    assert told == "none" if n_full == 1 else f"{n_full} samples" in told[0]


def test_info_says_what_is_upside_down_whatever_the_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cgid.identification.detection.detector.ImpactDetector.why_silent", lambda *_, **__: "")
    force = np.random.default_rng(1).normal(0, 1.0, 20_000)
    force[10_000:10_060] -= 4e3 * np.sin(np.linspace(0, np.pi, 60))
    for name, samples in (("down", force), ("quiet", force[:9000])):
        np.save(tmp_path / f"{name}.npy", samples)
        assert run(["info", str(tmp_path / f"{name}.npy"), "--rate", "200000", "--unit", "N"]) == 0
        assert ("invert=true" in capsys.readouterr().err) == (name == "down")


@pytest.mark.parametrize("name", SCENES)
def test_a_shipped_scene_is_checked_without_warnings(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", name, "--json"]) == 0
    out, err = capsys.readouterr()
    assert (err, json.loads(out)["warnings"]) == ("", {})


def test_a_cure_is_for_scenes_of_users(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In a shipped scene what is unusual is intended."""
    fact, cure = "have fewer than 20 samples on the contact", "raise sampling_rate"
    (tmp_path / "mine.toml").write_text(path_of("datasets", "reference.toml").read_text(encoding="utf-8"))
    told = []
    for scene in ("reference", str(tmp_path / "mine.toml")):
        assert run(["check", scene, "--json"]) == 0
        told.append(json.loads(capsys.readouterr().out))
    assert [[*one["remarks"]] for one in told] == [[fact], []]
    assert [[*one["warnings"]] for one in told] == [[], [f"{fact}; {cure}"]]


def test_check_warns_of_a_radius_without_its_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reference = path_of("datasets", "reference.toml").read_text(encoding="utf-8")
    (tmp_path / "mm.toml").write_text(
        reference.replace('lowest = "10 mm", highest = "80 mm"', "lowest = 10, highest = 80")
    )
    assert run(["check", str(tmp_path / "mm.toml"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["warnings"]
    assert {share for text, share in told.items() if "larger than any rock" in text} == {1.0}


@pytest.mark.parametrize(
    ("command", "flag"),
    [
        (("predict", "sample.csv", "--unit", "2=N"), "--unit"),
        (("predict", "sample.csv", "--set", "channels.3.gain=2"), "channels of the site"),
        (("calibrate", "sample_acceleration.csv", "--scene", "caving", "-ox.toml", "--set", "drift=9"), "--set drift"),
    ],
)
def test_an_error_names_the_option_that_caused_it(
    command: tuple[str, ...], flag: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(Path(__file__).parents[1] / "datasets")
    assert run([*command]) == 65
    assert flag in capsys.readouterr().err


def test_one_bad_file_does_not_hide_the_others(bad_files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(bad_files / name) for name in ("empty.csv", "good.csv", "none.csv")]
    assert run(["predict", *files, "--json"]) == 65
    out, err = capsys.readouterr()
    assert {json.loads(line)["source"] for line in out.splitlines()} == {files[1]}
    assert err.count("cgid: error: ") == 2


def test_real_shock(real_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(real_data / "shock" / "acc_base_a0.txt")
    assert run(["features", file, "--json", "--features", "peak_force,width_10"]) == 0
    (row,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    # 486 g, above a baseline of -1.1 g.
    assert 478 <= row["features"]["peak_acceleration"] <= 487.2
    assert 0.39e-3 <= row["features"]["width_10"] <= 0.41e-3
    assert row["sampling_rate_hz"] == pytest.approx(49_993, abs=1)
    assert run(["predict", file, "--model", str(ROOT / "models" / "default.npz")]) == 65
    assert "mass=KG" in capsys.readouterr().err
    assert run(["predict", file, "--set", "mass=1.5", "--json"]) == 0
    row = json.loads(capsys.readouterr().out.splitlines()[0])
    assert row["in_training_range"] is False  # neither at 50 kHz nor by its novelty
    assert row["label"] in ("coal", "gangue", "unknown")


def test_internal_errors_are_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import cgid.identification.model.model as module

    def broken(*_: object) -> None:
        raise RuntimeError("two\nlines")

    monkeypatch.setattr(module.StoredModel, "probabilities", broken)
    assert run(["predict", "--sample"]) == 70
    assert capsys.readouterr().err.count("\n") == 1


def test_closed_pipe_is_no_error() -> None:
    command = f"{sys.executable} -m cgid predict --sample --json | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("command", "code", "n_lines", "says"),
    [
        ("predict --sample >&-", 74, 1, "standard output is closed"),
        ("predict --sample --json >&-", 74, 1, "standard output is closed"),
        ("check --list >&-", 74, 1, "standard output is closed"),
        ("predict --help >&-", 74, 1, "standard output is closed"),
        ("predict --sample -o - >&-", 74, 1, "standard output is closed"),
        ("predict --sample -o {folder}/rows.csv >&-", 0, 2, "wrote"),
        ("tap {folder}/none.csv -o {folder}/modes.csv >&-", 66, 1, "none.csv"),
        ("label datasets/sample.csv -o {folder}/labels.csv >&-", 74, 2, "standard output is closed"),
        ("predict - <&-", 66, 1, "stdin: the standard input must be open"),
        ("monitor - <&-", 66, 1, "stdin: the standard input must be open"),
    ],
)
def test_closed_streams_are_no_crash(command: str, code: int, n_lines: int, says: str, tmp_path: Path) -> None:
    """An answer that goes nowhere is no success; with a file for it, or another output, a closed stdout is."""
    command = f"{sys.executable} -m cgid {command.format(folder=tmp_path)}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    assert says in done.stderr and done.stderr.count("\n") == n_lines


#: Commands that write what they read; `{}` are names of the same file.
OVER_INPUTS = (
    ("features r.csv -o {}", "r.csv"),
    ("predict r.csv -o {}", "r.csv"),
    ("predict - -o {}", "r.csv"),
    ("events r.csv -o {}", "r.csv"),
    ("tap r.csv -o {}", "r.csv"),
    ("tap r.csv --taps taps.csv -o {}", "taps.csv"),
    ("predict r.csv --report {}", "r.csv"),
    ("plot r.csv -o {}", "r.csv"),
    ("calibrate r.csv --scene scene.toml -o {}", "scene.toml"),
    ("calibrate r-modes.csv --scene tail_beam -o r.toml", "r-modes.csv"),
    ("calibrate r.csv --scene scene.toml -o my.toml", "my-modes.csv"),
    ("generate scene.toml --parameters-only -n 9 -o {}", "scene.toml"),
    ("generate scene.toml --parameters-only -n 9 -o {}", "my-modes.csv"),
    ("train m.csv -o {}", "a.npz"),
    ("train m.csv -o {}", "m.csv"),
    ("train labelled -o {}", "labelled/coal/a.npz"),
    ("train m.csv --from base.npz -o {}", "base.npz"),
    ("export data.h5 -o {}", "data.h5"),
    ("export folder -o {}", "folder/shard-00000.h5"),
    ("export-model base.npz --to c -o {}", "base.npz"),
    ("monitor r.csv --live {}", "r.csv"),
)


@pytest.mark.parametrize(("command", "victim"), OVER_INPUTS)
@pytest.mark.parametrize("way", ["itself", "../", "symlink", "hard link", "absolute"])
def test_no_command_writes_over_what_it_reads(
    command: str, victim: str, way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Refused before any work, so the files need no content."""
    monkeypatch.chdir(tmp_path)
    for folder in ("folder", "labelled/coal", "labelled/gangue"):
        Path(folder).mkdir(parents=True)
    for name in ("r.csv", "taps.csv", "r-modes.csv", "my-modes.csv", "base.npz", "data.h5", "folder/shard-00000.h5"):
        Path(name).write_text("0,1\n")
    for name in ("a.npz", "labelled/coal/a.npz", "labelled/gangue/b.npz"):
        np.savez(name, x=np.zeros(9))
    Path("m.csv").write_text("path,label\na.npz,coal\n")
    Path("scene.toml").write_text(f'description = "{"long " * 99}"\n[tail_beam]\nmodes = "my-modes.csv"\n')
    path = Path(victim)
    name = victim
    if "link" in way:
        name = f"other{path.suffix}"
        (Path(name).symlink_to if way == "symlink" else Path(name).hardlink_to)(path)
    elif way == "../":
        name = f"../{tmp_path.name}/{victim}"
    elif way == "absolute":
        name = str(path.absolute())
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    known = os.fstat
    monkeypatch.setattr("os.fstat", lambda number: known(number) if number else Path("r.csv").stat())  # stdin
    for overwrite in [[], ["--overwrite"]] if "monitor" not in command else [[]]:
        assert run([*command.format(name).split(), *overwrite]) == 73
        said = capsys.readouterr().err
        assert "must not be one of the inputs" in said and said.count("\n") == 1
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize("scene", ["reference", "small.toml"])
def test_a_dataset_may_bear_the_name_of_its_scene(
    scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As in the tutorial: the name is no input, only the file and its tables are."""
    monkeypatch.chdir(tmp_path)
    text = (
        path_of("datasets", "reference.toml").read_text().replace('name = "reference"', f'name = "{Path(scene).stem}"')
    )
    Path("small.toml").write_text(text)
    command = ["generate", scene, "-n", "5", "-o", Path(scene).stem]
    for more in [], ["--resume"], ["--overwrite"]:
        assert run([*command, *more]) == 0, capsys.readouterr().err


def test_every_option_that_writes_is_known_to_the_check_of_inputs() -> None:
    """By the help text, which begins with the verb; `tap --scene` says what is written, not where."""
    for command in cli.commands.values():
        for option in command.params:
            text = getattr(option, "help", None) or ""
            names_a_file = isinstance(option.type, click.types.StringParamType)
            if text.startswith(("Write", "Plot the", "Show waveform")) and names_a_file and option.name != "scene_name":
                assert isinstance(option.type, OutputName), (command.name, option.name)


def test_predict_imports_nothing_heavy() -> None:
    code = (
        "import sys; from cgid.cli.main import run; run(['predict', '--sample']); "
        "heavy = ('numba', 'sklearn', 'pandas', 'scipy', 'matplotlib', 'numpy.ma'); "
        "print([x for x in heavy if x in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.splitlines()[-1] == "[]"
