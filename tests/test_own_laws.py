"""Contact laws of one's own: against scipy and a built-in law, in scenes and worker processes, and bad ones."""

from __future__ import annotations

import re
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

from benchmarks.impact import own_laws as referee
from cgid.cli.main import run
from cgid.errors import BadData, CannotCreate, InvalidValue
from cgid.physics import (
    STEEL,
    YANG2018_SPHERES,
    Elastic,
    HalfSpace,
    HuntCrossley,
    Impact,
    Law,
    Material,
    ModalImpact,
    Sphere,
    ThinPlate,
    Thornton,
    add_laws,
)
from cgid.physics.contact import own_laws
from cgid.physics.contact.curves import MAX_WEIGHT
from cgid.recordings import open_recording
from cgid.recordings.formats import outside_formats
from cgid.scene import generate, generate_recordings, synthesise
from cgid.scene.file import schema
from cgid.shipped import path_of
from tests.plan_scenes import POPULATION, scene_of

ROOT = Path(__file__).parents[1]
#: The law of the how-to page.
CONE = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "how-to" / "laws.md").read_text(), re.DOTALL)[0]


@pytest.fixture
def cone(tmp_path, monkeypatch):
    """Return the path of a module with the cone, known to scenes until the test ends."""
    monkeypatch.setattr(own_laws, "_own", {})
    path = tmp_path / "cone.py"
    path.write_text(CONE)
    add_laws(str(path))
    return path


def coal(law, velocity=2.0, target=None, **more):
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025), target=target or HalfSpace(material=STEEL),
        velocity=velocity, stiffness="hertz", dissipation=law, **more,
    )  # fmt: skip


def scene_of_cones():
    return scene_of({"dissipation": "cone"}, {"restitution": 0.5}, {})


def law_with(**verbs):
    return type(
        "Made", (Law,), {name: staticmethod(verb) if callable(verb) else verb for name, verb in verbs.items()}
    )()


def test_a_cone_agrees_with_scipy(cone):
    impact = coal(own_laws.own_law("cone").law(restitution=0.5))
    slope = 2 / np.pi * float(impact.reduced_modulus) * np.tan(np.radians(70))
    mass = float(impact.reduced_mass)
    chi = 1.4327505332713752 / 2.0  # D of e = .5 over the speed: any spring that only stiffens restores alike

    def held(time, state):
        return state[0] if time > 0 else 1.0

    held.terminal, held.direction = True, -1
    found = solve_ivp(
        lambda _, s: (s[1], -slope * s[0] ** 2 * (1 + chi * s[1]) / mass), (0, 1), (0.0, 2.0), method="DOP853",
        rtol=1e-12, atol=1e-16, first_step=1e-9, events=held, dense_output=True,
    )  # fmt: skip
    assert float(impact.contact_duration) == pytest.approx(found.t[-1], rel=1e-8)
    assert float(impact.restitution) == pytest.approx(-found.y[1, -1] / 2, rel=1e-8)
    times = found.t[-1] * np.linspace(0, 1, 200)
    x, y = found.sol(times)
    exact = np.maximum(slope * x**2 * (1 + chi * y), 0)
    assert np.abs(impact.force(times) - exact).max() < 1e-8 * exact.max()


def test_a_law_with_a_history_is_the_built_in_one_if_it_says_the_same():
    """On a plate with weight, and on modes; compiled and interpreted."""
    verbs = {
        name: staticmethod(njit(error_model="numpy")(getattr(Thornton, name))) for name in ("force", "corner", "turn")
    }
    Own = type("Own", (Thornton,), {"name": "crushing", "__module__": __name__, **verbs})
    plate = ThinPlate(material=STEEL, thickness=0.012)
    for velocity in (2.0, np.linspace(1, 3, 8)):
        own, built_in = (
            coal(law(yield_pressure=41e6, viscous_restitution=0.8), velocity, plate, gravity=9.8)
            for law in (Own, Thornton)
        )
        times = np.linspace(0, 5e-4, 100)
        assert np.abs(own.force(times) - built_in.force(times)).max() < 1e-8 * built_in.peak_force.max()
        on_modes = [
            ModalImpact(
                sphere=one.sphere, target=HalfSpace(material=STEEL), velocity=velocity, stiffness="hertz",
                dissipation=one.dissipation, frequency=[400.0, 3e3], damping_ratio=0.02, compliance=[2.0, 4.0],
            )
            for one in (own, built_in)
        ]  # fmt: skip
        forces = [one.force(times) for one in on_modes]
        assert np.abs(forces[0] - forces[1]).max() < 1e-8 * forces[1].max()


