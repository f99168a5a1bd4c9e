# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the layers of the code for docs/development.md: `make map`.

    python docs/pictures/make_map.py OUT.svg

The layout is that of a layered graph: an arrow that crosses a layer takes a slot in it, and packages and slots move to
where their arrows are short.
"""

import ast
import itertools
import sys
import textwrap
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.path import Path as Curve

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.contract.layers import LAYERS, ROOT, import_graph, module_of, package_graph, package_of

GROUPS = {
    "__init__": ("what people touch", "#c8553d"),
    "models": ("the work", "#2f6690"),
    "rig": ("Blender's data", "#3a7d44"),
    "core.checks": ("without Blender", "#6b5b95"),
}
"""From the layer of this package down: the name of the group of layers, and its color."""
TRAINER, TRAINER_COLOR = "trainer", "#8a6d3b"
WIDTH, HEIGHT, LANE, GAP = 6.9, 1.72, 0.3, 0.55
"""Of a package, of the slot of an arrow, and between two of either."""
LAYER_SPACING = 2.45
"""From one layer to the next."""
INK, PAPER = "#222222", "#ffffff"
MAIN_FILES = 6
SENTENCE, FILES = 48, 44
"""Letters in a line."""
SETTLING = 200


@dataclass(eq=False)
class Item:
    """A package, or the slot of an arrow that crosses a layer; `x` is its center."""

    name: str
    width: float
    x: float = 0.0
    above: list["Item"] = field(default_factory=list)
    below: list["Item"] = field(default_factory=list)


def files_of(package: str) -> list[Path]:
    """Return the files of a package, without those of nested packages."""
    if package == TRAINER:
        return sorted((ROOT / TRAINER).rglob("*.py"))
    return [
        file
        for file in sorted((ROOT / "fdda_addon").rglob("*.py"))
        if package_of(module_of(file).removeprefix("fdda_addon").lstrip(".")) == package
    ]


def purpose(package: str) -> str:
    """Return the first sentence of a package's docstring."""
    file = ROOT / "fdda_addon" / Path(*package.split("."))
    if package == TRAINER:
        file = ROOT / TRAINER
    file = file / "__init__.py" if file.is_dir() else file.with_suffix(".py")
    text = " ".join((ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "").split())
    return text.partition(". ")[0].rstrip(".").replace("`", "")


def main_files(package: str) -> list[str]:
    """Return the files of a package, those that other packages import most first."""
    files = {module_of(file): file for file in files_of(package) if file.name != "__init__.py"}
    graph = import_graph(TRAINER if package == TRAINER else "fdda_addon")
    inside, outside = (
        Counter(name for module, imported in graph.items() if (module in files) == own for name in imported)
        for own in (True, False)
    )
    ranked = sorted(files, key=lambda module: (-outside[module], -inside[module], -_lines(files[module])))
    return [files[module].stem for module in ranked[:MAIN_FILES]]


def _lines(file: Path) -> int:
    return len(file.read_text(encoding="utf-8").splitlines())


def arrows() -> dict[str, set[str]]:
    """Who imports from whom, without what follows from the other arrows."""
    graph = package_graph()
    below = {package: _reached(graph, package) for package in graph}
    return {
        package: {other for other in imported if not any(other in below[third] for third in imported - {other})}
        for package, imported in graph.items()
    }


def _reached(graph: dict[str, set[str]], package: str) -> set[str]:
    found: set[str] = set()
    waiting = [package]
    while waiting:
        for other in graph[waiting.pop()] - found:
            found.add(other)
            waiting.append(other)
    return found


