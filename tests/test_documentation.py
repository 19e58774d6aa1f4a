"""Every page runs, shows what its code prints, and quotes messages that the code gives."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest
from numpy.testing import assert_allclose

import sklearn_hd

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
WHOLE = re.compile(r"[-+−]?\d+")


def blocks(page):
    """(language, text) of the fenced blocks of a page, in order."""
    return BLOCK.findall((ROOT / page).read_text(encoding="utf-8"))


def pages():
    """Pages that hold Python."""
    files = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    names = [path.relative_to(ROOT).as_posix() for path in files if "_build" not in path.parts]
    return [name for name in names if any(kind == "python" for kind, _ in blocks(name))]


def run(page, capsys):
    """Names that the Python blocks of a page define, and what each block prints and says."""
    namespace, shown = {"__name__": "__main__"}, []
    for kind, text in blocks(page):
        if kind == "python":
            exec(compile(text, page, "exec"), namespace)
            shown.append([capsys.readouterr().out, None])
        elif kind == "text" and shown and shown[-1][1] is None and shown[-1][0]:
            shown[-1][1] = text
    return namespace, shown


def assert_same_output(shown, stated):
    """Equal words and whole numbers; others may differ by machine in their last digits."""
    words, numbers = (
        [find(text) for text in (shown, stated)]
        for find in (lambda text: NUMBER.sub("#", text).split(), NUMBER.findall)
    )
    assert words[0] == words[1], f"the page states\n{stated}\nand its code prints\n{shown}"
    for here, there in zip(*numbers, strict=True):
        counted = WHOLE.fullmatch(there)
        last = 10.0 ** -len(there.partition("e")[0].partition(".")[2])
        here, there = (float(number.replace("−", "-")) for number in (here, there))
        if counted:
            assert here == there, f"the page states\n{stated}\nand its code prints\n{shown}"
        assert abs(here - there) <= 0.02 * abs(there) + last


@pytest.mark.parametrize("page", pages())
@pytest.mark.slow
def test_page_runs_and_prints_what_it_states(page, capsys, tmp_path, monkeypatch):
    mpl.use("Agg")
    monkeypatch.chdir(tmp_path)
    plt.close("all")
    namespace, shown = run(page, capsys)
    drawn = len(plt.get_fignums())
    plt.close("all")
    if page.startswith("docs/guide/") or page == "docs/get_started.md":
        pictures = re.findall(r"^```\{image\} (\S+)$", (ROOT / page).read_text(), re.MULTILINE)
        assert drawn == len(pictures), "python docs/draw_pages.py draws what a page shows"
    for printed, stated in shown:
        if stated is not None:
            assert_same_output(printed, stated)
    if page == "README.md":
        assert namespace["y_new"].index.equals(namespace["u"].index)
        truth, found = (each.floquet_exponents().real for each in (
            namespace["data"].ltp, namespace["pipe"]["match"].ltp_))  # fmt: skip
        assert_allclose(found, truth, rtol=5e-3)


def test_no_line_of_a_page_begins_within_a_number():
    """A line that begins with % is a comment there, and is not shown."""
    for path in (ROOT / "docs").rglob("*.md"):
        prose = BLOCK.sub("", path.read_text(encoding="utf-8"))
        cut = re.findall(r"^\s*%.*|\d\n\s*\d{3}\b.*", prose, re.MULTILINE)
        assert not cut, f"{path.relative_to(ROOT)}: {cut}"


def templates(node):
    """Texts in some code, … for what is filled in."""
    for part in ast.walk(node):
        if isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield part.value
        elif isinstance(part, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else "…" for v in part.values)


@pytest.mark.slow
def test_messages_quoted_are_those_of_the_code():
    quoted = [" ".join(text.split()) for kind, text in blocks("docs/faq.md") if kind == "text"]
    assert len(quoted) > 30
    sources = Path(sklearn_hd.__file__).parent.rglob("*.py")
    worded = [
        text for path in sources for text in templates(ast.parse(path.read_text(encoding="utf-8")))
    ]
    for message in quoted:
        literal = re.compile(".*?".join(map(re.escape, message.split("…"))))
        assert any(literal.search(text) for text in worded), f"no longer said so: {message}"


@pytest.mark.slow
def test_studies_and_benchmarks_find_all_that_they_import():
    folder = ROOT / "docs" / "benchmarks"
    names = ", ".join(path.stem for path in sorted(folder.glob("*.py")))
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import {names}"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
