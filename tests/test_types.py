"""What a user of the package writes and an editor offers: mypy checks this file with --strict, and pytest runs it.

`assert_type` fails where a public name has no type of its own, as all had while they were `object`.
"""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import assert_type

import numpy as np
import pytest
from numpy.typing import NDArray

import cgid
from cgid.identification.prediction.monitor import News
from cgid.identification.prediction.settings import GivenSettings, PredictionSettings

ROOT = Path(__file__).parents[1]


def test_a_user_of_physics() -> None:
    coal = cgid.Material(density=1400.0, youngs_modulus=3e9, poisson_ratio=0.3)
    ball = cgid.Sphere(material=coal, radius=0.02)
    law: cgid.HuntCrossley = cgid.HuntCrossley(restitution=0.5, law="lee-wang")
    plate = cgid.ThinPlate(material=cgid.physics.STEEL, thickness=0.03)
    for target in (cgid.RIGID, cgid.HalfSpace(material=cgid.physics.STEEL), plate):
        impact = cgid.Impact(sphere=ball, target=target, velocity=2.0, stiffness="hertz", dissipation=law)
        assert_type(impact, cgid.Impact)
        assert_type(impact.restitution, NDArray[np.float64])
        assert impact.force(np.linspace(0.0, 1e-3, 50)).max() > 0
    laws: list[cgid.physics.Law] = [cgid.Elastic(), cgid.Viscoelastic(time_constant=1e-6)]
    assert [one.name for one in laws] == ["elastic", "kuwabara-kono"]


def test_a_user_of_recordings() -> None:
    path, model = ROOT / "datasets" / "sample.csv", cgid.load_model()
    assert_type(model, cgid.Model)
    assert_type(model.labels, tuple[str, ...])
    signals = cgid.read_recording(path)
    assert_type(signals, list[cgid.Signal])
    assert_type(cgid.find_impacts(signals[0]), list[cgid.identification.detection.Event])
    recording = cgid.open_recording(path)
    assert_type(recording, cgid.recordings.RecordingFile)
    answers = cgid.identify_recording(recording, model)
    assert_type(answers, Iterator[cgid.identification.prediction.Answer])
    assert [answer.label for answer in answers] == list(cgid.predict(path)["label"])
    detector = cgid.ImpactDetector(signals[0].sampling_rate, kind="pulse")
    assert_type(detector.feed(signals[0].samples[None]), list[cgid.identification.detection.Event])


def test_settings_have_names_that_checkers_know() -> None:
    """Under mypy --strict an ignored error that is none fails: each `type: ignore` here is a refusal."""
    path, two = ROOT / "datasets" / "sample.csv", np.zeros((9000, 2))
    table = cgid.predict(path, costs={"gangue": 3.0}, invert=False, lines=None, dead_time=2e-3)
    assert len(table) == 6
    settings = cgid.identification.prediction.PredictionSettings(coal_until=30.0, coverage=0.9, hold=5.0)
    assert all(one.prediction_set is not None for one in cgid.identify_recording(path, cgid.load_model(), settings))
    refused = (
        lambda: cgid.predict(path, coverag=0.9),  # type: ignore[call-arg]
        lambda: cgid.predict(path, coverage="0.9"),  # type: ignore[arg-type]
        lambda: cgid.predict(3.5, 25600.0, "N"),  # type: ignore[arg-type]
        lambda: cgid.predict(two, 25600.0, "N", same_beam=12),  # type: ignore[arg-type]
        lambda: cgid.identify_recording(path, cgid.load_model(), coverage=0.9),  # type: ignore[call-arg]
        lambda: cgid.identification.prediction.PredictionSettings(coal_untill=30.0),  # type: ignore[call-arg]
        lambda: cgid.Monitor(25600.0, 1, "m/s^2", coal_untill=30.0),  # type: ignore[call-arg]
        lambda: cgid.Monitor(25600.0, 1, "m/s^2", coal_until="half an hour"),  # type: ignore[arg-type]
    )
    for call in refused:
        with pytest.raises((cgid.errors.CgidError, TypeError), match=r"coverag|samples|same_beam|coal_until"):
            call()
    with cgid.Monitor(25600.0, 1, "m/s^2", coal_until=30.0, share_time=20.0, coverage=None) as watch:
        assert_type(watch.feed(np.zeros(5)), News)
    assert GivenSettings.__annotations__.keys() == PredictionSettings.__dataclass_fields__.keys()


