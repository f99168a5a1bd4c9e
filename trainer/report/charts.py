# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the charts of the report as inline SVG. The style sheet of the page defines their colors."""

import math
from collections.abc import Sequence
from html import escape

import numpy as np

MIN_AXIS_MM = 1e-12
"""Minimum value at the start of a logarithmic axis, mm."""
CURVE_POINTS = 120
"""Maximum number of points of a drawn curve; a curve of more epochs is sampled."""


def learning_curves(
    training: Sequence[float], validation: Sequence[float], worst: Sequence[float], low: float, high: float
) -> str:
    """Draw the learning curves of one partition.

    Args:
        training, validation, worst: error after each epoch, mm; empty for a constant partition.
        low, high: limits of the logarithmic axis, mm.

    Returns:
        The SVG element.
    """
    width, height, left, bottom = 230, 110, 38, 16
    if not validation:
        return (
            f'<svg viewBox="0 0 {width} {height}"><text class="tick" x="{width / 2}" y="{height / 2}" '
            'text-anchor="middle">constant: the mean is within the tolerance</text></svg>'
        )
    y = _log_axis(low, high, height - bottom, 6)
    elements = [_grid_lines(low, high, y, left, width - 4)]
    for name, values in (("training", training), ("worst", worst), ("validation", validation)):
        if not values:
            continue
        sampled_epochs = np.unique(np.linspace(0, len(values) - 1, min(CURVE_POINTS, len(values))).round().astype(int))
        span = max(1, len(values) - 1)
        points = " ".join(f"{left + (width - 6 - left) * i / span:.1f},{y(values[i]):.1f}" for i in sampled_epochs)
        elements.append(f'<polyline class="curve {name}" points="{points}"/>')
    elements.append(f'<text class="tick" x="{left}" y="{height - 3}">1</text>')
    elements.append(
        f'<text class="tick" x="{width - 5}" y="{height - 3}" text-anchor="end">{len(validation)} epochs</text>'
    )
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(elements)}</svg>'


def error_bars(
    names: Sequence[str],
    fdda: Sequence[float],
    linear: Sequence[float],
    p999: Sequence[float],
    maxima: Sequence[float],
) -> str:
    """Draw the errors of each partition as bars on a logarithmic axis.

    Args:
        names: names of the partitions.
        fdda, linear: mean errors of the model and of linear skinning, mm.
        p999, maxima: 99.9th percentiles and maxima of the model's errors, mm.

    Returns:
        The SVG element.
    """
    row_height, left, right, top = 20, 130, 16, 24
    width, height = 880, top + row_height * len(names) + 8
    positive = [value for value in (*fdda, *linear, *maxima) if value > 0] or [1.0]
    low, high = _enclosing_powers_of_ten(positive)
    x = _log_axis(low, high, left, width - right)
    elements = []
    for value in _powers_of_ten(low, high):
        elements.append(
            f'<line class="grid" x1="{x(value):.1f}" x2="{x(value):.1f}" y1="{top - 6}" y2="{height - 4}"/>'
        )
        elements.append(
            f'<text class="tick" x="{x(value):.1f}" y="{top - 11}" text-anchor="middle">{value:g} mm</text>'
        )
    for index, name in enumerate(names):
        center = top + row_height * index + row_height / 2
        elements.append(f'<text class="label" x="{left - 8}" y="{center + 4}" text-anchor="end">{escape(name)}</text>')
        for kind, value, thickness in (("linear", linear[index], 12), ("fdda", fdda[index], 6)):
            end = x(value) if value > 0 else left
            elements.append(
                f'<rect class="bar {kind}" x="{left}" y="{center - thickness / 2}" height="{thickness}" rx="1.5" '
                f'width="{max(0.0, end - left):.1f}"><title>{escape(name)}: {value:.4f} mm</title></rect>'
            )
        for value, label, half_height in ((p999[index], "99.9 %", 3), (maxima[index], "largest", 6)):
            if value > 0:
                elements.append(
                    f'<line class="most" x1="{x(value):.1f}" x2="{x(value):.1f}" y1="{center - half_height}" '
                    f'y2="{center + half_height}"><title>{label}: {value:.3f} mm</title></line>'
                )
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(elements)}</svg>'


