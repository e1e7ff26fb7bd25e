"""Settings of the documentation's site: ``make docs``."""

import sys
from importlib.metadata import version as installed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from notebook import write_notebook

project = "gpmpc"
author = "the gpmpc authors"
copyright = author
version = release = installed("gpmpc")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
]
templates_path = ["_templates"]
autosummary_generate = True  # a page for every object that a room offers
autosummary_ignore_module_all = False
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "_templates"]
highlight_language = "none"  # of blocks that name none: commands and what they print
suppress_warnings = [
    "ref.python"
]  # a word of an attribute's text, such as "states", is another attribute's name

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "gpmpc"


def mark_formulas(app, what, name, obj, options, lines):
    """Sets indented formulas as they stand, and lets texts write (*batch, n), |x|."""
    marked = []
    for line in lines:
        formula = what == "module" and line.startswith("    ")
        if formula and marked and not marked[-1]:
            marked += ["::", ""]
        if not formula:
            parts = line.split("``")
            parts[::2] = [
                part.replace("*", r"\*").replace("|", r"\|") for part in parts[::2]
            ]
            line = "``".join(parts)
            if line.startswith(r"\* "):  # a list
                line = line[1:]
        marked.append(line)
    lines[:] = marked


def add_notebook(app, error):
    """Writes the tutorial as a notebook beside its page."""
    if error is None:
        write_notebook(
            Path(app.srcdir) / "tutorial.md", Path(app.outdir) / "tutorial.ipynb"
        )


def setup(app):
    """Registers what this site adds to Sphinx."""
    app.connect("build-finished", add_notebook)
    app.connect("autodoc-process-docstring", mark_formulas, priority=100)
