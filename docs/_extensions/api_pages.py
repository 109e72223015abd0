"""The pages of the Python API: one for each part of the package, with the names that it gives to users.

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

#: Page -> title, and modules with the names that users meet; None for all of `__all__`.
PAGES: dict[str, tuple[str, dict[str, tuple[str, ...] | None]]] = {
    "cgid": ("Everyday names: cgid", {"cgid": None}),
    "physics": (
        "Physics of an impact: cgid.physics",
        {
            "cgid.physics": None,
            "cgid.physics.materials": (
                "MaterialRange",
                "StrengthRange",
                "STEEL",
                "COAL",
                "SHALE",
                "SANDSTONE",
                "COAL_STRENGTH",
                "MUDSTONE_STRENGTH",
                "SANDSTONE_STRENGTH",
                "LIMESTONE_STRENGTH",
                "YANG2018_SPHERES",
            ),
            "cgid.physics.tail_beam": ("TailBeam", "Ribs"),
            "cgid.measure.modes": ("Modes", "read_modes"),
            "cgid.physics.response": ("Response", "Resonance", "LowPass"),
            "cgid.physics.sampled": ("SampledPulses",),
        },
    ),
    "scene": (
        "Scenes and synthetic signals: cgid.scene",
        {
            "cgid.scene": None,
            "cgid.scene.plan": ("Decision", "Plan", "plan"),
            "cgid.scene.given_pulses": ("SolvedImpacts",),
        },
    ),
    "recordings": (
        "Recordings: cgid.recordings",
        {"cgid.recordings": None, "cgid.identification.events": ("Event",)},
    ),
    "measure": (
        "Measuring: cgid.measure",
        {
            "cgid.measure.features": ("FEATURES", "choose", "extract"),
            "cgid.measure.filters": ("fft_filter", "filter_gain", "Equalisation"),
            "cgid.identification.estimation": ("Estimates", "Posterior", "cramer_rao_bound", "estimate", "posterior"),
        },
    ),
    "identification": (
        "Identifying and training: cgid.identification",
        {
            "cgid.identification.prediction_settings": ("PredictionSettings",),
            "cgid.identification.answers": ("Answer", "identify", "identify_frames", "suited"),
            "cgid.identification.share": ("CavingWatch", "Share", "ShareWindow", "wilson_interval"),
            "cgid.identification.rows": ("Rows", "measure"),
            "cgid.identification.training": ("Training", "train"),
            "cgid.identification.card": ("write_card",),
            "cgid.export_c": ("c_source",),
            "cgid.learn": ("TrainingStream", "to_xarray", "from_xarray"),
        },
    ),
    "store": (
        "Datasets on disk: cgid.store",
        {
            "cgid.store": None,
            "cgid.store.verification": ("Verified", "verify"),
            "cgid.scene.repair": ("repair",),
            "cgid.store.dataset": ("export",),
        },
    ),
    "ceiling": ("The best possible accuracy: cgid.ceiling", {"cgid.ceiling": None}),
    "site": ("The beam of a site: cgid.site", {"cgid.site": None}),
    "impactor": (
        "What struck, and public recordings: cgid.impactor, cgid.public",
        {"cgid.impactor": None, "cgid.public": ("PublicData", "fetch")},
    ),
    "output": (
        "Pictures and reports: cgid.plots, cgid.report",
        {
            "cgid.plots": ("picture", "recording_picture", "share_figure"),
            "cgid.report": ("Report", "report_page", "write_report"),
        },
    ),
}


def names_of(module: str, names: tuple[str, ...] | None) -> list[str]:
    """Return the documented names of a module that it has; those of `cgid` itself only there."""
    found, everyday = import_module(module), import_module("cgid")
    given = names if names is not None else tuple(getattr(found, "__all__", ()))
    public = {id(getattr(everyday, name)) for name in everyday.__all__} if found is not everyday else set()
    here = [name for name in given if hasattr(found, name) and not name.startswith("__")]
    return sorted((name for name in here if id(getattr(found, name)) not in public), key=str.lower)


def write_pages(app: Sphinx, _: Any) -> None:
    """Write the pages, each only if it has changed, so that Sphinx does not read it again."""
    folder = Path(app.srcdir) / "reference" / "api"
    for page, (title, modules) in PAGES.items():
        lines, described = [title, "=" * len(title), ""], []
        for module, chosen in modules.items():
            names = names_of(module, chosen)
            for name in names:
                found, full = getattr(import_module(module), name), f"{module}.{name}"
                kind = "class" if inspect.isclass(found) else "function" if callable(found) else "data"
                described.append(f".. auto{kind}:: {full}")
                if kind == "class":
                    described.append("   :members:")
                    app.config.numpydoc_xref_aliases[name] = full
                described.append("")
            if names:
                lines += [f"From ``{module}``:", "", ".. autosummary::", "   :nosignatures:", ""]
                lines += [*(f"   {module}.{name}" for name in names), ""]
        lines += described
        text, path = "\n".join(lines), folder / f"{page}.rst"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def inherited(app: Sphinx, what: str, name: str, *_: Any) -> bool | None:
    """Leave out the methods that scikit-learn adds to a classifier for its metadata routing."""
    return True if re.fullmatch("set_.*_request|get_metadata_routing", name) else None


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the pages before Sphinx looks for sources."""
    DEFAULT_LINKS.clear()  # words such as array_like would link to numpy's and Python's pages, which no build fetches
    app.connect("config-inited", write_pages, priority=100)  # before numpydoc reads the aliases
    app.connect("autodoc-skip-member", inherited)
    return {"version": "1", "parallel_read_safe": True}
