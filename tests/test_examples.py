"""The gallery: what each example says and imports, and the check of the built site.

The examples themselves are run by the documentation build.
"""

import ast
import importlib
import importlib.util
import json
import re
from pathlib import Path

import pytest

import sklearn_hd

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("plot_*.py"))
PUBLIC = {  # modules that the API reference names
    "sklearn_hd",
    "sklearn_hd.algorithms.lti.hinf",
    "sklearn_hd.datasets",
    "sklearn_hd.design",
    "sklearn_hd.exceptions",
    "sklearn_hd.model_selection",
    "sklearn_hd.plotting",
    "sklearn_hd.systems",
}


def tree_of(example):
    return ast.parse(example.read_text(encoding="utf-8"))


def imports_of(example):
    """(module, name) of all imports; name is None for whole modules."""
    for node in ast.walk(tree_of(example)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield from ((module, alias.name) for alias in node.names)


def test_examples_are_numbered_one_by_one():
    numbers = [int(re.match(r"plot_(\d\d)_[a-z0-9_]+\.py", path.name)[1]) for path in EXAMPLES]
    assert numbers[:8] == list(range(1, 9))
    assert len(set(numbers)) == len(numbers)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_has_a_title_and_asks_a_question(example):
    title, line, *text = ast.get_docstring(tree_of(example)).splitlines()
    assert set(line) == {"="}
    assert len(line) == len(title)
    first_paragraph = "\n".join(text).strip().split("\n\n")[0]
    assert first_paragraph.endswith("?")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_ends_with_what_was_learned_and_with_links(example):
    end = example.read_text(encoding="utf-8").split("# What was learned\n")
    assert len(end) == 2
    assert re.search(r":(class|func|doc|ref):`", end[1])


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_imports_public_names_alone(example):
    for module, name in imports_of(example):
        assert not any(part.startswith(("_", ".")) for part in [*module.split("."), name or "x"])
        if module.split(".")[0] == sklearn_hd.__name__:
            assert module in PUBLIC
            assert name is None or name in public_names(importlib.import_module(module))


def public_names(module):
    """``__all__``; of exceptions, which has none, the classes."""
    return getattr(module, "__all__", None) or {n for n in vars(module) if not n.startswith("_")}


# ---- the check of the built site --------------------------------------------------------------


@pytest.fixture(scope="module")
def check_site():
    spec = importlib.util.spec_from_file_location("check_site", ROOT / "docs" / "check_site.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def site(tmp_path):
    """Two pages, a picture of one example, and an index of their words."""
    (tmp_path / "auto_examples").mkdir()
    (tmp_path / "index.html").write_text(
        '<a href="#here" id="here"></a><a href="auto_examples/index.html#top">examples</a>'
        '<a href="https://example.org/nowhere">elsewhere</a>'
    )
    (tmp_path / "auto_examples" / "index.html").write_text(
        '<p id="top"><a href="../index.html?x=1#here"></a>'
        '<img src="sphx_glr_plot_a_thumb.png" srcset="sphx_glr_plot_a_thumb.png 2x">'
    )
    (tmp_path / "auto_examples" / "sphx_glr_plot_a_thumb.png").touch()
    index = {"docnames": ["index"], "terms": {"moesp": 0}, "titleterms": {"trim": [0]}}
    (tmp_path / "searchindex.js").write_text(f"Search.setIndex({json.dumps(index)})")
    return tmp_path


def test_a_whole_site_passes(check_site, site, tmp_path_factory):
    examples = tmp_path_factory.mktemp("examples")
    (examples / "plot_a.py").touch()
    assert check_site.broken_links(site) == []
    assert check_site.missing_thumbnails(site, examples) == []
    assert check_site.missing_words(site, ["MOESP", "trim"]) == []


def test_broken_links_anchors_and_images_are_told(check_site, site):
    text = '<a href="gone.html"></a><a href="index.html#gone"></a><img srcset="a.png, b.png 2x">'
    (site / "page.html").write_text(text)
    assert check_site.broken_links(site) == [
        "page.html: nothing is at a.png",
        "page.html: nothing is at b.png",
        "page.html: nothing is at gone.html",
        "page.html: no anchor index.html#gone",
    ]


def test_thumbnails_words_and_pages_that_lack_are_told(check_site, site, tmp_path_factory):
    examples = tmp_path_factory.mktemp("examples")
    (examples / "plot_b.py").touch()
    told = check_site.missing_thumbnails(site, examples)
    assert told == ["auto_examples/index.html: no thumbnail of plot_b.py"]
    (site / "index.html").unlink()
    assert check_site.missing_words(site, ["MOESP", "zzz"]) == [
        "searchindex.js: 'zzz' is not found",
        "searchindex.js: page 'index' is not there",
    ]
    (site / "searchindex.js").unlink()
    assert check_site.missing_words(site) == ["there is no search index: searchindex.js"]


@pytest.mark.parametrize(
    ("cells", "told"),
    [
        (["x = 1\n", "x"], []),
        (["x = 1", "x + 1"], ["plot_a.ipynb: other code than plot_a.py"]),
        (None, ["auto_examples/plot_a.html: no notebook"]),
    ],
)
def test_notebooks_hold_the_code_of_their_example(check_site, tmp_path, cells, told):
    (tmp_path / "plot_a.py").write_text('"""Text."""\n\nx = 1\n\n# %%\n# More\n\nx\n')
    folder = tmp_path / "auto_examples"
    folder.mkdir()
    (folder / "plot_a.html").write_text('<a href="../plot_a.ipynb">notebook</a>')
    if cells is not None:
        text = [{"cell_type": "markdown", "source": ["Text."]}]
        code = [{"cell_type": "code", "source": [cell]} for cell in cells]
        (tmp_path / "plot_a.ipynb").write_text(json.dumps({"cells": text + code}))
    assert check_site.wrong_notebooks(tmp_path, tmp_path) == told


def test_what_a_browser_finds_is_told(check_site):
    narrow = {"page": "a.html", "scroll": 390, "width": 390, "wide": [], "blank": [], "unset": []}
    wide = narrow | {"page": "b.html", "scroll": 457, "wide": ["<table>"], "blank": ["c.png"]}
    wide |= {"unset": ["Missing close brace"]}
    report = {"pages": [narrow, wide], "hits": {"trim": 3, "MOESP": 0}}
    assert check_site.wrong_to_the_eye(report) == [
        "b.html: 457 px wide on a screen of 390 px: <table>",
        "b.html: image c.png is blank",
        "b.html: equation not set: Missing close brace",
        "search: no hit for 'MOESP'",
    ]