def test_a_scene_of_cones_is_what_its_parameters_say(cone):
    (batch,) = synthesise(scene_of_cones(), 24, dtype="float64")
    drawn = batch.parameters
    rock = Material(**{name: drawn[name] for name in ("density", "youngs_modulus", "poisson_ratio")})
    impact = Impact(
        sphere=Sphere(material=rock, radius=drawn["radius"]), target=scene_of_cones().body, stiffness="hertz",
        velocity=drawn["velocity"], dissipation=own_laws.own_law("cone").law(restitution=0.5),
    )  # fmt: skip
    frames = impact.force_frames(200e3, 2048, drawn["onset"])
    assert np.abs(batch.signals - frames).max() < 1e-7 * frames.max()
    assert drawn["restitution"] == pytest.approx(0.5, abs=1e-8)


def test_a_later_built_in_law_moves_no_number_in_data(cone, monkeypatch):
    numbers = scene_of_cones().law_names
    assert numbers == ("elastic", "hunt-crossley", "thornton", "walton-braun", "kuwabara-kono", "cone")
    monkeypatch.setattr(schema, "DISSIPATIONS", ("newest", *schema.DISSIPATIONS))
    assert scene_of_cones().law_names == numbers


@pytest.mark.long
def test_workers_make_the_same_bytes_and_another_law_is_no_resumption(cone, tmp_path):
    for name, jobs in (("one", 1), ("two", 2)):
        generate(scene_of_cones(), tmp_path / name, 600, jobs=jobs, shard_signals=256)
    sums = [(tmp_path / name / "SHA256SUMS").read_text() for name in ("one", "two")]
    assert sorted(sums[0].splitlines()) == sorted(sums[1].splitlines())
    next((tmp_path / "one").glob("*.h5")).unlink()
    cone.write_text(cone.read_text() + "# edited")
    add_laws(str(cone))
    with pytest.raises(CannotCreate):
        generate(scene_of_cones(), tmp_path / "one", 600, shard_signals=256, resume=True)


def test_a_scene_with_a_law_that_is_not_there_is_refused_by_name(monkeypatch):
    monkeypatch.setattr(own_laws, "_own", {})
    with pytest.raises(BadData, match=r"got 'cone'; .* cgid\.physics\.add_laws\(MODULE\)"):
        scene_of_cones()


def test_a_law_takes_the_shape_of_a_population_or_its_own_default(cone):
    keys = 'exponent: float = 1.7\n    keys = ("exponent", "restitution")'
    numbers = "def numbers(self, impact):\n"
    code = CONE.replace('keys = ("restitution",)', keys)
    cone.write_text("seen = []\n" + code.replace(numbers, f"{numbers}        seen.append(self.exponent)\n"))
    add_laws(cone)
    seen = sys.modules[own_laws.own_law("cone").law.__module__].seen
    populations = [POPULATION | {"label": "a"}, POPULATION | {"label": "b", "exponent": 2.0}]
    scene = scene_of({"dissipation": "cone"}, populations=populations)
    seen.clear()
    for _ in synthesise(scene, 30):
        pass
    assert set(np.concatenate([np.ravel(one) for one in seen])) == {1.7, 2.0}


