"""Settings of the documentation: ``make docs`` builds it into docs/_build."""

import re

import warpfem

project = "warpfem"
author = "the authors of warpfem"
copyright = author
release = warpfem.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"warpfem {release}"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings tell shapes and units, which hints do not
napoleon_use_ivar = True  # attributes are listed in their class, and not again as members
napoleon_attr_annotations = False


def _keep_norms(app, what, name, obj, options, lines):
    """Keeps |A|^2 outside of ``literals`` from being taken for a substitution of reStructuredText."""
    for index, line in enumerate(lines):
        parts = re.split("(``.*?``)", line)
        lines[index] = "".join(part if part.startswith("``") else part.replace("|", "\\|") for part in parts)


def setup(app):
    app.connect("autodoc-process-docstring", _keep_norms)
