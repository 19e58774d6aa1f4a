"""Draw the rooms of the package by layer: docs/images/house.png.

    python docs/draw_house.py [FILE]

Layers are those that tests/test_layers.py holds; sizes and imports are read from the code. An
import is drawn where no other way leads from one room to the other.
"""

import ast
import importlib.util
import sys
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "sklearn_hd"
TOOLS = {"exceptions", "_checks", "_guards", "_clock", "_containers"}
STEPS = ("harmonics", "subspace", "reduction", "matching")
SIDE_BY_SIDE = (
    *STEPS,
    "_model_step",
    "_simulators",
    "_identify",
    "_reduce",
    "_match",
)  # others by name


def layers():
    """Rooms from left to right, the topics of algorithms among them."""
    spec = importlib.util.spec_from_file_location("layers", ROOT / "tests" / "test_layers.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    rows = []
    for names in module.LAYERS:
        if "algorithms" in names:
            rows += [sorted(f"algorithms/{topic}" for topic in row) for row in module.TOPICS]
        elif names & TOOLS:
            rows.append(["tools"])
        elif names != {"__init__"}:
            rows.append(sorted(sorted(names), key=lambda name: (*SIDE_BY_SIDE, name).index(name)))
    return rows


def room(path):
    """Room of a file."""
    parts = path.relative_to(PACKAGE).parts
    name = parts[0].removesuffix(".py")
    if name == "algorithms" and len(parts) > 2:
        return f"algorithms/{parts[1]}"
    return "tools" if name in TOOLS else name


def imports(path):
    """Rooms that a file imports from."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sklearn_hd."):
            found = PACKAGE.joinpath(*node.module.split(".")[1:])
            yield room(found / "_" if found.is_dir() else found.with_suffix(".py"))


def measured():
    """Lines of each room, and the rooms that it imports from."""
    lines, arrows = {}, {}
    for path in PACKAGE.rglob("*.py"):
        here = room(path)
        lines[here] = lines.get(here, 0) + path.read_text(encoding="utf-8").count("\n")
        arrows.setdefault(here, set()).update(set(imports(path)) - {here})
    return lines, arrows


def reached(start, arrows):
    """All rooms that lie behind some room."""
    seen, left = set(), [start]
    while left:
        new = arrows.get(left.pop(), set()) - seen
        seen |= new
        left += new
    return seen


def shortest(arrows):
    """Imports that no other way replaces."""
    return {
        here: {
            there
            for there in direct
            if not any(there in reached(other, arrows) for other in direct - {there})
        }
        for here, direct in arrows.items()
    }


def draw(file):
    """Draw the rooms, what others build on at the bottom."""
    lines, arrows = measured()
    rows = layers()
    width = max(map(len, rows))
    figure, ax = plt.subplots(figsize=(11.5, 0.82 * len(rows)))
    places = {}
    for level, names in enumerate(rows):
        for k, name in enumerate(names):
            x = (k - (len(names) - 1) / 2) * (1.0 if len(names) < width else 0.98)
            places[name] = x, float(level)
    for here, direct in shortest(arrows).items():
        for there in direct & set(places) if here in places else ():
            ax.annotate(
                "",
                places[there],
                places[here],
                arrowprops={"arrowstyle": "-", "color": "0.75", "lw": 0.9},
                zorder=1,
            )
    for name, (x, y) in places.items():
        color = "#cfe2f3" if name.startswith("algorithms") else "#f3f3f3"
        color = "#ffe0b3" if name in STEPS else color
        style = {"boxstyle": "round,pad=0.02", "facecolor": color, "edgecolor": "0.4"}
        ax.add_patch(FancyBboxPatch((x - 0.45, y - 0.29), 0.9, 0.58, **style, zorder=2))
        ax.text(x, y + 0.1, name, ha="center", va="center", fontsize=8.5, zorder=3)
        size = f"{lines.get(name, 0)} lines"
        ax.text(x, y - 0.16, size, ha="center", va="center", fontsize=7, color="0.35", zorder=3)
    ax.set_xlim(-width / 2 - 0.1, width / 2 + 0.1)
    ax.set_ylim(-0.5, len(rows) - 0.5)
    ax.axis("off")
    figure.savefig(file, dpi=120, bbox_inches="tight")


if __name__ == "__main__":
    draw(sys.argv[1] if len(sys.argv) > 1 else ROOT / "docs" / "images" / "house.png")