def test_signals_on_disk_need_no_law(cone, tmp_path, monkeypatch):
    populations = [POPULATION | {"label": label, "restitution": e} for label, e in (("a", 0.3), ("b", 0.8))]
    generate(scene_of({"dissipation": "cone"}, populations=populations), tmp_path / "cones", 300, shard_signals=100)
    monkeypatch.setattr(own_laws, "_own", {})
    command = ["train", str(tmp_path / "cones"), "-o", str(tmp_path / "m.npz"), "--family", "linear"]
    assert run([*command, "--features", "peak_force,impulse"]) == 0
    assert run(["predict", str(tmp_path / "cones"), "--model", str(tmp_path / "m.npz")]) == 0


# ---- bad laws -------------------------------------------------------------------------------------------------------


def raises(p, history, w):
    if w > 0.3:
        raise ValueError("too deep")
    return w * w * w, 0.0


def ends(impact):
    raise SystemExit(0)


SPRING = njit(lambda p, history, w: (w * w * w, 0.0))


@pytest.mark.parametrize(
    ("verbs", "message"),
    [
        ({"force": lambda p, history, w: (w, 0.0)}, "compiled"),
        ({"force": njit(lambda p, w: (w, 0.0))}, "compile"),
        ({"force": njit(lambda p, history, w: w)}, "return"),
        ({"force": njit(lambda p, history, w: (w, 0.0)), "turn": njit(lambda p, history: 0.0)}, "turn"),
        ({"force": njit(lambda p, history, w: (np.nan, 0.0))}, "finite"),
        ({"force": njit(lambda p, history, w: (w * w * w * np.nan if w > 0.5 else w * w * w, 0.0))}, "finite|end"),
        ({"force": njit(raises)}, "too deep"),
        ({"force": njit(lambda p, history, w: (0.0, 0.0))}, "end within"),
        ({"force": njit(lambda p, history, w: (-w, 0.0))}, "below 0"),
        ({"force": njit(lambda p, history, w: (w * w, 0.3))}, "pulls = True"),
        ({"force": njit(lambda p, history, w: (w**3 - 0.3 * w, 0.0)), "pulls": True}, "below 0"),
        ({"force": njit(referee._dip)}, "below 0"),
        ({"force": njit(lambda p, history, w: (w**3, -0.5 * w**3))}, "energy"),
        ({"force": njit(lambda p, history, w: (w**3, 0.0)), "turn": njit(referee._outwards)}, "energy"),
        ({"force": njit(lambda p, history, w: (w**3, 0.0)), "turn": njit(referee._torn)}, "approach"),
        ({"force": njit(lambda p, history, w: (p[0] * w**3, 0.0))}, "numbers"),
        ({"force": SPRING, "numbers": lambda impact: {"k": np.nan}}, "k of the impact"),
        ({"force": SPRING, "numbers": lambda impact: {"k": np.ones(5)}}, "raised ValueError"),
        ({"force": SPRING, "numbers": ends}, "raised SystemExit"),
        ({"force": SPRING, "closed": lambda impact: 3}, "Curves"),
        ({"force": SPRING, "closed": HuntCrossley(restitution=0.5).closed}, "differ"),
        ({"force": SPRING, "keys": ("restitution", "yield_pressure")}, "share"),
        ({"force": njit(lambda p, history, w: (w, 0.0)), "keys": ("mood",)}, "keys"),
        ({"force": njit(lambda p, history, w: (w, 0.0)), "keys": ("breaking_force",)}, "both breaking_force and"),
        ({"force": njit(lambda p, history, w: (w, 0.0)), "name": "thornton"}, "another name than a built-in law"),
        ({}, "compiled"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("velocity", [2.0, np.linspace(1, 2, 6)], ids=["interpreted", "compiled"])
def test_a_bad_law_ends_with_a_clear_error(verbs, message, velocity):
    with pytest.raises(InvalidValue, match=message) as error:
        coal(law_with(**verbs), velocity)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8, 1e-12])
@pytest.mark.parametrize("depth", [0.2, 0.02, 1e-3])
def test_an_attractive_first_touch_is_refused_at_every_tolerance(depth, tolerance):
    law = law_with(force=njit(lambda p, history, w: (w**3 - depth * w * w, 0.0)))
    with pytest.raises(InvalidValue, match="below 0"):
        coal(law, tolerance=tolerance)


def test_a_law_that_inherits_closed_curves_must_have_their_force():
    Other = type(
        "Other", (Elastic,), {"name": "other", "force": staticmethod(njit(lambda p, history, w: (2.0 * w**3, 0.0)))}
    )
    Same = type("Same", (Elastic,), {"name": "same", "force": staticmethod(SPRING)})
    with pytest.raises(InvalidValue, match="other: closed"):
        coal(Other())
    assert coal(Same(), np.linspace(1, 2, 6)).peak_force == pytest.approx(
        coal(Elastic(), np.linspace(1, 2, 6)).peak_force
    )


def test_a_law_is_named_by_its_module() -> None:
    for wrong in (Elastic, Elastic(), None, b"cone.py"):
        with pytest.raises(
            InvalidValue, match=r"source must be the name of a module, .* got .*; put the law into a file"
        ):
            add_laws(wrong)


EXITS = "raise SystemExit(0)"


def test_a_module_that_ends_the_process_is_an_error(tmp_path, monkeypatch):
    path = tmp_path / "exits.py"
    path.write_text(EXITS)
    with pytest.raises(InvalidValue, match="SystemExit"):
        add_laws(str(path))

    def load(entry):
        exec(EXITS)

    entries = {group: EntryPoints([EntryPoint("exiting", "outside", group)]) for group in ("cgid.laws", "cgid.readers")}
    monkeypatch.setattr(EntryPoint, "load", load)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: entries[group])
    own_laws._find_entry_points.cache_clear()
    with pytest.warns(UserWarning, match="exiting .*SystemExit"):
        assert own_laws.own_law("exiting") is None
    with pytest.warns(UserWarning, match="exiting .*SystemExit"):
        assert outside_formats() == []
    own_laws._find_entry_points.cache_clear()


