"""The documentation: `python -m sphinx -W -b html docs build/docs`. Nothing is fetched from the network."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_extensions")]
# The examples run in this process, and the commands they start find this checkout, too.
os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cgid  # noqa: E402

project = "cgid"
author = "The cgid developers"
copyright = "the cgid developers, BSD-3-Clause"
version = release = cgid.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "sphinx_copybutton",
    "api_pages",  # docs/_extensions/api_pages.py: the pages of the Python API
    "notebooks",  # docs/_extensions/notebooks.py: the notebooks as pages
    "generated",  # docs/_extensions/generated.py: commands, scene keys, features, formats, units, errors
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
root_doc = "index"
exclude_patterns = ["_build", "gallery", "_extensions", "decisions", "**/README.txt"]
# Pages of a folder are found by pattern. Sphinx cannot suppress the warning that there is none, because it has no type.
logging.getLogger("sphinx.sphinx.directives.other").addFilter(lambda record: "toctree glob" not in str(record.msg))

myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist"]
myst_heading_anchors = 3

autosummary_generate = False  # the pages of api_pages.py describe what they list
default_role = "py:obj"
smartquotes = False  # what is copied from a page must work: --from and "2 N", not a dash and curly quotes
autodoc_typehints = "none"  # the docstrings say types with shapes and units
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_xref_param_type = True  # the classes of the API are links; api_pages.py lists them
numpydoc_xref_ignore = "all"
numpydoc_class_members_toctree = False

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "examples",
    "backreferences_dir": "reference/api/examples",
    "doc_module": ("cgid",),
    "download_all_examples": False,
    "remove_config_comments": True,
    "thumbnail_size": (800, 560),
    "reset_modules": ("looks.package",),  # docs/_extensions/looks.py
    "show_signature": False,
    "show_memory": False,
    "min_reported_time": 1e9,
    "write_computation_times": False,  # its page loads scripts from the network
    "abort_on_example_error": True,
    "plot_gallery": True,
    "within_subsection_order": "FileNameSortKey",
}

html_theme = "furo"
html_title = f"cgid {version}"
html_static_path = ["_static"]
html_css_files = ["cgid.css"]
html_logo = "_static/logo.svg"
html_favicon = "_static/icon.svg"
html_theme_options = {
    "sidebar_hide_name": True,
    "light_css_variables": {"color-brand-primary": "#22303c", "color-brand-content": "#005b8f"},
    "dark_css_variables": {"color-brand-primary": "#cfd8e0", "color-brand-content": "#56b4e9"},
}
#: A prompt and what a command prints are not copied.
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True
copybutton_selector = ", ".join(f"div.highlight-{name} pre" for name in ("sh", "console", "python", "toml"))
html_copy_source = False
html_show_sphinx = False
pygments_style = "tango"
