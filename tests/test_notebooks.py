"""Every notebook runs from top to bottom and shows what it states."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]


NOTEBOOKS = pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.name)


@pytest.mark.parametrize("name", ["first_walk", "own_recordings"])
@pytest.mark.filterwarnings("ignore")
def test_cells_of_a_notebook_run(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In this process, with an eighth of the signals to learn from, and in the folder where Jupyter runs them."""
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(ROOT / "notebooks")
    names: dict[str, object] = {}
    for cell in nbformat.read(f"{name}.ipynb", as_version=4).cells:
        if cell.cell_type == "code":
            exec(cell.source.replace("8000", "1000"), names)
    check(name, capsys.readouterr().out)


@pytest.mark.long
@NOTEBOOKS
@pytest.mark.filterwarnings("ignore")
def test_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = nbformat.read(path, as_version=4)
    assert all(cell.outputs for cell in notebook.cells if cell.cell_type == "code"), "every cell shows what it gives"
    check(path.stem, printed_by(notebook))
    assert path.stat().st_size < 200_000, "small pictures: figures of the default resolution or less"
    # The kernel is this very interpreter, whatever kernels the machine knows.
    spec = tmp_path / "kernels" / "python3"
    spec.mkdir(parents=True)
    command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    (spec / "kernel.json").write_text(json.dumps({"argv": command, "language": "python"}))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    ).execute()
    check(path.stem, printed_by(notebook))


def printed_by(notebook: nbformat.NotebookNode) -> str:
    return "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", []))


def check(name: str, printed: str) -> None:
    """Fail if a notebook does not print what its text says."""
    if name == "first_walk":
        assert float(re.search(r"accuracy (0\.\d+)", printed)[1]) > 0.85
        answers = re.findall(r"(\w+) +\S+ +novelty", printed)
        assert answers == ["coal", "gangue"] * 3
        assert "unknown" in printed  # the recording that does not suit the model
    elif name == "population":
        assert "4000 impacts; N is the unit" in printed
        assert float(re.search(r"right (0\.\d+)", printed)[1]) > 0.85
    elif name == "run_time":
        assert "the table agrees with the solver" in printed
        assert "(2000, 200)" in printed
    elif name == "own_recordings":
        assert "{'unknown': 20}" in printed  # by the shipped model: another beam
        assert float(re.search(r"accuracy (0\.\d+)", printed)[1]) > 0.6
        assert re.search(r"\{'(coal|gangue)': \d+, '(coal|gangue)': \d+\}", printed)
    else:
        assert name == "paper"
        assert "14 theoretical figures" in printed
        assert "table_5" in printed
