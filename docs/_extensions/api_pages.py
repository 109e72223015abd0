"""The pages of the Python API: one for each part of the package, with the names in `__all__`.

The pages are written before every build, because they follow from `__all__`. What stands in `cgid` itself is documented
there alone.
"""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import Any

from numpydoc.xref import DEFAULT_LINKS
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

from cgid._lib.lazy import homes_of

#: Page -> title, and modules whose `__all__` is public.
PAGES: dict[str, tuple[str, tuple[str, ...]]] = {
    "cgid": ("Everyday names: cgid", ("cgid",)),
    "physics": ("Physics of an impact: cgid.physics", ("cgid.physics",)),
    "scene": ("Scenes and synthetic signals: cgid.scene", ("cgid.scene",)),
    "recordings": (
        "Recordings: cgid.recordings",
        (
            "cgid.recordings",
            "cgid.recordings.public",
        ),
    ),
    "measure": (
        "Measuring: cgid.measure",
        (
            "cgid.measure.features",
            "cgid.measure.filters",
            "cgid.measure.modal",
        ),
    ),
    "identification": (
        "Identifying and training: cgid.identification",
        (
            "cgid.identification.detection",
            "cgid.identification.inversion",
            "cgid.identification.model",
            "cgid.identification.prediction",
            "cgid.identification.training",
        ),
    ),
    "learning": (
        "Own learners, other machines: cgid.learning, cgid.export",
        (
            "cgid.learning",
            "cgid.export",
        ),
    ),
    "store": ("Datasets on disk: cgid.store", ("cgid.store",)),
    "calibration": ("The beam of a site: cgid.calibration", ("cgid.calibration",)),
    "output": ("Pictures: cgid.plots", ("cgid.plots",)),
}

#: Where each name has a page of its own: those that most people look up.
A_PAGE_A_NAME = ("cgid", "physics")


def names_of(module: str) -> list[str]:
    """Return the public names of a module; those of `cgid` itself only there."""
    described, top = import_module(module), import_module("cgid")
    elsewhere = {id(getattr(top, name)) for name in top.__all__} if described is not top else set()
    names = [name for name in described.__all__ if not name.startswith("__")]
    return sorted((name for name in names if id(getattr(described, name)) not in elsewhere), key=str.lower)


def comment_on(package: str, name: str) -> list[str]:
    """Return the lines of the comment on a constant, from the module that defines it for its package."""
    homes = homes_of(package) if hasattr(import_module(package), "__getattr__") else {}
    return ModuleAnalyzer.for_module(homes[name]).find_attr_docs().get(("", name), []) if name in homes else []


def write_pages(app: Sphinx, _: Any) -> None:
    """Write the pages, each only if it has changed, so that Sphinx does not read it again."""
    folder = Path(app.srcdir) / "reference" / "api"
    for page, (title, modules) in PAGES.items():
        lines, on_page = [title, "=" * len(title), ""], []
        for module in modules:
            names = names_of(module)
            for name in names:
                found, full = getattr(import_module(module), name), f"{module}.{name}"
                kind = "class" if inspect.isclass(found) else "function" if callable(found) else "data"
                comment = comment_on(module, name) if kind == "data" else []
                about = [f".. auto{kind}:: {full}" if not comment else f".. py:data:: {full}"]
                if comment:
                    about += ["", *(f"   {line}" for line in comment)]
                if kind == "class":
                    about.append("   :members:")
                    app.config.numpydoc_xref_aliases[name] = full
                if page in A_PAGE_A_NAME:
                    write(folder / page / f"{name}.rst", [name, "=" * len(name), "", *about])
                else:
                    on_page += [*about, ""]
            if names:
                lines += [f"From ``{module}``:", "", ".. autosummary::", "   :nosignatures:", ""]
                lines += [*(f"   {module}.{name}" for name in names), ""]
        if page in A_PAGE_A_NAME:
            on_page = [".. toctree::", "   :hidden:", "   :glob:", "", f"   {page}/*"]
        write(folder / f"{page}.rst", lines + on_page)


def write(path: Path, lines: list[str]) -> None:
    """Write a page if it has changed."""
    text = "\n".join(lines) + "\n"
    path.parent.mkdir(exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def described(found: Any) -> str:
    """Return the docstring of a function or class; one that joins others has the attributes of these."""
    text = inspect.getdoc(found) or ""
    parents = (
        [one for one in inspect.getmro(found)[1:] if one.__module__.startswith("cgid.")]
        if inspect.isclass(found)
        else []
    )
    told = [(inspect.getdoc(one) or "").partition("Attributes\n----------\n")[2] for one in parents]
    if "Attributes\n---" in text or not (sections := [one.strip("\n") for one in told if one]):
        return text
    return text + "\n\nAttributes\n----------\n" + "\n".join(sections)


def with_parents(app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Give a class that joins others their attributes."""
    if what == "class" and found.__module__.startswith("cgid."):
        lines[:] = [*described(found).splitlines(), ""]


def inherited(app: Sphinx, what: str, name: str, *_: Any) -> bool | None:
    """Leave out the methods that scikit-learn adds to a classifier for its metadata routing."""
    return True if re.fullmatch("set_.*_request|get_metadata_routing", name) else None


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the pages before Sphinx looks for sources."""
    DEFAULT_LINKS.clear()  # words such as array_like would link to numpy's and Python's pages, which no build fetches
    app.connect("config-inited", write_pages, priority=100)  # before numpydoc reads the aliases
    app.connect("autodoc-process-docstring", with_parents, priority=100)  # before numpydoc reads it
    app.connect("autodoc-skip-member", inherited)
    return {"version": "1", "parallel_read_safe": True}
