# SPDX-License-Identifier: GPL-3.0-or-later
"""The pictures of `study.py`: learning curves and held-out errors."""

from pathlib import Path
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from fdda_addon.core.output import atomic_write

from .study_tables import held_out

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
"""Told apart by the color-blind too (Okabe and Ito)."""
GRAY = "#666666"
DASHES = (0, (4, 3))
LABEL, TICK = 9, 8
"""Sizes of text, points."""


def draw_curves(result: dict, path: Path) -> None:
    """Validation error by epoch: a row for each partition, a column for each size, a color for each activation."""
    sizes, colors = _configurations_by_size(result), _colors(result)
    names = result["partitions"]
    figure = Figure(figsize=(1.2 + 2.1 * len(sizes), 0.8 + 2.1 * len(names)), layout="constrained")
    grid = figure.subplots(len(names), len(sizes), sharex=True, sharey="row", squeeze=False)
    for axes_row, name in zip(grid, names, strict=True):
        for axes, (size, members) in zip(axes_row, sizes.items(), strict=True):
            for configuration in members:
                for training in configuration["trainings"]:
                    curve = training["partitions"][name]["curve"]["validation"]
                    color = colors[configuration["activation"]]
                    axes.plot(range(1, len(curve) + 1), curve, color=color, linewidth=0.9, alpha=0.85)
            axes.axhline(_basis_left(result, name, "validation"), color=GRAY, linewidth=0.8, linestyle=DASHES)
            axes.set_yscale("log")
            _style_axes(axes)
            if name == names[0]:
                axes.set_title(size, fontsize=LABEL)
        axes_row[0].set_ylabel(f"{name}\nvalidation error, mm", fontsize=LABEL)
    figure.supxlabel("epoch", fontsize=LABEL)
    _legend(figure, colors)
    _save(figure, path)


def draw_errors(result: dict, path: Path) -> None:
    """Held-out error: a panel for each partition, a row for each size, a dot for each seed."""
    sizes, colors = _configurations_by_size(result), _colors(result)
    names = result["partitions"]
    figure = Figure(figsize=(8.4, 0.9 + 0.55 * len(sizes)), layout="constrained")
    grid = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(grid, names, strict=True):
        for row, members in enumerate(sizes.values()):
            for place, configuration in enumerate(members):
                values = held_out(configuration, name)
                height = row + 0.2 * (place - (len(members) - 1) / 2)
                color = colors[configuration["activation"]]
                axes.plot(values, [height] * len(values), "o", color=color, markersize=4, alpha=0.7, markeredgewidth=0)
                axes.plot([fmean(values)] * 2, [height - 0.1, height + 0.1], color=color, linewidth=1.4)
        axes.axvline(_basis_left(result, name, "held_out"), color=GRAY, linewidth=0.8, linestyle=DASHES)
        axes.set_xlim(0, 1.04 * axes.get_xlim()[1])
        axes.set_yticks(range(len(sizes)), list(sizes))
        axes.set_ylim(len(sizes) - 0.5, -0.5)
        axes.set_xlabel(f"{name}: mean held-out error, mm", fontsize=LABEL)
        axes.grid(axis="x", color="#dddddd", linewidth=0.6)
        axes.tick_params(labelsize=TICK)
        axes.spines[["top", "right"]].set_visible(False)
    _legend(figure, colors)
    _save(figure, path)


def _configurations_by_size(result: dict) -> dict[str, list[dict]]:
    """The configurations by the size of their networks."""
    sizes: dict[str, list[dict]] = {}
    for configuration in result["configurations"]:
        sizes.setdefault(f"{configuration['layers']} layers of {configuration['units']}", []).append(configuration)
    return sizes


def _colors(result: dict) -> dict[str, str]:
    activations = dict.fromkeys(configuration["activation"] for configuration in result["configurations"])
    return dict(zip(activations, COLORS, strict=False))


def _basis_left(result: dict, name: str, poses: str) -> float:
    return fmean(t["partitions"][name]["basis_left"][poses] for c in result["configurations"] for t in c["trainings"])


def _style_axes(axes: Axes) -> None:
    """Numbers as they are written, not as powers of ten, and lines to read them by."""
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis="y", which="major", color="#dddddd", linewidth=0.6)
    axes.tick_params(labelsize=TICK)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(figure: Figure, colors: dict[str, str]) -> None:
    handles = [Line2D([], [], color=color, linewidth=2, label=name) for name, color in colors.items()]
    handles.append(Line2D([], [], color=GRAY, linewidth=1, linestyle=DASHES, label="a network without error"))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False, fontsize=LABEL)


def _save(figure: Figure, path: Path) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=160, format="png")
