"""Settings of the documentation: ``make docs`` builds it into docs/_build."""

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
