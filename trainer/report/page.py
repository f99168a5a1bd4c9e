# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders the report of a training as one self-contained HTML page, from the template `page.html`."""

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from fdda_addon.core.rig import STATIC_JOINT_LABEL
from fdda_addon.core.wording import format_count

from .error_analysis import REMEDY_BY_CAUSE

MIN_AXIS_MM = 1e-12
"""Minimum value at the start of a logarithmic axis, mm."""
CURVE_POINTS = 120
"""Maximum number of points of a drawn curve; a curve of more epochs is sampled."""


class LogAxis:
    """A logarithmic axis between powers of ten.

    Attributes:
        ticks: the powers of ten, mm.
    """

    def __init__(self, values: Sequence[float], start: float, end: float):
        """Span the axis around the positive values, mm, from the position `start` to the position `end`."""
        positive_values = [max(value, MIN_AXIS_MM) for value in values if value > 0] or [1.0]
        self._low = math.floor(math.log10(min(positive_values)))
        self._high = max(math.ceil(math.log10(max(positive_values))), self._low + 1)
        self._start, self._end = start, end
        self.ticks = [10.0**power for power in range(self._low, self._high + 1)]

    def __call__(self, value: float) -> float:
        """Return the position of a value in mm; values outside the axis are at its ends."""
        power = math.log10(value) if value > 0 else self._low
        fraction = min(max((power - self._low) / (self._high - self._low), 0.0), 1.0)
        return round(self._start + fraction * (self._end - self._start), 1)


def curve_points(errors: Sequence[float], y: LogAxis, left: float, right: float) -> str:
    """Return the points of a polyline through the errors of all epochs, mm; empty without epochs."""
    epochs = np.unique(np.linspace(0, len(errors) - 1, min(CURVE_POINTS, len(errors))).round().astype(int))
    step = (right - left) / max(1, len(errors) - 1)
    return " ".join(f"{left + step * epoch:.1f},{y(errors[epoch])}" for epoch in epochs)


class HistogramChart:
    """The outlines of a histogram of vertex errors, over a logarithmic axis.

    Attributes:
        x: the axis.
        max_percent: percentage of the vertices in the fullest bin, which is drawn at the position `top`.
        outlines: by method, the points of a polygon.
    """

    def __init__(self, histogram: dict, left: float, right: float, top: float, bottom: float):
        """Lay out `histogram` of a report between positions of the chart, without empty bins at its ends.

        Raises:
            ArithmeticError, IndexError or ValueError: edges and counts contradict each other.
        """
        methods, edges = ("linear", "fdda"), histogram["edges"]
        counts = np.array([histogram[method] for method in methods], float)
        if (np.diff(edges) <= 0).any() or counts.min() < 0:
            raise ValueError("the histogram is none")
        used_bins = np.flatnonzero(counts.sum(axis=0))
        first, end = used_bins[0], used_bins[-1] + 1
        # The first bin starts at zero, which has no logarithm; it is drawn as wide as the second bin.
        used_edges = [edges[1] ** 2 / edges[2], *edges[1:]][first : end + 1]
        percent = 100 * counts[:, first:end] / counts.sum(axis=1, keepdims=True)
        self.x, self.max_percent = LogAxis(used_edges, left, right), float(percent.max())
        heights = np.pad(np.repeat(percent, 2, axis=1), ((0, 0), (1, 1))) * (bottom - top) / self.max_percent
        positions = np.repeat([self.x(edge) for edge in used_edges], 2)
        self.outlines = {
            method: " ".join(f"{x:.1f},{bottom - height:.1f}" for x, height in zip(positions, row, strict=True))
            for method, row in zip(methods, heights, strict=True)
        }


STATISTIC_LABELS = {"mean": "mean", "rms": "rms", "p99": "99 %", "p999": "99.9 %", "max": "max"}
"""Heading of each error statistic in tables, by the key of the statistic."""
NUMBER_FILTERS = {
    "number": "{:,}".format,
    "count": format_count,
    "fixed": lambda number, digits: f"{number:.{digits}f}",
    "mm": lambda length: f"{length:.3g} mm" if length < 100 else f"{length:.0f} mm",
    "share_of": lambda part, whole: f"{100 * part / whole:.1f} %" if whole > 0 else "-",
}


def render_html(report: dict) -> str:
    """Return the HTML of the page for the content of `report.json`. The template escapes all text."""
    return _template().render(
        report=report,
        statistic_labels=STATISTIC_LABELS,
        remedies=REMEDY_BY_CAUSE,
        LogAxis=LogAxis,
        HistogramChart=HistogramChart,
        curve_points=curve_points,
    )


@cache
def _template() -> Template:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {**NUMBER_FILTERS, "joint_label": lambda name: name or STATIC_JOINT_LABEL}
    return environment.get_template("page.html")