def test_a_reader_that_ends_the_process_is_an_error(tmp_path, monkeypatch):
    reader = SimpleNamespace(is_format=lambda head: True, read=lambda path, variable: exec(EXITS))
    entries = EntryPoints([EntryPoint("leaving", "outside", "cgid.readers")])
    monkeypatch.setattr(EntryPoint, "load", lambda entry: reader)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: entries)
    (tmp_path / "hit.xyl").write_bytes(b"some samples")
    with pytest.raises(BadData, match="leaving failed"):
        open_recording(tmp_path / "hit.xyl")


# ---- forces that turn attractive, and other laws, against a referee that shares nothing with the package ------------


def test_a_force_that_falls_to_0_ends_the_contact_as_closed_forms_say():
    """Linear dashpots and Tsuji's, at every tolerance and speed; .9020260687 and .5502831696 are known."""
    rows = referee.closed_forms()
    assert [row[2] for row in rows[:4:2]] == pytest.approx([0.9020260687, 0.5502831696], abs=1e-10)
    for name, asked, _, errors in rows:
        for error, tolerance in zip(errors, referee.TOLERANCES, strict=True):
            assert error < max(tolerance, 1e-11), (name, asked, tolerance)
    speeds = coal(referee.tsuji(referee.tsuji_damping(0.5)), np.geomspace(1e-3, 5, 8), gravity=1e-9)
    assert speeds.restitution == pytest.approx(referee.released_restitution(0.5), abs=1e-8)