def place(layers: list[list[str]], edges: dict[str, set[str]]) -> tuple[list[list[Item]], dict[str, Item]]:
    """Return the items of each layer from left to right, and the packages by name."""
    number = {package: layer for layer, packages in enumerate(layers) for package in packages}
    packages = {package: Item(package, WIDTH) for package in number}
    rows = [[packages[package] for package in layer] for layer in layers]
    for package, below in sorted(edges.items()):
        for other in sorted(below):
            last = packages[package]
            for layer in range(number[package] + 1, number[other]):
                lane = Item("", LANE)
                rows[layer].append(lane)
                last = _join(last, lane)
            _join(last, packages[other])
    for row in rows:
        _spread(row)
    for turn in range(SETTLING):
        order = range(len(rows)) if turn % 2 else reversed(range(len(rows)))
        for layer in order:
            row = rows[layer]
            for item in row:
                near = [other.x for other in (*item.above, *item.below)]
                item.x = sum(near) / len(near) if near else 0.0
            if turn < SETTLING / 2:
                row.sort(key=lambda item: item.x)
            _spread(row)
    return rows, packages


def _join(above: Item, below: Item) -> Item:
    above.below.append(below)
    below.above.append(above)
    return below


def _spread(row: list[Item]) -> None:
    """Move items apart that overlap, in their order, with their common middle where it was."""
    for _ in range(SETTLING):
        moved = False
        for left, right in itertools.pairwise(row):
            lacking = (left.width + right.width) / 2 + GAP - (right.x - left.x)
            if lacking > 1e-3:
                left.x, right.x, moved = left.x - lacking / 2, right.x + lacking / 2, True
        if not moved:
            return


def _curve(item: Item, other: Item, y: dict[Item, float]) -> Curve:
    """Return the curve from the bottom of a package through the slots of an arrow to the top of another package."""
    start, points = y[item] - HEIGHT / 2, [(item.x, y[item] - HEIGHT / 2)]
    codes, below = [Curve.MOVETO], other
    x = item.x
    while True:
        end = y[below] + HEIGHT / 2
        middle = (start + end) / 2
        points += [(x, middle), (below.x, middle), (below.x, end)]
        codes += [Curve.CURVE4] * 3
        if below.name:
            return Curve(points, codes)
        points.append((below.x, y[below] - HEIGHT / 2))
        codes.append(Curve.LINETO)
        x, start, below = below.x, y[below] - HEIGHT / 2, below.below[0]


def draw(path: Path) -> None:
    """Draw the map into a file."""
    matplotlib.rcParams.update({"svg.hashsalt": "fdda", "font.family": "DejaVu Sans"})
    edges = arrows()
    rows, packages = place([list(layer) for layer in LAYERS], edges)
    y = {item: -layer * LAYER_SPACING for layer, row in enumerate(rows) for item in row}
    if packages["training"].x < max(
        packages[package].x for layer in LAYERS if "training" in layer for package in layer
    ):
        # Towards the process that it starts, which is drawn on the right.
        for item in y:
            item.x = -item.x
    colors, group = {}, None
    spans: dict[tuple[str, str], list[int]] = {}
    for layer, row in enumerate(LAYERS):
        group = next((GROUPS[package] for package in row if package in GROUPS), group)
        colors |= dict.fromkeys(row, group[1])
        spans.setdefault(group, []).append(layer)
    left = min(item.x - item.width / 2 for row in rows for item in row) - 0.6
    right = max(item.x + item.width / 2 for row in rows for item in row) + 0.6
    trainer = Item(TRAINER, WIDTH, right + 1.6 + WIDTH / 2)
    packages[TRAINER], colors[TRAINER] = trainer, TRAINER_COLOR
    y[trainer] = y[packages["training"]]
    low, high = -(len(rows) - 1) * LAYER_SPACING - 1.2, 1.2
    end = trainer.x + WIDTH / 2 + 0.7
    figure = Figure(figsize=((end - left + 1.2) / 2, (high - low) / 2))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(left - 1.2, end), ylim=(low, high))
    axes.axis("off")
    figure.patch.set_facecolor(PAPER)
    for (text, color), numbers in spans.items():
        top, bottom = -numbers[0] * LAYER_SPACING + LAYER_SPACING / 2, -numbers[-1] * LAYER_SPACING - LAYER_SPACING / 2
        axes.add_patch(_box(left, bottom + 0.08, right - left, top - bottom - 0.16, color, 0.07, 0.3))
        axes.text(left - 0.55, (top + bottom) / 2, text, rotation=90, ha="center", va="center", size=15, color=color)
    for package in edges:
        for item in packages[package].below:
            _arrow(axes, _curve(packages[package], item, y), colors[package])
    _draw_trainer(axes, packages, y)
    for name, item in packages.items():
        _draw_package(axes, item, y[item], colors[name])
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None, dpi=100)


