"""Configuration of the Sphinx site."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent / "_ext"), str(Path(__file__).parent.parent)]

project = "romandask"
author = "The romandask developers"
copyright = author
version = release = installed_version("romandask")

extensions = ["myst_nb", "sphinx.ext.autodoc", "numpydoc", "generated"]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]

# notebooks are stored with their output; tests/docs executes them
nb_execution_mode = "off"
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_theme = "pydata_sphinx_theme"
html_title = "romandask"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
# pages without a section have nothing to show beside them
html_sidebars = {page: [] for page in ("quickstart", "user-guide", "pipelines", "data-products")}
html_sidebars |= {page: [] for page in ("contributing", "changelog", "citing")}
html_show_sourcelink = False
html_theme_options = {
    "navbar_align": "left",
    "show_nav_level": 1,
    "navigation_depth": 3,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
}
