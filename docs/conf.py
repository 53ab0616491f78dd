"""Sphinx: python -m sphinx -W --keep-going -b html docs SITE.

`generate.py` writes pages below `generated/` before Sphinx reads the sources: one page for each solver, the output
and figures of the examples, cases, measured curves. The contents are added to the first page here, so that a forge
does not show their source.
"""

import re
import sys
from pathlib import Path

from docutils import nodes

sys.path[:0] = [
    str(Path(__file__).parent),
    str(Path(__file__).parent.parent),
]  # generate.py, benchmarks

import docstrings
import generate

import lavender

project = "lavender"
author = "The lavender developers"
copyright = "The lavender developers, BSD 3-Clause licence"
version = release = lavender.__version__

extensions = [
    "sphinx.ext.autodoc",
    "numpydoc",
    "myst_parser",
    "sphinx_copybutton",
    "sphinx_reredirects",
]
#: Former addresses of pages.
redirects = {
    "architecture": "guarantees.html",
    "chapter": "course/chapter.html",
    "chapter-answers": "course/answers.html",
}
exclude_patterns = ["_build"]
default_role = "code"

myst_enable_extensions = ["colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # types and units stand in the docstrings
autodoc_class_signature = "mixed"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

# Pages link to files of the repository outside docs/; tests/project/test_docs.py checks every link.
suppress_warnings = ["myst.xref_missing"]

html_theme = "furo"
html_title = f"lavender {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#5b4b9a", "color-brand-content": "#5b4b9a"},
    "dark_css_variables": {"color-brand-primary": "#b3a4ee", "color-brand-content": "#b3a4ee"},
}
# Comments and numbers have a contrast of at least 4.5 : 1; accessible-pygments comes with furo.
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# Caption -> pages, in the order of the contents.
CONTENTS = {
    "Start": "install quickstart concepts error sweep",
    "Solve": "choose solvers failures quadratic-programs",
    "Your data": "own-engine c formats derivatives",
    "Judge engines": "audit compare mujoco worlds engines read-a-step report commands scorecard scorecard-settings",
    "LavenderSim and the course": "engine course/chapter course/answers course/lavendersim generated/examples",
    "Background": "residual methods comparison guarantees generated/cases generated/measured generated/engine-arrays",
    "Project": "plugin generated/api",
}


def add_contents(app, name, source):
    """Append the contents to the source of index.md, and the pages of the solvers to that of solvers.md."""
    toctree = "\n```{{toctree}}\n{}:hidden:\n\n{}\n```\n".format
    if name == "index":
        for caption, pages in CONTENTS.items():
            source[0] += toctree(f":caption: {caption}\n", pages.replace(" ", "\n"))
    elif name == "solvers":
        own = (spec for spec in generate.built_in().values() if not spec.external)
        pages = [*(spec.name for spec in own), "backends"]
        source[0] += toctree("", "\n".join(f"generated/solvers/{page}" for page in pages))


#: Matches a number with an exponent, a unit, or both.
UNIT = r"(?:[µnm]?s|[µmc]?m|m/s|rad/s|rad|N\ss|N|J|√J|kg|Hz|[kMGT]i?B|%|times)(?![\w/])"
NUMBER = re.compile(rf"(?<![\w.])\d[\d.,]*(?:e-?\d+(?:\s{UNIT})?|\s{UNIT})")


def keep_numbers_together(app, doctree, name):
    """Mark numbers with their units in the text of a page, so that the style sheet keeps each on one line."""
    for text in list(doctree.findall(nodes.Text)):
        if isinstance(
            text.parent, (nodes.literal, nodes.literal_block, nodes.math, nodes.raw, nodes.comment)
        ):
            continue
        parts = []
        end = 0
        for match in NUMBER.finditer(text):
            parts += [
                nodes.Text(text[end : match.start()]),
                nodes.inline("", match[0], classes=["number"]),
            ]
            end = match.end()
        if parts:
            text.parent.replace(text, [*parts, nodes.Text(text[end:])])


def setup(app):
    """Write the generated pages, and make reStructuredText of docstrings that are plain text."""
    app.connect(
        "builder-inited", lambda app: generate.write(Path(app.srcdir), Path(app.doctreedir))
    )
    app.connect("source-read", add_contents)
    app.connect("doctree-resolved", keep_numbers_together)
    app.connect("autodoc-process-docstring", docstrings.process, priority=100)
    app.connect("autodoc-process-docstring", docstrings.add_fields, priority=900)