@pytest.mark.long
@pytest.mark.parametrize("target", referee.TARGETS)
@pytest.mark.parametrize("case", referee.CASES, ids=lambda case: case.name)
def test_laws_hold_or_are_refused_on_every_target(case, target):
    row = referee.judged(case, target)
    if not case.sound:
        assert "contact law Own: " in row.outcome or "end within" in row.outcome
        return
    stays = target == "weight" and case.name in ("Hunt-Crossley, D 50", "spring and dashpot, overdamped")
    assert row.outcome == ("stays" if stays else "held")
    if not stays:
        # Kinks that a law does not declare cost accuracy only.
        assert row.force < 1e-7
        assert row.restitution < 1e-7


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8, 1e-12])
def test_a_heavy_sphere_keeps_its_energy_or_is_refused(tolerance):
    """Without a loss the sphere leaves as it came; a weight of more than `MAX_WEIGHT` would leave it to rounding."""
    unit = float(coal(Elastic(), 1e-3, gravity=1.0).weight)
    gravity = np.geomspace(1, 0.999 * MAX_WEIGHT, 40) / unit
    impact = coal(Elastic(), 1e-3, gravity=gravity, tolerance=tolerance)
    assert impact.restitution == pytest.approx(1, abs=max(3e-8, 0.2 * tolerance))
    with pytest.raises(InvalidValue, match=r"must be at most 10000 .*, got 10100; raise the velocity"):
        coal(Elastic(), 1e-3, gravity=1.01 * MAX_WEIGHT / unit, tolerance=tolerance)


# ---- identity by result ---------------------------------------------------------------------------------------------


@pytest.fixture
def read_cone(cone):
    """Return the file from which the cone's module now reads a factor of its slope."""
    factor = cone.parent / "factor.txt"
    factor.write_text("1.0")
    cone.write_text(
        CONE.replace(
            "slope = ", f"from pathlib import Path\n        slope = float(Path({str(factor)!r}).read_text()) * "
        )
    )
    add_laws(str(cone))
    return factor


def test_a_law_that_has_changed_unnoticed_completes_no_dataset(read_cone, tmp_path):
    output = tmp_path / "data"

    def made():
        return generate(scene_of_cones(), output, 300, shard_signals=100, resume=True)

    whole = {path.name: path.read_bytes() for path in made().glob("*.h5")}
    (output / "shard-00000.h5").unlink()
    assert {path.name: path.read_bytes() for path in made().glob("*.h5")} == whole
    (output / "shard-00001.h5").unlink()
    read_cone.write_text("1.001")
    with pytest.raises(BadData, match=r"shard-00000.h5: its signals must follow.*module of cone"):
        made()
    assert sorted(path.name for path in output.glob("*.h5")) == ["shard-00000.h5", "shard-00002.h5"]
    read_cone.write_text("1.0")
    assert {path.name: path.read_bytes() for path in made().glob("*.h5")} == whole


@pytest.mark.long
def test_a_law_that_has_changed_completes_no_recordings(read_cone, tmp_path):
    scene = scene_of(
        {"dissipation": "cone"}, {"restitution": 0.5}, {}, sampling={"sampling_rate": 51200.0},
        stream={"duration": 1.0, "arrivals": {"rate": 30.0}},
    )  # fmt: skip
    output = generate_recordings(scene, tmp_path / "heard", 2)
    (output / "recording-00001.h5").unlink()
    read_cone.write_text("1.001")
    with pytest.raises(BadData, match=r"recording-00000.h5: its signals must follow"):
        generate_recordings(scene, output, 2, resume=True)
    read_cone.write_text("1.0")
    generate_recordings(scene, output, 2, resume=True)


def test_every_command_that_reads_a_scene_takes_its_laws(
    cone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The error of a scene names the key, so each command has it."""
    text = path_of("datasets", "reference.toml").read_text()
    scene, data = tmp_path / "cones.toml", tmp_path / "cones.h5"
    scene.write_text(text.replace('dissipation = "', 'dissipation = "cone" # "'))
    generate(schema.load_scene(scene), data, 2)
    monkeypatch.setattr(own_laws, "_own", {})
    assert run(["info", str(data)]) == 0
    assert '{"cone": "' in capsys.readouterr().out
    assert run(["predict", str(data)]) == 0
    assert "gangue" in capsys.readouterr().out
    assert run(["info", str(scene), "--set", f"laws={cone}"]) == 0
    assert f"next: cgid check {scene} --set laws={cone}" in capsys.readouterr().out
