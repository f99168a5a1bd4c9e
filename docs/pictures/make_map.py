# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw the layers of the code for docs/development.md: `make map`.

    python docs/pictures/make_map.py OUT.svg

The layout is that of a layered graph. An arrow that crosses a layer passes through a slot in it. Packages and slots
move horizontally until their arrows are short.
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
"""Name and color of each group of layers, by the package whose layer is the first of the group."""
TRAINER, TRAINER_COLOR = "trainer", "#8a6d3b"
WIDTH, HEIGHT, SLOT_WIDTH, GAP = 6.9, 1.72, 0.3, 0.55
"""Width and height of a package, width of the slot of an arrow, and gap between neighbors in a layer."""
LAYER_SPACING = 2.45
"""Vertical distance from one layer to the next."""
TEXT_COLOR, BACKGROUND_COLOR = "#222222", "#ffffff"
MAX_FILE_NAMES = 6
SENTENCE_WIDTH, FILE_NAMES_WIDTH = 48, 38
"""Maximum numbers of letters in a line of the sentence, and in the line of file names."""
LAYOUT_STEPS = 200


@dataclass(eq=False)
class Item:
    """A package, or the slot of an arrow that crosses a layer.

    Attributes:
        name: name of the package; empty for a slot.
        width: width in the picture.
        x: horizontal center.
        above, below: the items that arrows connect with this one.
    """

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


def first_docstring_sentence(package: str) -> str:
    """Return the first sentence of a package's docstring."""
    file = ROOT / "fdda_addon" / Path(*package.split("."))
    if package == TRAINER:
        file = ROOT / TRAINER
    file = file / "__init__.py" if file.is_dir() else file.with_suffix(".py")
    text = " ".join((ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "").split())
    return text.partition(". ")[0].rstrip(".").replace("`", "")


def most_imported_files(package: str) -> list[str]:
    """Return the names of the files of a package, the ones that other packages import most first."""
    files = {module_of(file): file for file in files_of(package) if file.name != "__init__.py"}
    graph = import_graph(TRAINER if package == TRAINER else "fdda_addon")
    inside, outside = (
        Counter(name for module, imported in graph.items() if (module in files) == is_inside for name in imported)
        for is_inside in (True, False)
    )
    ranked = sorted(files, key=lambda module: (-outside[module], -inside[module], -_lines(files[module])))
    return [files[module].stem for module in ranked[:MAX_FILE_NAMES]]


def _lines(file: Path) -> int:
    return len(file.read_text(encoding="utf-8").splitlines())


def direct_imports() -> dict[str, set[str]]:
    """Return the imports of each package, without those that it also reaches through other packages."""
    graph = package_graph()
    indirect = {package: _indirect_imports(graph, package) for package in graph}
    return {
        package: {
            other
            for other in imported
            if not any(other in indirect[intermediate] for intermediate in imported - {other})
        }
        for package, imported in graph.items()
    }


def _indirect_imports(graph: dict[str, set[str]], package: str) -> set[str]:
    """Return all packages that a package imports, directly or through others."""
    imported: set[str] = set()
    pending = [package]
    while pending:
        for other in graph[pending.pop()] - imported:
            imported.add(other)
            pending.append(other)
    return imported


def place_items(layers: list[list[str]], edges: dict[str, set[str]]) -> tuple[list[list[Item]], dict[str, Item]]:
    """Return the items of each layer from left to right, and the packages by name."""
    layer_of = {package: layer for layer, packages in enumerate(layers) for package in packages}
    packages = {package: Item(package, WIDTH) for package in layer_of}
    rows = [[packages[package] for package in layer] for layer in layers]
    for package, imported in sorted(edges.items()):
        for other in sorted(imported):
            upper_item = packages[package]
            for layer in range(layer_of[package] + 1, layer_of[other]):
                slot = Item("", SLOT_WIDTH)
                rows[layer].append(slot)
                upper_item = _connect(upper_item, slot)
            _connect(upper_item, packages[other])
    for row in rows:
        _remove_overlaps(row)
    for step in range(LAYOUT_STEPS):
        order = range(len(rows)) if step % 2 else reversed(range(len(rows)))
        for layer in order:
            row = rows[layer]
            for item in row:
                neighbor_positions = [other.x for other in (*item.above, *item.below)]
                item.x = sum(neighbor_positions) / len(neighbor_positions) if neighbor_positions else 0.0
            if step < LAYOUT_STEPS / 2:
                row.sort(key=lambda item: item.x)
            _remove_overlaps(row)
    return rows, packages


def _connect(above: Item, below: Item) -> Item:
    above.below.append(below)
    below.above.append(above)
    return below


def _remove_overlaps(row: list[Item]) -> None:
    """Move overlapping items apart, keeping their order and the middle of each pair."""
    for _ in range(LAYOUT_STEPS):
        has_moved = False
        for left, right in itertools.pairwise(row):
            overlap = (left.width + right.width) / 2 + GAP - (right.x - left.x)
            if overlap > 1e-3:
                left.x, right.x, has_moved = left.x - overlap / 2, right.x + overlap / 2, True
        if not has_moved:
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
    edges = direct_imports()
    rows, packages = place_items([list(layer) for layer in LAYERS], edges)
    y = {item: -layer * LAYER_SPACING for layer, row in enumerate(rows) for item in row}
    if packages["training"].x < max(
        packages[package].x for layer in LAYERS if "training" in layer for package in layer
    ):
        # `training` has an arrow to the trainer, which is drawn on the right, so it should be on the right too.
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
    figure.patch.set_facecolor(BACKGROUND_COLOR)
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
    """Draw the trainer beside the layers, with an arrow from the package that starts it and one to what it imports."""
    trainer, training, used = packages[TRAINER], packages["training"], packages["core.checks"]
    width, height = trainer.width + 0.6, HEIGHT + 1.3
    axes.add_patch(_box(trainer.x - width / 2, y[trainer] - HEIGHT / 2 - 0.35, width, height, TRAINER_COLOR, 0.09, 0.3))
    text = "another process, with PyTorch and without Blender"
    axes.text(trainer.x, y[trainer] + HEIGHT / 2 + 0.45, text, ha="center", size=10, color=TRAINER_COLOR)
    # The arrow runs below the layer of `training`, where it crosses no package.
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
    box = _box(x, y - HEIGHT / 2, item.width, HEIGHT, BACKGROUND_COLOR, 1.0, 0.16)
    box.set(edgecolor=color, linewidth=1.6, zorder=2)
    axes.add_patch(box)
    files = files_of(item.name)
    lines = sum(map(_lines, files))
    count = f"{len(files)} files, {lines:,} lines" if len(files) > 1 else f"{lines:,} lines"
    axes.text(x + 0.2, y + 0.58, item.name, size=13, weight="bold", color=color, va="center", zorder=3)
    axes.text(x + item.width - 0.2, y + 0.58, count, size=9, color="#666666", ha="right", va="center", zorder=3)
    text = "\n".join(textwrap.wrap(first_docstring_sentence(item.name), SENTENCE_WIDTH, max_lines=2, placeholder=" …"))
    axes.text(x + 0.2, y + 0.33, text, size=9, color=TEXT_COLOR, va="top", zorder=3, linespacing=1.3)
    if len(files) > 1:
        names = textwrap.shorten(" ".join(most_imported_files(item.name)), FILE_NAMES_WIDTH, placeholder="").replace(
            " ", "  "
        )
        axes.text(x + 0.2, y - 0.62, names, size=8.5, color=color, va="center", zorder=3, family="DejaVu Sans Mono")


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
