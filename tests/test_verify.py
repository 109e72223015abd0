"""What is damaged is found, said, and made again to the bytes it had; an export is the same dataset in one file."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from benchmarks.safety.bit_flips import flipped, judge, small_scene, some, subjects
from cgid.cli.main import run
from cgid.errors import BadData, CannotCreate, NoInput
from cgid.physics.contact import own_laws
from cgid.scene import generate, generate_recordings, parse_scene, plan
from cgid.scene.output.generation import tabulate
from cgid.shipped import path_of
from cgid.store import Dataset, read_table
from cgid.store.dataset import export
from cgid.store.verification import remedy, verify
from tests.test_own_laws import CONE
from tests.test_stream import content

SCENE = small_scene(2048)
#: Signals of 8 kB, of which 64 lie in a chunk.
N, IN_SHARD = 400, 150
STREAM = parse_scene(content(duration="3 s", sensor={"absolute_noise": "10 N"}))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One of everything, whole."""
    folder = tmp_path_factory.mktemp("whole")
    generate(SCENE, folder / "folder", N, 7, shard_signals=IN_SHARD)
    generate(SCENE, folder / "double", N, 7, shard_signals=IN_SHARD, dtype="float64")
    generate(SCENE, folder / "one.h5", N, 7)
    generate_recordings(STREAM, folder / "recordings", 3, seed=3)
    generate_recordings(STREAM, folder / "recording.h5", seed=3)
    for name in ("table.h5", "table.csv"):
        tabulate(plan(SCENE, "closed-form"), folder / name, 9000, 7)
    return folder


@pytest.fixture
def copies(made: Path, tmp_path: Path) -> Path:
    """The same, to be damaged."""
    return Path(shutil.copytree(made, tmp_path / "copies"))


def contents(path: Path) -> dict[str, bytes]:
    files = [path] if path.is_file() else sorted(path.iterdir())
    return {file.name: file.read_bytes() for file in files if file.name != ".lock"}


def flip(file: Path, place: int) -> None:
    damaged = bytearray(file.read_bytes())
    damaged[place] ^= 4
    file.write_bytes(damaged)


def place_of(file: Path, name: str, row: int) -> int:
    """Return where a row of an uncompressed dataset lies in its file, as h5py itself says."""
    with h5py.File(file) as stored:
        dataset = stored[name]
        chunk, inside = divmod(row, dataset.chunks[0])
        found = dataset.id.get_chunk_info_by_coord((chunk * dataset.chunks[0], *[0] * (dataset.ndim - 1)))
        return int(found.byte_offset) + inside * int(np.prod(dataset.shape[1:])) * dataset.dtype.itemsize


def problems(path: Path) -> dict[str, str]:
    return {finding.file.name: finding.problem for finding in verify(path).findings}


def resumed(path: Path) -> bool:
    """Run again, with `resume`, what made a folder of `made`; return whether all is whole."""
    if path.name == "recordings":
        generate_recordings(STREAM, path, 3, seed=3, resume=True)
    else:
        dtype: Any = "float64" if path.name == "double" else "float32"
        generate(SCENE, path, N, 7, shard_signals=IN_SHARD, dtype=dtype, resume=True)
    return not verify(path).findings


# ---- bits and lengths ------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_no_flipped_bit_and_no_length_is_a_silent_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The long form: python benchmarks/safety/bit_flips.py."""
    monkeypatch.setattr("benchmarks.safety.bit_flips.TIME_LIMIT", 300.0)  # however busy the machine is
    for subject in subjects(tmp_path, bits=80, lengths=20, large_bits=25, verified_bits=20):
        outcomes = judge(subject.file, subject.read, subject.damages)
        assert outcomes.total() == len(subject.damages)
        assert set(outcomes) <= subject.sound, subject.name
        assert outcomes["refused"] > 5


