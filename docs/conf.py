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


def equations_as_they_stand(app, what, name, obj, options, lines):
    """Indented equations ahead of the first section of a docstring become literal blocks."""
    shown, inside = [], False
    for k, line in enumerate(lines):
        if set(line.strip()) == {"-"}:
            shown += lines[k:]
            break
        equation = line.startswith("    ")
        if equation and not inside:
            shown += ["::", ""]
        elif inside and line and not equation:
            inside = False
        inside = equation or (inside and not line)
        shown.append(line)
    lines[:] = shown


extensions += ["sphinxcontrib.bibtex"]
bibtex_bibfiles, bibtex_reference_style = ["references.bib"], "author_year"
ALONE = ("get_started", "api", "choosing", "faq", "coming_from_*", "theory", "bibliography")
html_title = "sklearn_hd"
html_sidebars = {page: [] for page in (*ALONE, "developing", "changelog")}  # no section around them


def setup(app):
    """Run before numpydoc, which rewrites the sections."""
    app.connect("autodoc-process-docstring", equations_as_they_stand, priority=100)