def test_refusals_name_the_setting_as_it_was_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from cgid.cli.main import run

    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(0, 1, 4000))
    path = tmp_path / "a.npy"
    for keyword, flag, given, options in (
        ("sampling_rate=HZ", "--rate HZ", {}, []),
        ("unit='N'", "--unit N", {"sampling_rate": 25600.0}, ["--rate", "25600"]),
        (
            "sensitivity='",
            "--set sensitivity=",
            {"sampling_rate": 25600.0, "unit": "V"},
            ["--rate", "25600", "--unit=V"],
        ),
    ):
        with pytest.raises(cgid.errors.MissingOption) as error:
            cgid.predict(path, **given)
        assert keyword in str(error.value) and "--" not in str(error.value)
        assert run(["predict", str(path), *options]) == 2
        assert flag in capsys.readouterr().err
    with pytest.raises(cgid.errors.InvalidValue, match="give coal_until"):
        cgid.identification.prediction.PredictionSettings(cycle_pause=30.0)


#: Whole commands, which are the same for whoever reads them.
COMMAND, FLAG = re.compile(r"cgid [a-z-]+\b[^;,]*"), re.compile(r"(?<![\w-])--[a-z][a-z-]+")
#: What a command line alone runs, and the table of its options.
OF_COMMANDS = ("cli/", "labelling/", "_lib/spelling.py")


def test_no_message_of_python_names_an_option() -> None:
    """Messages name settings by `cgid._lib.spelling.spelled`, so Python's keyword in Python."""
    for path in sorted((ROOT / "cgid").rglob("*.py")):
        content, name = path.read_text(encoding="utf-8"), path.relative_to(ROOT / "cgid").as_posix()
        if name.startswith(OF_COMMANDS) or not FLAG.search(content):
            continue
        tree = ast.parse(content)
        ignored = {id(one.value) for one in ast.walk(tree) if isinstance(one, ast.Expr)}  # docstrings
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                ignored |= {id(one) for one in node.values}
                text = "".join(str(getattr(one, "value", "")) for one in node.values if isinstance(one, ast.Constant))
            else:
                text = str(getattr(node, "value", "")) if isinstance(node, ast.Constant) else ""
            is_word = FLAG.fullmatch(text)  # of a command that is printed or run
            assert id(node) in ignored or is_word or not FLAG.search(COMMAND.sub("", text)), (name, text)


