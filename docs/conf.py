"""Sphinx: python -m sphinx -W --keep-going -b html docs SITE.

Pages below `generated/` are written by `generate.py` before Sphinx reads the sources: one page for each
solver, the examples' output and figures, scenes, cases, measured curves.
"""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]  # generate.py, benchmarks

import docstrings
import generate

import lavender

project = "lavender"
author = "The lavender developers"
copyright = "The lavender developers, BSD 3-Clause licence"
version = release = lavender.__version__

extensions = ["sphinx.ext.autodoc", "numpydoc", "myst_parser"]
exclude_patterns = ["_build", "generated/parts"]
default_role = "code"

myst_enable_extensions = ["colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # types and units stand in the docstrings
autodoc_class_signature = "mixed"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

html_theme = "furo"
html_title = f"lavender {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#5b4b9a", "color-brand-content": "#5b4b9a"},
    "dark_css_variables": {"color-brand-primary": "#b3a4ee", "color-brand-content": "#b3a4ee"},
}
pygments_style = "friendly"
pygments_dark_style = "github-dark"


def setup(app):
    """Write the generated pages, and make reStructuredText of docstrings that are plain text."""
    app.connect("builder-inited", lambda app: generate.write(Path(app.srcdir), Path(app.doctreedir)))
    app.connect("autodoc-process-docstring", docstrings.process, priority=100)
    app.connect("autodoc-process-docstring", docstrings.add_fields, priority=900)
