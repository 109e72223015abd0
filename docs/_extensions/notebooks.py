"""The notebooks as pages: `notebooks/NAME.ipynb` becomes `notebooks/NAME.md`, with what its cells have shown."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def write_pages(app: Any) -> None:
    """Write the pages and their pictures into the folder of the sources."""
    source = Path(app.srcdir)
    folder = source / "notebooks"
    folder.mkdir(exist_ok=True)
    for path in sorted((source.parent / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        note = f"\nThis page is the notebook `notebooks/{path.name}` of the checkout; paths are from its folder.\n"
        text = "\n".join(part for k, cell in enumerate(cells) for part in _shown(cell, folder, f"{path.stem}_{k}"))
        (folder / f"{path.stem}.md").write_text(text + note, encoding="utf-8")


def _shown(cell: dict[str, Any], folder: Path, name: str) -> Iterator[str]:
    """Yield a cell and what it has shown as Markdown."""
    content = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        yield content + "\n"
        return
    yield f"```python\n{content}\n```\n"
    for number, output in enumerate(cell["outputs"]):
        data = output.get("data", {})
        if "image/png" in data:
            picture = f"{name}_{number}.png"
            (folder / picture).write_bytes(base64.b64decode("".join(data["image/png"])))
            yield f"![What the cell draws]({picture})\n"
        elif "text/html" in data:
            yield f'````{{raw}} html\n<div class="shown">{"".join(data["text/html"])}</div>\n````\n'
        else:
            yield f"```text\n{''.join(output.get('text', data.get('text/plain', '')))}\n```\n"


def setup(app: Any) -> dict[str, bool]:
    """Register the pages."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True}