def histogram(edges: Sequence[float], fdda: Sequence[int], linear: Sequence[int]) -> str:
    """Draw a histogram of vertex errors on a logarithmic axis.

    Args:
        edges: edges of the bins, mm.
        fdda, linear: number of vertices in each bin, for the model and for linear skinning.

    Returns:
        The SVG element.
    """
    width, height, left, bottom, top = 880, 240, 46, 30, 10
    counts = np.array([fdda, linear], float)
    used_bins = np.flatnonzero(counts.sum(axis=0))
    # The first bin starts at zero, which has no logarithm; it is drawn as wide as the other bins.
    bounds = np.log10(np.array([edges[1] ** 2 / edges[2], *edges[1:]]))
    low, high = math.floor(bounds[used_bins[0]]), math.ceil(bounds[used_bins[-1] + 1])
    share = counts / counts.sum(axis=1, keepdims=True) * 100
    max_share = share.max()

    def x(value: float) -> float:
        return left + (value - low) / (high - low) * (width - left - 8)

    def y(value: float) -> float:
        return height - bottom - value / max_share * (height - bottom - top)

    elements = []
    for power in range(low, high + 1):
        elements.append(
            f'<line class="grid" x1="{x(power):.1f}" x2="{x(power):.1f}" y1="{top}" y2="{height - bottom}"/>'
        )
        label = (
            f'<text class="tick" x="{x(power):.1f}" y="{height - 12}" text-anchor="middle">{10.0**power:g} mm</text>'
        )
        elements.append(label)
    for value in (0, max_share / 2, max_share):
        elements.append(
            f'<text class="tick" x="{left - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:.1f} %</text>'
        )
    for name, values in (("linear", share[1]), ("fdda", share[0])):
        points = [f"{x(max(low, bounds[used_bins[0]])):.1f},{y(0):.1f}"]
        for index in range(used_bins[0], used_bins[-1] + 1):
            for bound in (bounds[index], bounds[index + 1]):
                points.append(f"{x(max(low, bound)):.1f},{y(values[index]):.1f}")
        points.append(f"{x(bounds[used_bins[-1] + 1]):.1f},{y(0):.1f}")
        elements.append(f'<polygon class="area {name}" points="{" ".join(points)}"/>')
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(elements)}</svg>'


def curve_limits(curves: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the limits of an axis for all learning curves, powers of ten, mm."""
    values = [value for curve in curves for value in curve if value > 0]
    return _enclosing_powers_of_ten(values or [1.0])


def _enclosing_powers_of_ten(values: Sequence[float]) -> tuple[float, float]:
    """Return the powers of ten below the smallest and above the largest value."""
    low, high = (math.log10(max(value, MIN_AXIS_MM)) for value in (min(values), max(values)))
    low, high = math.floor(low), math.ceil(high)
    return 10.0**low, 10.0 ** max(high, low + 1)


def _powers_of_ten(low: float, high: float) -> list[float]:
    """Return the powers of ten from `low` to `high`."""
    return [10.0**power for power in range(round(math.log10(low)), round(math.log10(high)) + 1)]


def _log_axis(low: float, high: float, start: float, end: float):
    """Return a function that maps a value to a position between `start` (low) and `end` (high)."""
    span = math.log10(high / low)

    def position(value: float) -> float:
        fraction = math.log10(max(value, low) / low) / span
        return start + min(1.0, fraction) * (end - start)

    return position


def _grid_lines(low: float, high: float, y, left: float, right: float) -> str:
    """Draw a horizontal line and a label at each power of ten; `y` maps a value to a position."""
    return "".join(
        f'<line class="grid" x1="{left}" x2="{right}" y1="{y(v):.1f}" y2="{y(v):.1f}"/>'
        f'<text class="tick" x="{left - 4}" y="{y(v) + 3:.1f}" text-anchor="end">{v:g}</text>'
        for v in _powers_of_ten(low, high)
    )
