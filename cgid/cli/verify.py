"""`cgid verify`: find damage in datasets, recordings, tables and models, and repair it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cgid.cli.options import PATH
from cgid.cli.output import each_file, print_json, progress_bar, say
from cgid.terminal import counted

#: Problems that are only reported.
_KEPT = ("pending", "foreign")


@click.command(short_help="Say what is damaged in a dataset; make it again.")
@click.argument("data", type=PATH, nargs=-1, required=True, metavar="DATA...")
@click.option("--repair", is_flag=True, help="Make again what is damaged, and remove what stopped runs have left.")
@click.option("--scene", type=PATH, help="Scene file a dataset was made of, where that names a recorded background.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object for each DATA.")
def verify(data: tuple[str, ...], repair: bool, scene: str | None, as_json: bool) -> int:
    """Say what is damaged in DATA: datasets (folders or files), recordings, tables, models; the exit code is 65 then.

    The files of a folder are compared with its manifest and SHA256SUMS, single files with their own checksums. With
    --repair what is damaged or missing is made again from the scene and the seed in the files, to the same bytes, and
    nothing else is touched. Files that do not belong to a dataset are reported, and are no damage.
    """
    if scene is not None and not repair:
        raise click.UsageError("--scene needs --repair: it says what to make files again from; give both or neither")
    given = None
    if scene is not None:
        from cgid import shipped
        from cgid.scene import load_scene

        given = load_scene(shipped.scene_path(scene))

    def treat(path: str) -> None:
        if path.endswith(".npz"):
            _verify_model(path, as_json)
        else:
            _verify_data(path, repair, given, as_json)

    return each_file(data, treat)


def _verify_model(path: str, as_json: bool) -> None:
    """Report an intact model, or raise its damage; models cannot be repaired."""
    from cgid.errors import BadData
    from cgid.identification.model import Model

    try:
        if Path(path).is_fifo():  # reading it would never end
            raise BadData(f"{path}: must be a regular file; copy it to one first")
        Model.load(path)
    except BadData as error:
        _tell(path, "model", 1, [_line(Path(path), "damaged", str(error))], False, as_json)
        raise
    _tell(path, "model", 1, [], True, as_json)


def _verify_data(path: str, repair: bool, scene: Any, as_json: bool) -> None:
    from cgid.errors import BadData
    from cgid.store.verification import verify as find

    found = find(path)
    left = found.damage
    lines = [_line(finding.file, finding.problem, finding.what) for finding in found.findings]
    if repair and any(finding.problem not in _KEPT for finding in found.findings):
        repairs = _repaired(found, scene)
        lines = [
            _line(one.finding.file, one.finding.problem, one.finding.what) | {"repaired": one.done, "told": one.told}
            for one in repairs
        ] + [line for line in lines if line["problem"] in _KEPT]
        left = tuple(one.finding for one in repairs if one.finding.harmful and not one.done)
    _tell(path, found.kind, found.n_files, lines, not left, as_json)
    if left:
        files = f"{len(left)} of its files are" if len(left) > 1 else f"{left[0].file.name} is"
        cure = "see above why --repair does not help" if repair else "cgid verify --repair makes again what can be"
        if all(finding.problem == "unfinished" for finding in left):
            cure = "go on with cgid generate ... --resume"
        raise BadData(f"{path}: must be whole, {files} damaged, missing or unfinished; {cure}")


def _repaired(found: Any, scene: Any) -> list[Any]:
    from cgid.scene.repair import repair

    with progress_bar(None, "values") as progress:
        return list(repair(found, scene, progress))


def _line(file: Path, problem: str, what: str) -> dict[str, Any]:
    return {"file": str(file), "problem": problem, "what": what}


def _tell(path: str, kind: str, n_files: int, lines: list[dict[str, Any]], whole: bool, as_json: bool) -> None:
    """Print the findings in one input, and the actions taken."""
    if as_json:
        print_json({"source": path, "kind": kind, "files": n_files, "whole": whole, "findings": lines})
        return
    state = ("repaired" if any(line.get("repaired") for line in lines) else "whole") if whole else "damaged"
    say(f"{path}: {kind} of {counted(n_files, 'file')}, {state}")
    for line in lines:
        told = f"; {'repaired' if line['repaired'] else 'not repaired'}: {line['told']}" if "repaired" in line else ""
        say(f"  {line['file']}: {line['problem']}: {line['what'].removeprefix(line['file'] + ': ')}{told}")