def _draw_trainer(axes, packages: dict[str, Item], y: dict[Item, float]) -> None:
    """The building beside: who starts it, and what it uses of the other."""
    trainer, training, used = packages[TRAINER], packages["training"], packages["core.checks"]
    width, height = trainer.width + 0.6, HEIGHT + 1.3
    axes.add_patch(_box(trainer.x - width / 2, y[trainer] - HEIGHT / 2 - 0.35, width, height, TRAINER_COLOR, 0.09, 0.3))
    text = "another process, with PyTorch and without Blender"
    axes.text(trainer.x, y[trainer] + HEIGHT / 2 + 0.45, text, ha="center", size=10, color=TRAINER_COLOR)
    # Below its layer, where no package is in the way.
    start, level, turn = training.x + 0.4 * training.width, y[training] - HEIGHT / 2 - 0.4, trainer.x - width / 2 - 0.6
    points = [(start, level + 0.4), (start, level), (turn, level), (turn, y[trainer])]
    _arrow(axes, Curve([*points, (trainer.x - trainer.width / 2, y[trainer])]), GROUPS["models"][1], "--")
    text = "starts, and reads its messages"
    axes.text(turn - 0.9, level + 0.08, text, ha="right", size=9, color=GROUPS["models"][1])
    down, level = trainer.x, y[used]
    points = [(down, y[trainer] - HEIGHT / 2), (down, level + 1), (down, level), (down - 1, level)]
    codes = [Curve.MOVETO, Curve.LINETO, Curve.CURVE3, Curve.CURVE3, Curve.LINETO]
    _arrow(axes, Curve([*points, (used.x + used.width / 2, level)], codes), TRAINER_COLOR)


def _box(x: float, y: float, width: float, height: float, color: str, alpha: float, radius: float) -> FancyBboxPatch:
    style = f"round,pad=0,rounding_size={radius}"
    return FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor=color, alpha=alpha, linewidth=0, zorder=0)


def _arrow(axes, curve: Curve, color: str, style: str = "-") -> None:
    axes.add_patch(
        FancyArrowPatch(
            path=curve, arrowstyle="-|>", mutation_scale=13, color=color, linewidth=1.5, linestyle=style, zorder=1
        )
    )


def _draw_package(axes, item: Item, y: float, color: str) -> None:
    x = item.x - item.width / 2
    box = _box(x, y - HEIGHT / 2, item.width, HEIGHT, PAPER, 1.0, 0.16)
    box.set(edgecolor=color, linewidth=1.6, zorder=2)
    axes.add_patch(box)
    files = files_of(item.name)
    lines = sum(map(_lines, files))
    count = f"{len(files)} files, {lines:,} lines" if len(files) > 1 else f"{lines:,} lines"
    axes.text(x + 0.2, y + 0.58, item.name, size=13, weight="bold", color=color, va="center", zorder=3)
    axes.text(x + item.width - 0.2, y + 0.58, count, size=9, color="#666666", ha="right", va="center", zorder=3)
    text = "\n".join(textwrap.wrap(purpose(item.name), SENTENCE, max_lines=2, placeholder=" …"))
    axes.text(x + 0.2, y + 0.33, text, size=9, color=INK, va="top", zorder=3, linespacing=1.3)
    if len(files) > 1:
        names = textwrap.shorten(" ".join(main_files(item.name)), FILES, placeholder="").replace(" ", "  ")
        axes.text(x + 0.2, y - 0.62, names, size=8.5, color=color, va="center", zorder=3, family="DejaVu Sans Mono")


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
