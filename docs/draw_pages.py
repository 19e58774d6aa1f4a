"""Draw the pictures of the pages: those that the Python blocks of a page draw.

    python docs/draw_pages.py [PAGE ...]

Blocks run in order, in one namespace. The figures that a block leaves open go into the files that
the ``{image}`` directives between it and the next block name, in order. Without a page: all pages
that show what their code draws.
"""

import re
import sys
import tempfile
from contextlib import chdir
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt

DOCS = Path(__file__).resolve().parent
PAGES = ("get_started.md", "frequency_domain.md", *(f"guide/{k}.md" for k in (
    "1_data", "2_harmonics", "3_subspace", "4_spurious_modes", "5_matching")))  # fmt: skip
BLOCK = re.compile(
    r"^```python\n(?P<code>.*?)^```$|^```\{image\} (?P<image>\S+)$", re.DOTALL | re.MULTILINE
)


def draw(page):
    """Run a page, and save what it draws."""
    namespace, drawn = {"__name__": "__main__"}, []
    for block in BLOCK.finditer(page.read_text(encoding="utf-8")):
        if block["code"] is not None:
            if drawn:
                raise ValueError(f"{page.name}: {len(drawn)} figure(s) drawn, but not shown")
            exec(compile(block["code"], page.name, "exec"), namespace)
            drawn = [plt.figure(number) for number in plt.get_fignums()]
            continue
        if not drawn:
            raise ValueError(f"{page.name}: no figure was drawn for {block['image']}")
        figure = drawn.pop(0)
        figure.savefig(page.parent / block["image"], dpi=120, bbox_inches="tight")
        plt.close(figure)


if __name__ == "__main__":
    mpl.use("agg")
    with tempfile.TemporaryDirectory() as folder, chdir(folder):  # pages write files, too
        for name in sys.argv[1:] or PAGES:
            draw(DOCS / name)
