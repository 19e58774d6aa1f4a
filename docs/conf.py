"""Sphinx configuration: make -C docs html, or sphinx-build -W -b html docs docs/_build/html."""

import warnings
from pathlib import Path

import matplotlib as mpl
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

import sklearn_hd
from sklearn_hd import exceptions

project = "sklearn_hd"
author = "The sklearn_hd developers"
copyright = "2026, The sklearn_hd developers"
version = release = sklearn_hd.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "sphinxcontrib.bibtex",
]
myst_enable_extensions = ["dollarmath"]
numpydoc_show_class_members = False
exclude_patterns = ["_build"]
html_static_path = ["_static"]
html_css_files = ["phone.css"]
html_title = "sklearn_hd"  # short: it stands beside buttons on a phone
html_theme = "pydata_sphinx_theme"
html_theme_options = {"navigation_with_keys": False}
ALONE = ("get_started", "api", "choosing", "faq", "coming_from_*", "theory", "bibliography")
html_sidebars = {page: [] for page in (*ALONE, "developing", "changelog")}  # no section around them
html_math_renderer = "mathml"  # nothing to fetch: equations stand offline, too
bibtex_bibfiles, bibtex_reference_style = ["references.bib"], "author_year"

BACKREFERENCES = "gallery_backreferences"
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "auto_examples",
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"^(?!plot_)",  # reproduce_paper.py is run by itself
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "reset_modules": ("matplotlib",),
    "matplotlib_animations": False,
    "image_srcset": ["2x"],
    "thumbnail_size": (400, 280),
    "min_reported_time": 1,
    "show_memory": False,
    "show_signature": False,
    "download_all_examples": False,
    "remove_config_comments": True,
    "capture_repr": ("_repr_html_",),
    "doc_module": ("sklearn_hd",),
    "backreferences_dir": BACKREFERENCES,
    "inspect_global_variables": False,
}

mpl.use("agg")
for category in vars(exceptions).values():  # an example that warns must say so itself
    if isinstance(category, type) and issubclass(category, Warning):
        warnings.simplefilter("error", category)


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


def examples_that_use_it(app, what, name, obj, options, lines):
    """Thumbnails of the examples below the docstring of what they use."""
    found = Path(app.srcdir, BACKREFERENCES, f"{name}.examples")
    if what in ("class", "function") and found.exists() and found.stat().st_size:
        lines += ["", ".. rubric:: In the gallery", "", f".. minigallery:: {name}", ""]


def room_for_code(app, pagename, templatename, context, doctree):
    """Examples have no column on the right: their lines are long."""
    if pagename.startswith("auto_examples/plot_"):
        context["theme_secondary_sidebar_items"] = []


def inline_math(self, node):
    """LaTeX as MathML, which browsers show by themselves."""
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def displayed_math(self, node):
    """The same for an equation on a line of its own, which may be wider than a phone."""
    self.body.append(f'<div class="equation">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app):
    """Equations are kept before numpydoc rewrites the sections, examples are added after."""
    app.add_html_math_renderer("mathml", (inline_math, None), (displayed_math, None))
    app.connect("autodoc-process-docstring", equations_as_they_stand, priority=100)
    app.connect("autodoc-process-docstring", examples_that_use_it, priority=900)
    app.connect("html-page-context", room_for_code, priority=100)