def test_a_long_scene_is_held_against_its_sha256(tmp_path: Path) -> None:
    scene = json.loads(SCENE.text)
    scene["populations"][0]["density"] = {"distribution": "choice", "values": [float(k) for k in range(1, 9001)]}
    path = generate(parse_scene(scene), tmp_path / "long.h5", 5)
    assert Dataset(path).header.attributes["scene"] == parse_scene(scene).text
    flip(path, path.read_bytes().index(b"4321.0"))
    with h5py.File(path) as file:
        assert b"4321.0" not in file.attrs["scene"]
    with pytest.raises(BadData, match="text of the scene must fit scene_sha256"):
        Dataset(path)


@pytest.mark.parametrize("name", ["table.csv", "table.parquet"])
def test_a_flipped_bit_of_a_table(tmp_path: Path, name: str) -> None:
    """The numbers of CSV have no checksum, nor have some bytes of Parquet that only tell how it was packed."""
    path = tmp_path / name
    tabulate(plan(SCENE, "closed-form"), path, 50, 7)
    whole, content = read_table(path), path.read_bytes()
    end = content.index(b"\n") if name == "table.csv" else len(content)
    found = 0
    for damage in some(8 * end, 120):
        path.write_bytes(flipped(content, damage))
        try:
            table = read_table(path)
        except BadData:
            found += 1
            continue
        assert table.header == whole.header
        assert table.labels.tolist() == whole.labels.tolist()
        for column in whole.columns:
            np.testing.assert_array_equal(table.columns[column], whole.columns[column])
    assert found > 60


# ---- what is found ---------------------------------------------------------------------------------------------------


def test_damaged_rows_are_those_of_the_chunk(copies: Path) -> None:
    for file, row, says in (("one.h5", 100, "signals 64 to 127"), ("one.h5", 130, "signals 64 to 127, 128 to 191")):
        flip(copies / file, place_of(copies / file, "signals", row))
        (finding,) = verify(copies / file).findings
        assert finding.what == f"{copies / file}: {says} do not fit their checksum"
    flip(copies / "table.h5", place_of(copies / "table.h5", "specimen", 5000))
    table = copies / "table.h5"
    assert verify(table).findings[0].what == f"{table}: specimen 4096 to 8191 do not fit their checksum"


