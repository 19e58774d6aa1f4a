"""Draw the way from a record to a model, step by step: docs/images/method.png.

python docs/draw_method.py [FILE]
"""

import sys
from itertools import pairwise
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).resolve().parents[1]
STEPS = (  # number and task, class, what comes out
    ("1  Data", "DataFrames", "inputs $u(t)$,\noutputs $y(t)$,\nfrequency $\\omega$"),
    ("2  Harmonics", "HarmonicAnalyzer",
        "rows to identify from:\ncoefficients,\nperiods or samples"),
    ("3  Subspace", "MOESPRegressor", "discrete model,\nits order"),
    ("4  Spurious modes", "SpuriousModeReducer", "genuine modes,\ncontinuous time"),
    ("5  Matching", "StructuredMatcher",
        "$F(\\psi),\\, G(\\psi),\\, P(\\psi),\\, Q(\\psi)$,\nharmonic decomposition"),
)  # fmt: skip
READINGS = (  # height of the lane, name, what a row is, colour
    (2.35, "sliding", "a window moves over the record", "#d55e00"),
    (1.9, "period", "one row per period", "#0072b2"),
    (1.45, "sample", "every sample, at its azimuth", "#009e73"),
)
PITCH, WIDTH, HEIGHT = 2.45, 2.05, 0.72  # of the boxes


def box(ax, x, y, width, height, color):
    style = {"boxstyle": "round,pad=0.03", "facecolor": color, "edgecolor": "0.35", "lw": 0.9}
    ax.add_patch(FancyBboxPatch((x - width / 2, y - height / 2), width, height, **style, zorder=3))


def arrow(ax, start, end, color="0.35"):
    style = {"arrowstyle": "-|>", "color": color, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", end, start, arrowprops=style, zorder=2)


def draw(file):
    """Five boxes from left to right, what comes out of each, and the three readings between."""
    figure, ax = plt.subplots(figsize=(11.8, 4.5))
    places = [k * PITCH for k in range(len(STEPS))]
    for x, (task, name, result) in zip(places, STEPS, strict=True):
        box(ax, x, 3.5, WIDTH, HEIGHT, "#f3f3f3" if name == "DataFrames" else "#ffe0b3")
        ax.text(x, 3.63, task, ha="center", va="center", fontsize=10, weight="bold", zorder=4)
        ax.text(x, 3.34, name, ha="center", va="center", fontsize=9, family="monospace", zorder=4)
        ax.text(x, 0.45, result, ha="center", va="center", fontsize=10, linespacing=1.4)
    for left, right in pairwise(places):
        arrow(ax, (left + WIDTH / 2 + 0.03, 3.5), (right - WIDTH / 2 - 0.03, 3.5))
    ax.text(places[0], 1.9, "reading", ha="center", va="center", fontsize=11, style="italic")
    for y, name, row, color in READINGS:
        start, end = places[1] - WIDTH / 2, places[4] + WIDTH / 2
        ax.plot([start, end - 0.1], [y, y], color=color, lw=1.6, zorder=1)
        arrow(ax, (end - 0.1, y), (end, y), color)
        ax.text(start, y + 0.08, f"{name}: {row}", fontsize=9, color=color, va="bottom")
        reduced = name == "sliding"
        text = "copies, window memory removed" if reduced else "has none: passes through"
        ax.text(places[3], y + 0.08, text, fontsize=9, color=color, ha="center", va="bottom")
    ax.text(places[0], 1.05, "what comes out:", ha="center", va="center", fontsize=9, color="0.35")
    ax.axhline(1.2, 0.01, 0.99, color="0.85", lw=0.8)
    ax.set_xlim(-WIDTH / 2 - 0.1, places[-1] + WIDTH / 2 + 0.1)
    ax.set_ylim(0.0, 3.95)
    ax.axis("off")
    figure.savefig(file, dpi=130, bbox_inches="tight")


if __name__ == "__main__":
    draw(sys.argv[1] if len(sys.argv) > 1 else ROOT / "docs" / "images" / "method.png")
