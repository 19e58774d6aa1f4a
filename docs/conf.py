"""Sphinx configuration: make -C docs html, or sphinx-build -W -b html docs docs/_build/html."""

import re
import sys
from importlib.util import find_spec
from pathlib import Path

import matplotlib as mpl
from docutils import nodes

import sklearn_hd

sys.path.insert(0, str(Path(__file__).parent))
from equations import latex

project = "sklearn_hd"
author = "The sklearn_hd developers"
copyright = "2026, The sklearn_hd developers"
version = release = sklearn_hd.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "sphinxcontrib.bibtex",
]
myst_enable_extensions = ["dollarmath"]
numpydoc_show_class_members = False
autodoc_member_order = "groupwise"
toc_object_entries_show_parents = "hide"
templates_path = ["_templates"]
exclude_patterns = ["_build"]
MATHJAX = Path(find_spec("sphinx-mathjax-offline").origin).parent / "static/mathjax"
mathjax_path = "tex-svg-full.js"  # one file, no fonts: equations stand offline and from file://
html_static_path = ["_static", str(MATHJAX / mathjax_path)]
html_css_files = ["phone.css", "print.css"]
html_title = "sklearn_hd"  # short: it stands beside buttons on a phone
html_theme = "pydata_sphinx_theme"
html_theme_options = {
    "navigation_with_keys": False,
    "header_links_before_dropdown": 8,
    "navbar_persistent": ["search-button"],  # the field would take a line of its own
}
ALONE = ("get_started", "choosing", "faq", "coming_from_*", "theory", "bibliography", "glossary")
ALONE += ("cheat_sheet", "developing", "changelog")
html_sidebars = {page: [] for page in ALONE}  # no section around them
bibtex_bibfiles, bibtex_reference_style = ["references.bib"], "author_year"

BACKREFERENCES = "gallery_backreferences"
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "auto_examples",
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"^(?!plot_)",  # reproduce_paper.py is run by itself
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "reset_modules": ("matplotlib", "gallery_setup.before_each"),
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


def set_equations(app, what, name, obj, options, lines):
    """Indented equations ahead of the first section of a docstring become mathematics."""
    shown, block, rest = [], [], []
    for k, line in enumerate(lines):
        section = bool(line) and set(line.strip()) == {"-"}
        if line.startswith("    ") and not section:
            block.append(line)
            continue
        if block:
            found = latex(block)
            body = [f"    {row}" for row in found.splitlines()] if found else block
            shown += [".. math::" if found else "::", "", *body, ""]
            block = []
        if section:
            rest = lines[k:]
            break
        shown.append(line)
    lines[:] = shown + rest


def only_ours(app, what, name, obj, skip, options):
    """Members that pandas, scikit-learn or Python define are described by them."""
    described = getattr(obj, "fget", None) or getattr(obj, "func", None) or obj
    described = getattr(described, "__func__", described)
    home = getattr(described, "__module__", None) or ""
    return skip or not home.startswith("sklearn_hd")


def examples_that_use_it(app, what, name, obj, options, lines):
    """Thumbnails of the examples below the docstring of what they use."""
    found = Path(app.srcdir, BACKREFERENCES, f"{name}.examples")
    if what in ("class", "function") and found.exists() and found.stat().st_size:
        lines += ["", ".. rubric:: In the gallery", "", f".. minigallery:: {name}", ""]


IN_NUMBER = re.compile(r"(?<=\d)\s(?=\d{3}\b|%)")  # 2 000 and 5 %
EXPONENT = re.compile(r"(?<=\de-)(?=\d)")  # 1e-5
AS_WRITTEN = nodes.literal, nodes.FixedTextElement, nodes.math, nodes.math_block


def keep_numbers_whole(app, doctree):
    """No line ends within a number, or between a number and its percent sign."""
    for text in list(doctree.findall(nodes.Text)):
        whole = EXPONENT.sub("\N{WORD JOINER}", IN_NUMBER.sub("\N{NO-BREAK SPACE}", text))
        if whole != text and not isinstance(text.parent, AS_WRITTEN):
            text.parent.replace(text, nodes.Text(whole))


def room_for_code(app, pagename, templatename, context, doctree):
    """Examples have no column on the right: their lines are long."""
    if pagename.startswith("auto_examples/plot_"):
        context["theme_secondary_sidebar_items"] = []


def setup(app):
    """Equations are set before numpydoc rewrites the sections, examples are added after."""
    app.connect("autodoc-process-docstring", set_equations, priority=100)
    app.connect("autodoc-process-docstring", examples_that_use_it, priority=900)
    app.connect("autodoc-skip-member", only_ours)
    app.connect("doctree-read", keep_numbers_whole)
    app.connect("html-page-context", room_for_code, priority=100)