def test_everything_wrong_with_a_folder_is_named(copies: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = copies / "folder"
    (folder / "shard-00000.h5").unlink()
    flip(folder / "shard-00001.h5", place_of(folder / "shard-00001.h5", "signals", 3))
    flip(folder / "shard-00002.h5", -1)
    (folder / "notes.txt").write_text("mine")
    (folder / ".shard-00001.h5.0123456789ab.part").write_bytes(b"half")
    assert problems(folder) == {
        "shard-00000.h5": "missing",
        "shard-00001.h5": "damaged",
        "shard-00002.h5": "damaged",
        ".shard-00001.h5.0123456789ab.part": "leftover",
        "notes.txt": "foreign",
    }
    assert len(verify(folder).damage) == 3
    # Each names its file once, also in the lines that are printed.
    findings = verify(folder).findings
    assert all(finding.what.startswith(f"{finding.file}: ") for finding in findings)
    assert run(["verify", str(folder)]) == 65
    _, *lines = capsys.readouterr().out.splitlines()
    assert lines == [f"  {finding.problem}: {finding.what}" for finding in findings]
    assert all(line.count(str(finding.file)) == 1 for line, finding in zip(lines, findings, strict=True))


def test_an_unfinished_run_says_how_far_it_has_come(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def stop(_count: int) -> None:
        if (tmp_path / "data" / "shard-00001.h5").exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(small_scene(), tmp_path / "data", 4096, 7, shard_signals=256, progress=stop)
    (finding,) = verify(tmp_path / "data").damage
    assert finding.problem == "unfinished"
    assert "of 16" in finding.what and "--resume" in finding.what
    assert run(["verify", str(tmp_path / "data")]) == 65
    assert "--resume" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["description.json", "shard-00001.h5", "SHA256SUMS"])
def test_what_one_may_not_read_is_not_called_damaged_and_stays(
    copies: Path, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, unpatched = copies / "folder", Path.open
    before = contents(folder)

    def refused(self: Path, *arguments: Any, **options: Any) -> Any:
        if self == folder / name:  # as the kernel says it to those who are not root
            raise PermissionError(13, "Permission denied")
        return unpatched(self, *arguments, **options)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", refused)
        assert run(["verify", str(folder)]) == 66
        said = capsys.readouterr().err
        assert name in said and "overwrite" not in said
        if name == "description.json":
            with pytest.raises((NoInput, CannotCreate)):
                generate(SCENE, folder, N, 7, shard_signals=IN_SHARD, resume=True)
    assert contents(folder) == before


# ---- what is made again ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["folder", "double"])
def test_shards_are_made_again_byte_for_byte(made: Path, copies: Path, name: str) -> None:
    folder = copies / name
    (folder / "shard-00000.h5").unlink()
    (folder / "shard-00001.h5").write_bytes((folder / "shard-00001.h5").read_bytes()[:5000])
    whole = resumed(folder)
    flip(folder / "shard-00002.h5", 4000)
    times = {file.name: file.stat().st_mtime_ns for file in folder.glob("*.h5")}
    assert whole and resumed(folder)
    assert contents(folder) == contents(made / name)
    again = {name for name, time in times.items() if (folder / name).stat().st_mtime_ns != time}
    assert again == {"shard-00002.h5"}


@pytest.mark.parametrize("change", ["flip", "another folder", "gone"])
def test_sums_that_are_wrong_make_nothing_again(made: Path, copies: Path, change: str) -> None:
    folder = copies / "folder"
    sums, times = folder / "SHA256SUMS", {file: file.stat().st_mtime_ns for file in folder.glob("*.h5")}
    if change == "flip":  # in the sum of the description, so that all are void
        flip(sums, 3)
    elif change == "gone":
        sums.unlink()
    else:
        sums.write_bytes((copies / "double" / "SHA256SUMS").read_bytes())
    assert problems(folder) == {"SHA256SUMS": "missing" if change == "gone" else "damaged"}
    assert resumed(folder)
    assert contents(folder) == contents(made / "folder")
    assert {file: file.stat().st_mtime_ns for file in folder.glob("*.h5")} == times


# ---- sums ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["folder", "recordings"])
def test_damaged_sums_are_found_and_written_again(made: Path, copies: Path, name: str) -> None:
    sums = copies / name / "SHA256SUMS"
    for damage in (lambda: flip(sums, 67), lambda: sums.write_bytes(sums.read_bytes()[:-30])):
        damage()
        assert problems(copies / name) == {"SHA256SUMS": "damaged"}
        assert resumed(copies / name)
        assert contents(copies / name) == contents(made / name)


def test_another_recorded_background_makes_nothing_again(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "hum.csv", np.sin(np.arange(5000)), header="force [N]", comments="")
    scene = json.loads(small_scene().text)
    recorded = {"path": "hum.csv", "signal_to_noise": "20 dB", "sampling_rate": "100 kHz"}
    loaded = parse_scene({**scene, "background": {"recorded": recorded}}, folder=tmp_path)
    path = generate(loaded, tmp_path / "data", 300, 7)
    before = contents(path)
    flip(path / "shard-00000.h5", place_of(path / "shard-00000.h5", "signals", 9))
    shutil.copy(tmp_path / "hum.csv", tmp_path / "kept.csv")
    np.savetxt(tmp_path / "hum.csv", np.cos(np.arange(5000)), header="force [N]", comments="")
    with pytest.raises(CannotCreate, match="background_sha256"):
        generate(loaded, path, 300, 7, resume=True)
    shutil.copy(tmp_path / "kept.csv", tmp_path / "hum.csv")
    generate(loaded, path, 300, 7, resume=True)
    assert contents(path) == before


# ---- export ----------------------------------------------------------------------------------------------------------


def test_an_export_of_what_is_damaged_leaves_nothing(copies: Path, tmp_path: Path) -> None:
    (tmp_path / "all.h5").write_bytes(b"old")
    shard = copies / "folder" / "shard-00002.h5"
    flip(shard, place_of(shard, "signals", 3))
    with pytest.raises(BadData, match=r"shard-00002\.h5"):
        export(copies / "folder", tmp_path / "all.h5", overwrite=True)
    assert (tmp_path / "all.h5").read_bytes() == b"old"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["all.h5", "copies"]


# ---- the commands ----------------------------------------------------------------------------------------------------


def test_verify_names_the_command_that_makes_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Run as it is printed, it makes the damaged and the missing shard and no other, to the same bytes."""
    (tmp_path / "foreign").mkdir()
    monkeypatch.chdir(tmp_path / "foreign")
    folder, single = Path("../a folder"), Path("../one.h5")
    made = "generate reference -n 300 --seed 3 --set dtype=float64 --set shard_signals=100 -o"
    assert run([*made.split(), str(folder)]) == 0
    assert run(["generate", "reference", "-n", "20", "--seed", "3", "-o", str(single)]) == 0
    before, single_before = contents(folder), single.read_bytes()
    (folder / "shard-00002.h5").unlink()
    flip(folder / "shard-00001.h5", 20_000)
    flip(single, place_of(single, "signals", 3))
    times = (folder / "shard-00000.h5").stat().st_mtime_ns
    capsys.readouterr()
    assert run(["verify", str(folder), str(single), "--json"]) == 65
    out, err = capsys.readouterr()
    first, second = (json.loads(line) for line in out.splitlines())
    assert (first["whole"], second["whole"]) == (False, False)
    found = {Path(finding["file"]).name: finding["problem"] for finding in first["findings"]}
    assert found == {"shard-00001.h5": "damaged", "shard-00002.h5": "missing"}
    assert second["findings"][0]["what"] == f"{single}: signals 0 to 19 do not fit their checksum"
    commands = [shlex.split(line.partition("cgid ")[2]) for line in re.findall("make it again: (.*)", err)]
    assert [words[-1] for words in commands] == ["--resume", "--overwrite"]
    assert all(run(words) == 0 for words in commands)
    capsys.readouterr()
    assert contents(folder) == before and single.read_bytes() == single_before
    assert (folder / "shard-00000.h5").stat().st_mtime_ns == times
    assert run(["verify", str(folder)]) == 0
    assert capsys.readouterr().out == f"{folder}: dataset of 4 files, whole\n"


def test_the_remedy_says_which_file_the_scene_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A dataset knows the name in its scene, not that of the file, which `generate` needs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(own_laws, "_own", {})
    text = path_of("datasets", "reference.toml").read_text().replace('name = "reference"', 'name = "slope"')
    Path("mine.toml").write_text(text.replace('dissipation = "', 'dissipation = "cone" # "'))
    Path("cone.py").write_text(CONE)
    assert run(["generate", "mine.toml", "-n", "5", "-o", "own", "--set", "laws=cone.py"]) == 0
    before = contents(Path("own"))
    flip(Path("own/shard-00000.h5"), 20_000)
    assert run(["verify", "own"]) == 65
    (said,) = re.findall("make it again: cgid (.*)", capsys.readouterr().err)
    command, *stand_ins = said.split("; ")
    assert stand_ins == ["SCENE.toml is the file of scene slope", "MODULE is that of its laws"]
    assert run(shlex.split(command.replace("SCENE.toml", "mine.toml").replace("MODULE", "cone.py"))) == 0
    assert contents(Path("own")) == before


def test_without_its_description_only_the_kind_of_command_is_known(copies: Path) -> None:
    command = "cgid generate SCENE.toml -n 3 --seed 3 --set dtype=float32 -o {} --resume; SCENE.toml is the file of {}"
    assert remedy(copies / "recordings") == command.format(copies / "recordings", "scene stream")
    (copies / "folder" / "description.json").write_text("{")
    assert remedy(copies / "folder") == "repeat what made it, with resume=True"
    assert remedy(copies / "table.h5") == "repeat what made it, with overwrite=True"
