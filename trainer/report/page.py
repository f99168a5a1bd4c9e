# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders the report of a training as one self-contained HTML page, from the template `page.html`."""

import base64
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from fdda_addon.core.files.input_file import read_input
from fdda_addon.core.rig import STATIC_JOINT_LABEL
from fdda_addon.core.wording import format_count

from .charts import HistogramChart, LogAxis, curve_points
from .error_analysis import REMEDY_BY_CAUSE

MAX_PICTURE_BYTES = 256 << 20
STATISTIC_LABELS = {"mean": "mean", "rms": "rms", "p99": "99 %", "p999": "99.9 %", "max": "max"}
"""Heading of each error statistic in tables, by the key of the statistic in reports and evaluations."""
NUMBER_FILTERS = {
    "number": "{:,}".format,
    "count": format_count,
    "fixed": lambda number, digits: f"{number:.{digits}f}",
    "mm": lambda length: f"{length:.3g} mm" if length < 100 else f"{length:.0f} mm",
    "share_of": lambda part, whole: f"{100 * part / whole:.1f} %" if whole > 0 else "-",
}


def render_html(report: dict, pictures: Sequence[Path] = (), evaluation: dict | None = None) -> str:
    """Render the page. The template escapes all text.

    Args:
        report: content of `report.json`.
        pictures: PNG or JPEG files, shown in this order with their names.
        evaluation: content of the JSON that `evaluate` wrote; None without one.

    Returns:
        The HTML.
    """
    return _template().render(
        report=report,
        pictures=[(path.stem.replace("_", " "), _data_url(path)) for path in pictures],
        evaluation=evaluation,
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


def _data_url(picture: Path) -> str:
    image_type = "png" if picture.suffix.lower() == ".png" else "jpeg"
    return f"data:image/{image_type};base64,{base64.b64encode(read_input(picture, MAX_PICTURE_BYTES)).decode('ascii')}"
