"""Sphinx configuration: sphinx-build -W docs docs/_build/html."""

import sklearn_hd

project = "sklearn_hd"
author = "The sklearn_hd developers"
copyright = "2026, The sklearn_hd developers"
version = release = sklearn_hd.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath"]
numpydoc_show_class_members = False
exclude_patterns = ["_build"]
html_theme = "pydata_sphinx_theme"
html_theme_options = {"navigation_with_keys": False}
