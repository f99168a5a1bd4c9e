# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw the pictures of `study.py`: learning curves and held-out errors."""

from pathlib import Path
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from fdda_addon.core.output import atomic_write

from .study_tables import held_out_errors

ACTIVATION_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
"""Colors that color-blind readers can distinguish (Okabe and Ito)."""
GRAY = "#666666"
DASHED_LINE = (0, (4, 3))
LABEL_SIZE, TICK_LABEL_SIZE = 9, 8
"""Font sizes, points."""


def draw_curves(result: dict, path: Path) -> None:
    """Plot the validation error by epoch: one row per partition, one column per size, one color per activation."""
    sizes, colors = _configurations_by_size(result), _colors_by_activation(result)
    names = result["partitions"]
    figure = Figure(figsize=(1.2 + 2.1 * len(sizes), 0.8 + 2.1 * len(names)), layout="constrained")
    grid = figure.subplots(len(names), len(sizes), sharex=True, sharey="row", squeeze=False)
    for axes_row, name in zip(grid, names, strict=True):
        for axes, (size, configurations) in zip(axes_row, sizes.items(), strict=True):
            for configuration in configurations:
                for training in configuration["trainings"]:
                    curve = training["partitions"][name]["curve"]["validation"]
                    color = colors[configuration["activation"]]
                    axes.plot(range(1, len(curve) + 1), curve, color=color, linewidth=0.9, alpha=0.85)
            axes.axhline(
                _mean_truncation_error(result, name, "validation"), color=GRAY, linewidth=0.8, linestyle=DASHED_LINE
            )
            axes.set_yscale("log")
            _style_axes(axes)
            if name == names[0]:
                axes.set_title(size, fontsize=LABEL_SIZE)
        axes_row[0].set_ylabel(f"{name}\nvalidation error, mm", fontsize=LABEL_SIZE)
    figure.supxlabel("epoch", fontsize=LABEL_SIZE)
    _add_legend(figure, colors)
    _save(figure, path)


def draw_errors(result: dict, path: Path) -> None:
    """Plot the held-out errors, with one panel per partition, one row per size and one dot per seed."""
    sizes, colors = _configurations_by_size(result), _colors_by_activation(result)
    names = result["partitions"]
    figure = Figure(figsize=(8.4, 0.9 + 0.55 * len(sizes)), layout="constrained")
    grid = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(grid, names, strict=True):
        for row, configurations in enumerate(sizes.values()):
            for index, configuration in enumerate(configurations):
                errors_mm = held_out_errors(configuration, name)
                y_position = row + 0.2 * (index - (len(configurations) - 1) / 2)
                color = colors[configuration["activation"]]
                axes.plot(
                    errors_mm,
                    [y_position] * len(errors_mm),
                    "o",
                    color=color,
                    markersize=4,
                    alpha=0.7,
                    markeredgewidth=0,
                )
                axes.plot([fmean(errors_mm)] * 2, [y_position - 0.1, y_position + 0.1], color=color, linewidth=1.4)
        axes.axvline(_mean_truncation_error(result, name, "held_out"), color=GRAY, linewidth=0.8, linestyle=DASHED_LINE)
        axes.set_xlim(0, 1.04 * axes.get_xlim()[1])
        axes.set_yticks(range(len(sizes)), list(sizes))
        axes.set_ylim(len(sizes) - 0.5, -0.5)
        axes.set_xlabel(f"{name}: mean held-out error, mm", fontsize=LABEL_SIZE)
        axes.grid(axis="x", color="#dddddd", linewidth=0.6)
        axes.tick_params(labelsize=TICK_LABEL_SIZE)
        axes.spines[["top", "right"]].set_visible(False)
    _add_legend(figure, colors)
    _save(figure, path)


def _configurations_by_size(result: dict) -> dict[str, list[dict]]:
    """Group the configurations by the size of their networks."""
    sizes: dict[str, list[dict]] = {}
    for configuration in result["configurations"]:
        sizes.setdefault(f"{configuration['layers']} layers of {configuration['units']}", []).append(configuration)
    return sizes


def _colors_by_activation(result: dict) -> dict[str, str]:
    activations = dict.fromkeys(configuration["activation"] for configuration in result["configurations"])
    return dict(zip(activations, ACTIVATION_COLORS, strict=False))


def _mean_truncation_error(result: dict, name: str, poses: str) -> float:
    return fmean(t["partitions"][name]["basis_left"][poses] for c in result["configurations"] for t in c["trainings"])


def _style_axes(axes: Axes) -> None:
    """Write the tick labels as decimal numbers, not as powers of ten, and add grid lines."""
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis="y", which="major", color="#dddddd", linewidth=0.6)
    axes.tick_params(labelsize=TICK_LABEL_SIZE)
    axes.spines[["top", "right"]].set_visible(False)


def _add_legend(figure: Figure, colors: dict[str, str]) -> None:
    handles = [Line2D([], [], color=color, linewidth=2, label=name) for name, color in colors.items()]
    handles.append(Line2D([], [], color=GRAY, linewidth=1, linestyle=DASHED_LINE, label="a network without error"))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False, fontsize=LABEL_SIZE)


def _save(figure: Figure, path: Path) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=160, format="png")
