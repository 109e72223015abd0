"""Manifests of labelled recordings: both formats, and everything that can be wrong in them, each in one line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cgid.errors import BadData, CannotCreate, CgidError
from cgid.identification.training.manifest import (
    Manifest,
    folder_manifest,
    is_manifest,
    joined,
    manifest_text,
    path_from,
    read_manifest,
    require_labels_kept,
)

ROOT = Path(__file__).parents[1]


def written(folder: Path, content: str, name: str = "m.csv", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(content.encode(encoding))
    return path


def test_rows_of_a_table_say_everything(tmp_path: Path) -> None:
    text = (
        "# our second support\n"
        "Path;label;Start_s;end_s;group;channel;gain;rate_hz;unit;variable\n"
        "a.wav;coal;0.5;1.25;monday;1+left;6 dB;8000;g;x\n"
        "\n"
        "b.wav;gangue;;;;2;10;;;\n"
    )
    coal, gangue = read_manifest(written(tmp_path, text, encoding="utf-8-sig")).annotations
    assert coal.path == tmp_path / "a.wav"
    assert (coal.label, coal.group, coal.start, coal.end) == ("coal", "monday", 0.5, 1.25)
    assert coal.channels == ("1", "left")
    assert coal.gain == pytest.approx(10 ** (6 / 20), rel=1e-12)
    assert (coal.sampling_rate, coal.unit, coal.variable) == (8000, "g", "x")
    assert (gangue.gain, gangue.channels, gangue.label) == (10.0, ("2",), "gangue")


def test_recordings_are_their_own_groups_and_last_to_their_ends(tmp_path: Path) -> None:
    manifest = read_manifest(written(tmp_path, "path,label\na.wav,coal\nsub/b.wav,gangue\n"))
    first, second = manifest.annotations
    assert first.group != second.group
    assert (first.start, first.end, first.channels, first.gain) == (0.0, math.inf, None, None)
    assert second.path == tmp_path / "sub" / "b.wav"
    assert manifest.labels == ("coal", "gangue")


def test_a_scene_is_no_manifest(tmp_path: Path) -> None:
    assert not is_manifest(ROOT / "datasets" / "reference.toml")
    assert not is_manifest("reference")
    assert not is_manifest(tmp_path)
    assert not is_manifest(tmp_path / "gone.toml")
    assert is_manifest(tmp_path / "gone.csv")


def test_a_spreadsheet_may_save_what_we_wrote(tmp_path: Path) -> None:
    """Its separator, its decimal comma, its byte order mark, and columns that only inform."""
    row = {
        "path": "Schild 7/a.wav",
        "start": "0.5",
        "end": "1.25",
        "rate": "25600.5",
        "time_s": "0.51",
        "peak": "7.5",
    }
    text = manifest_text([{**row, "label": "coal", "gain": "0.5", "flags": "clipped"}])
    ours = read_manifest(written(tmp_path, text)).annotations
    assert (ours[0].start, ours[0].end, ours[0].gain, ours[0].sampling_rate) == (0.5, 1.25, 0.5, 25600.5)
    saved = text.replace(",", ";").replace("0.5", "0,5").replace("1.25", "1,25").replace("25600.5", "25600,5")
    assert read_manifest(written(tmp_path, saved, encoding="utf-8-sig")).annotations == ours
    volts = 'path;label;sensitivity;gain;full_scale\na.wav;coal;"1=10,2 mV/g;2=2,3 mV/N";1,5;2,5 V\n'
    (one,) = read_manifest(written(tmp_path, volts)).annotations
    assert (one.sensitivity, one.gain, one.full_scale) == (("1=10.2 mV/g", "2=2.3 mV/N"), 1.5, ("2.5 V",))
    with pytest.raises(BadData, match="start must be a number in s, got '0,5'"):
        read_manifest(written(tmp_path, 'path,label,start_s\na.wav,coal,"0,5"\n'))


def test_paths_are_those_from_the_folder_of_the_manifest(tmp_path: Path) -> None:
    assert path_from(tmp_path / "tables", tmp_path / "day" / "a.wav") == "../day/a.wav"
    for name in ("#1.wav", " #1.wav", "a b.wav", "a,b;c.wav", "a\u2028b.wav", "a\nb.wav"):
        text = manifest_text([{"path": path_from(tmp_path, tmp_path / name), "label": "coal"}])
        (one,) = read_manifest(written(tmp_path, text)).annotations
        assert one.path == tmp_path / name


def test_subfolders_are_labels_and_theirs_are_groups(tmp_path: Path) -> None:
    for name in ("coal/1.wav", "coal/monday/2.wav", "gangue/monday/3.npy", ".git/4.wav", "gangue/notes.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    manifest = folder_manifest(tmp_path)
    assert [(one.written, one.label) for one in manifest.annotations] == [
        ("coal/1.wav", "coal"),
        ("coal/monday/2.wav", "coal"),
        ("gangue/monday/3.npy", "gangue"),
    ]
    first, second, third = (one.group for one in manifest.annotations)
    assert second == third == "monday" != first
    (tmp_path / "events.csv").write_text("path,label\ncoal/1.wav,shale\n")
    assert folder_manifest(tmp_path).labels == ("shale",)


MISTAKES = {
    "no rows": ("path,label\n", "there is none"),
    "nothing": ("", "there is none"),
    "column twice": ("path,label,label\na,b,c\n", "'label' is there twice"),
    "column without its unit": ("path,start,label\na,1,b\n", "got 'start'; did you mean 'start_s'?"),
    "title twice, in two cases": ("path,rate_Hz,Rate_hz,label\na,1,1,b\n", "'rate_Hz' is there twice"),
    "near a column": ("path,starts_s,label\na,1,b\n", "'start_s'"),
    "no path column": ("label,group\na,b\n", "must include path"),
    "too many cells": ("path,label\na,b,c\n", "row 2: must have 2 cells"),
    "no label": ("path,label\na,\n", "some row must have a label, none of 1 has; fill in the column label"),
    "endless label": (f"path,label\na,{'x' * 101}\n", "at most 100 characters"),
    "negative start": ("path,label,start_s\na,b,-1\n", "start and end must rise"),
    "start no number": ("path,label,start_s\na,b,soon\n", "start must be a number in s, got 'soon'"),
    "start not finite": ("path,label,start_s\na,b,inf\n", "start and end must rise"),
    "gain zero": ("path,label,gain\na,b,0\n", "gain must be above 0"),
    "rate zero": ("path,label,rate_Hz\na,b,0\n", "rate must be above 0"),
    "unknown unit": ("path,label,unit\na,b,stone\n", "unit must be a known one"),
    "channel twice": ("path,label,channel\na,b,1+1\n", "channel must be a name or a number"),
    "reference runs": ("path,label,Reference\na,,yes\n", "column reference must be left out"),
    "invert neither yes nor no": ("path,label,invert\na,b,maybe\n", "invert must be yes or no"),
    "near a column beside own ones": ("path,lable,weather\na,b,rain\n", "got 'lable'; did you mean 'label'?"),
    "recording in two groups": ("path,label,start_s,end_s,group\na,b,0,1,x\na,c,1,2,y\n", "must be in one group"),
    "rate of one row": ("path,label,start_s,end_s,rate_Hz\na,b,0,1,8e3\na,c,1,2,\n", "one rate, got 8000.0 and none"),
    "unit of one row": ("path,label,start_s,end_s,unit\na,b,0,1,\na,c,1,2,g\n", "one unit, got none and g"),
    "path with a zero byte": ("path,label\na\0b,c\n", "path must be the name of a file"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_in_a_table_is_one_line(name: str, tmp_path: Path) -> None:
    content, says = MISTAKES[name]
    with pytest.raises(BadData) as error:
        read_manifest(written(tmp_path, content))
    assert says in str(error.value)
    assert len(str(error.value).splitlines()) == 1
    assert str(tmp_path / "m.csv") in str(error.value)


def test_every_mistake_is_said_at_once(tmp_path: Path) -> None:
    rows = "".join(f"a{k},b,{-k}\n" for k in range(1, 31))
    with pytest.raises(BadData) as error:
        read_manifest(written(tmp_path, "path,label,start_s\n" + rows))
    lines = str(error.value).splitlines()
    assert len(lines) == 21
    assert "row 2" in lines[0]
    assert "and 10 more mistakes" in lines[-1]


def test_no_damage_is_more_than_an_error_of_ours(tmp_path: Path) -> None:
    generator = np.random.default_rng(4)
    contents = {
        "m.csv": b"path,label,start_s,end_s,gain,channel\na.wav,coal,0,1,6 dB,1+2\nb.wav,gangue,0.5,2,3,left\n",
    }
    for name, content in contents.items():
        for _ in range(400):
            damaged = bytearray(content)
            for place in generator.integers(0, len(content), generator.integers(1, 4)):
                damaged[place] = generator.integers(0, 256)
            cut = generator.integers(0, len(content)) if generator.random() < 0.3 else len(content)
            (tmp_path / name).write_bytes(bytes(damaged[:cut]))
            try:
                read_manifest(tmp_path / name)
            except CgidError as error:
                assert all(line.startswith(str(tmp_path)) for line in str(error).splitlines())


# -- rows without a label, and stretches --------------------------------------------------------------------


def times(text: str, folder: Path) -> list[tuple[str, float, float]]:
    return [(one.label, one.start, one.end) for one in read_manifest(written(folder, text)).annotations]


def test_rows_without_a_label_are_counted_and_left_out(tmp_path: Path) -> None:
    manifest = read_manifest(written(tmp_path, "path,label\na,\nb,coal\nc,\nd,gangue\n"))
    assert [one.written for one in manifest.annotations] == ["b", "d"]
    assert manifest.n_unlabelled == 2
    assert joined([manifest, manifest_of_others(tmp_path)]).n_unlabelled == 2


def manifest_of_others(folder: Path) -> Manifest:
    return read_manifest(written(folder, "path,label\ne,coal\n", "others.csv"))


def test_columns_of_the_user_do_not_matter(tmp_path: Path) -> None:
    plain = read_manifest(written(tmp_path, "path,label\na,coal\n")).annotations
    text = "Weather,path,label,,label_of_anna,By,weather\nrain,a,coal,,gangue,Anna,sun\n"
    assert read_manifest(written(tmp_path, text)).annotations == plain


def test_a_stretch_labels_the_rows_in_it(tmp_path: Path) -> None:
    head = "path,start_s,end_s,label\n"
    rows = "a,9.998,10.1,\na,20,20.2,\na,39.9,40.05,\na,50,50.1,\nb,20,20.2,\n"
    manifest = read_manifest(written(tmp_path, head + rows + "a,10,40,coal\n"))
    assert [(one.written, one.label, one.start, one.end) for one in manifest.annotations] == [("a", "coal", 10, 40)]
    assert manifest.n_unlabelled == 2  # at 50 s, and of another recording
    assert times(head + "a,20,20.2,\na,,,gangue\n", tmp_path) == [("gangue", 0, math.inf)]


def test_a_row_with_a_label_keeps_it_in_a_stretch_and_is_told(tmp_path: Path) -> None:
    text = "path,start_s,end_s,label,unit\na,20,20.2,gangue,g\na,30,30.2,coal,g\na,39.9,40.1,gangue,g\na,10,40,coal,\n"
    with pytest.warns(UserWarning, match="row 5: the stretch 10 s to 40 s is coal and holds 2 rows labelled gangue"):
        manifest = read_manifest(written(tmp_path, text))
    found = {(one.label, one.start, one.end): one for one in manifest.annotations}
    assert set(found) == {
        *(("gangue", 20, 20.2), ("coal", 30, 30.2), ("gangue", 39.9, 40.1)),
        *(("coal", 10, 20), ("coal", 20.2, 30), ("coal", 30.2, 39.9)),
    }
    parts = [one for one in manifest.annotations if one.stretch]
    assert {one.name for one in parts} == {"a from 10 to 40 s"} and {one.chosen for one in parts} == {"stretch"}
    assert {one.unit for one in manifest.annotations} == {"g"}  # the stretch takes it from its rows


def test_a_shorter_stretch_is_cut_from_a_longer_one(tmp_path: Path) -> None:
    text = "path,start_s,end_s,label\na,,,coal\na,10,20,gangue\na,12,12.1,\na,15,15.1,coal\n"
    with pytest.warns(UserWarning, match="holds 1 row labelled"):
        found = times(text, tmp_path)
    assert sorted(found, key=lambda one: one[1]) == [
        *(("coal", 0, 10), ("gangue", 10, 15), ("coal", 15, 15.1), ("gangue", 15.1, 20), ("coal", 20, math.inf)),
    ]


def test_a_stretch_without_a_channel_is_of_all_channels(tmp_path: Path) -> None:
    text = (
        "path,channel,start_s,end_s,label\na,1,11,11.1,\na,2+3,12,12.1,\na,,10,20,coal\nb,,10,20,coal\nb,1,30,31,coal\n"
    )
    manifest = read_manifest(written(tmp_path, text))
    assert [(one.written, one.channels, one.start, one.end) for one in manifest.annotations] == [
        *(("a", ("1",), 10, 20), ("a", ("2", "3"), 10, 20), ("b", None, 10, 20), ("b", ("1",), 30, 31)),
    ]


def test_stretches_that_cross_are_still_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="intervals must not overlap, coal and gangue do at 15 s"):
        times("path,start_s,end_s,label\na,10,20,coal\na,15,25,gangue\n", tmp_path)


# -- spellings of labels ----------------------------------------------------------------------------------


def test_labels_in_other_letters_are_one_label(tmp_path: Path) -> None:
    """The most frequent spelling is used, of equally frequent ones the first, and one line names them."""
    rows = ["coal", "Coal", "coal", '"Hard  Coal "', "hard coal", "shale"]
    text = "path,label\n" + "".join(f"{k}.wav,{label}\n" for k, label in enumerate(rows))
    with pytest.warns(UserWarning, match="are one label") as caught:
        manifest = read_manifest(written(tmp_path, text))
    assert [one.label for one in manifest.annotations] == ["coal", "coal", "coal", "Hard Coal", "Hard Coal", "shale"]
    told = [str(one.message) for one in caught]
    assert len(told) == 2 and "'coal' (2), 'Coal' (1)" in told[0] and "'Hard  Coal' (1), 'hard coal' (1)" in told[1]
    for folder in ("coal", "Coal", "gangue"):
        (tmp_path / "all" / folder).mkdir(parents=True)
        (tmp_path / "all" / folder / "a.wav").touch()
    with pytest.warns(UserWarning, match="are one label, 'Coal'"):
        assert folder_manifest(tmp_path / "all").labels == ("Coal", "gangue")


def test_labels_that_differ_in_more_stay_apart(tmp_path: Path) -> None:
    text = "path,label\na.wav,hard coal\nb.wav,hard-coal\nc.wav,hardcoal\n"
    assert read_manifest(written(tmp_path, text)).labels == ("hard coal", "hard-coal", "hardcoal")


# -- what a spreadsheet makes of it ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["=cmd|' /C calc'!A0.csv", "+x.csv", "-x.csv", "@sum.csv", "'=x.csv", "\t=x.csv", "#x.csv"]
)
def test_a_name_is_no_formula_and_is_read_back(name: str, tmp_path: Path) -> None:
    rows = [
        {
            "path": path_from(tmp_path, tmp_path / name),
            "label": "coal",
            "group": "-1",
            "channel": "=left",
            "gain": "-3 dB",
        }
    ]
    cells = manifest_text(rows).splitlines()[1].split(",")
    assert not any(cell.startswith(("=", "+", "@", "\t")) for cell in cells)
    assert "-1" in cells  # a number
    (one,) = read_manifest(written(tmp_path, manifest_text(rows))).annotations
    assert one.path.resolve() == (tmp_path / name).resolve()
    assert (one.group, one.channels, one.gain) == ("-1", ("=left",), pytest.approx(10 ** (-3 / 20)))


@pytest.mark.parametrize(
    ("content", "lost"),
    [
        ("path,label\na.wav,coal\n", 1),
        ("# ours\nnote;Path;LABEL\nx;a.wav;coal\n;b.wav;\n;c.wav;stone\n", 2),
        ("path,label\na.wav,\n", 0),
        ("path,note\na.wav,coal\n", 0),
        ("0,1\n2,3\n", 0),
        ("", 0),
    ],
)
def test_labels_that_a_person_filled_in_are_not_replaced(content: str, lost: int, tmp_path: Path) -> None:
    path = written(tmp_path, content)
    if lost:
        with pytest.raises(CannotCreate, match=rf"got {lost} label.*choose another name"):
            require_labels_kept(path)
    else:
        require_labels_kept(path)
    require_labels_kept(path, [{"path": "a.wav", "label": "coal"}, {"path": "c.wav", "label": "stone"}])
    require_labels_kept(tmp_path / "none.csv")