@pytest.mark.parametrize(
    ("call", "keyword", "command", "option"),
    [
        ("open_recording('a.npz', sampling_rate=9e3)", "variable=NAME", "info a.npz --rate 9000", "variable=NAME"),
        ("open_recording('a.npy', sampling_rate=9e3, channel=3)", "by channel", "info a.npy --channel 3", "--channel"),
        (
            "read_recording('a.csv', sampling_rate=9e3)",
            "skip_broken=True",
            "predict a.csv --rate 9000",
            "--set skip_br",
        ),
        ("load_model().save('a.npz')", "overwrite=True", "export-model a.npz --to c -o a.c", "--overwrite"),
        ("open_recording('.')", "cgid.Dataset(PATH)[0]", "predict . --set index=9", "index"),
        (
            "load_scene('a.toml')",
            "cgid.physics.add_laws(MODULE)",
            "check a.toml",
            "laws=MODULE",
        ),
    ],
)
def test_refusals_are_those_of_their_caller(
    call: str,
    keyword: str,
    command: str,
    option: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from cgid.cli.main import run

    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", p=np.zeros(4000), q=np.zeros(4000))
    np.save("a.npy", np.zeros((4000, 2)))
    Path("a.csv").write_text("force [N]\n" + "1.5\n" * 300 + "broken line\n" + "2.5\n" * 9, encoding="utf-8")
    Path("a.c").touch()
    Path("a.toml").write_text('[impact]\ndissipation = "x"\n', encoding="utf-8")
    with pytest.raises(cgid.errors.CgidError) as error:
        eval(f"cgid.{call}", {"cgid": cgid})
    assert keyword in str(error.value) and not FLAG.search(str(error.value))
    assert run(command.split()) != 0
    assert option in capsys.readouterr().err


def test_a_user_of_scenes() -> None:
    scene = cgid.load_scene("reference")
    assert_type(scene, cgid.Scene)
    batches = cgid.synthesise(scene, 8)
    assert_type(batches, Iterator[cgid.Batch])
    for batch in batches:
        assert batch.signals.shape[0] == len(cgid.extract(batch.signals, batch.sampling_rate, ["peak_force"]))
        cgid.fft_filter(batch.signals, batch.sampling_rate, high=20e3)
    assert_type(cgid.stream(scene, n_signals=8), cgid.learning.TrainingStream)
    learners = cgid.ImpactFeatures(200e3), cgid.ImpactClassifier()
    assert_type(learners, tuple[cgid.ImpactFeatures, cgid.ImpactClassifier])
    training = cgid.train_on_specimens(cgid.synthesise(scene, 2048), features=["peak_force", "contact_duration"])
    assert_type(training, cgid.identification.training.Training)
    assert_type(training.model, cgid.Model)
    with pytest.raises(cgid.errors.CgidError, match="absent"):
        cgid.Dataset("absent.h5")


def test_types_are_those_of_what_is_loaded() -> None:
    """The imports that a type checker sees, against the objects that a user gets."""
    checked: dict[str, str] = {}
    *imports, version = ast.parse(Path(cgid.__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    assert ast.unparse(version) == "__version__: str"
    for node in imports:
        assert isinstance(node, ast.ImportFrom)
        for one in node.names:
            assert one.asname == one.name  # else a type checker hides it
            checked[one.name] = f"{node.module}"
    assert checked.keys() == set(dir(cgid)) - {"__version__"}
    for name, home in checked.items():
        assert getattr(cgid, name) is getattr(importlib.import_module(home), name)


def test_public_modules_need_no_import_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_extensions"))
    pytest.importorskip("numpydoc")
    pages = importlib.import_module("api_pages").PAGES
    described = {module.split(".")[1] for _, modules in pages.values() for module in modules if "." in module}
    modules = set(dir(cgid)) - set(vars(cgid)["__all__"])
    assert modules == described | {"errors"}
    for package, names in ((cgid, modules), *((one, dir(one)) for one in (cgid.identification, cgid.measure))):
        for name in names:  # not by attribute, which is there once a module is loaded
            module = importlib.import_module(f"{package.__name__}.{name}")
            assert vars(package)["__getattr__"](name) is module
    written = (
        "import cgid; cgid.measure.modal.Modes, "
        "cgid.learning.TrainingStream, cgid.calibration.calibrated, cgid.physics.Impact"
    )
    subprocess.run([sys.executable, "-c", written], check=True)


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("cgid.pre", "predict"),
        ("cgid.learning.Train", "TrainingStream"),
        ("cgid.load_model().lab", "labels"),
        ("cgid.predict(samples, same_b", "same_beam="),
        ("cgid.predict(samples, cover", "coverage="),
        ("cgid.identification.prediction.PredictionSettings(coal_", "coal_until="),
        ("cgid.open_recording('a.csv').chan", "channels"),
        ("cgid.Impact().peak_f", "peak_force"),
        ("cgid.train_on_specimens([]).model.sampl", "sampling_rates"),
    ],
)
def test_an_editor_completes(typed: str, offered: str) -> None:
    jedi = pytest.importorskip("jedi")
    lines = ["import cgid", typed]
    found = jedi.Script("\n".join(lines), project=jedi.Project(ROOT)).complete(2, len(typed))
    assert offered in {one.name_with_symbols for one in found}
