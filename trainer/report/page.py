# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders the report of a training as one self-contained HTML page."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from fdda_addon.core.input_file import read_input
from fdda_addon.core.rig import STATIC_JOINT_LABEL

from .charts import curve_limits, error_bars, histogram, learning_curves
from .error_causes import REMEDY_BY_CAUSE
from .style import STYLE

MAX_PICTURE_BYTES = 256 << 20
STATISTIC_LABELS = {"mean": "mean", "rms": "rms", "p99": "99 %", "p999": "99.9 %", "max": "max"}
"""Heading of each error statistic in tables, by the key of the statistic in reports and evaluations."""


def render_html(report: dict, pictures: Sequence[Path] = (), evaluation: dict | None = None) -> str:
    """Render the page.

    Args:
        report: content of `report.json`.
        pictures: PNG or JPEG files, shown in this order with their names.
        evaluation: content of the JSON that `evaluate` wrote; None without one.

    Returns:
        The HTML.
    """
    sections = [
        _header(report),
        _warnings_list(report),
        _pictures(pictures),
        _evaluation_table(evaluation),
        _error_charts(report),
        _surface_table(report),
        _largest_errors_table(report["partitions"]),
        _learning_curves(report),
        _partition_table(report["partitions"], report["fdda"]["held_out"], report["linear"]["held_out"], report),
        _settings_list(report),
    ]
    title = escape(report["model"])
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}: training report</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
        f"{''.join(sections)}</body></html>\n"
    )


def _legend_entry(color_name: str, text: str) -> str:
    return f'<span class="key" style="background: var(--{color_name})"></span>{text}'


REPEATABILITY_TEXT = "mean distance between two ways to the same pose; no model can be closer than this"


def _header(report: dict) -> str:
    held_out, linear, training = report["fdda"]["held_out"], report["linear"]["held_out"], report["training"]
    cards = [
        (
            _format_mm(held_out["mean"]),
            f"held-out mean error, {_format_share(held_out['mean'], linear['mean'])} of linear skinning's",
        ),
        *(
            [(_format_mm(report["repeatability"]["distance_mm"]["mean"]), REPEATABILITY_TEXT)]
            if "repeatability" in report
            else []
        ),
        (_format_mm(held_out["p999"]), f"99.9 % of vertices below; linear skinning {_format_mm(linear['p999'])}"),
        (
            _format_mm(held_out["max"]),
            f"largest error, {_format_share(held_out['max'], linear['max'])} of linear skinning's",
        ),
        (f"{training['seconds']:.0f} s", f"training on {escape(training['device'])}, {training['epochs']} epochs"),
        (f"{report['model_bytes'] / 1e6:.1f} MB", f"model of {len(report['partitions'])} partitions"),
    ]
    cards_html = "".join(
        f'<div class="card{" main" if not index else ""}"><b>{value}</b><span>{text}</span></div>'
        for index, (value, text) in enumerate(cards)
    )
    return (
        f"<h1>{escape(report['model'])}</h1><p>{escape(report['object'])}: {report['vertices']:,} vertices, "
        f"{report['joints']} joints. Trained on {training['training_poses']:,} poses of the recording "
        f"<strong>{escape(report['recording'])}</strong>, measured on {training['held_out_poses']:,} others "
        "that were not used for training.</p>"
        f'<div class="cards">{cards_html}</div>'
    )


def _warnings_list(report: dict) -> str:
    if not report.get("warnings"):
        return ""
    rows = "".join(
        f"<dt>{escape(warning['name'])}</dt><dd>{escape(warning['text'])}</dd>" for warning in report["warnings"]
    )
    return f"<h2>Warnings</h2><p>Possible problems of the recording.</p><dl>{rows}</dl>"


def _pictures(pictures: Sequence[Path]) -> str:
    if not pictures:
        return ""
    figures = []
    for path in pictures:
        image_type = "jpeg" if path.suffix.lower() in (".jpg", ".jpeg") else "png"
        data = base64.b64encode(read_input(path, MAX_PICTURE_BYTES)).decode("ascii")
        name = escape(path.stem.replace("_", " "))
        figures.append(
            f'<figure><img alt="{name}" src="data:image/{image_type};base64,{data}">'
            f"<figcaption>{name}</figcaption></figure>"
        )
    return f'<h2>Pictures</h2><div class="pictures">{"".join(figures)}</div>'


def _evaluation_table(evaluation: dict | None) -> str:
    if not evaluation:
        return ""
    rows = "".join(
        f"<tr><td>{name}</td>"
        + "".join(f"<td>{_format_mm(evaluation[method][statistic])}</td>" for statistic in STATISTIC_LABELS)
        + "</tr>"
        for method, name in (("fdda", "FDDA"), ("linear", "linear skinning"))
    )
    headings = "".join(f"<th>{STATISTIC_LABELS[statistic]}</th>" for statistic in STATISTIC_LABELS)
    return (
        f"<h2>Evaluation against the true rig</h2><p>{evaluation['poses']:,} poses that training never saw.</p>"
        f'<div class="scroll"><table><thead><tr><th></th>{headings}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _error_charts(report: dict) -> str:
    partitions = report["partitions"]
    error_chart = error_bars(
        [partition["joint"] or STATIC_JOINT_LABEL for partition in partitions],
        [partition["held_out"]["mean"] for partition in partitions],
        [partition["linear"]["mean"] for partition in partitions],
        [partition["held_out"]["p999"] for partition in partitions],
        [partition["held_out"]["max"] for partition in partitions],
    )
    histogram_counts = report["histogram"]
    return (
        "<h2>Held-out error</h2><p>Share of vertices by their distance to the true rig."
        f"{_legend_entry('fdda', 'FDDA')}{_legend_entry('linear', 'linear skinning alone')}</p>"
        f"{histogram(histogram_counts['edges'], histogram_counts['fdda'], histogram_counts['linear'])}"
        "<h2>Held-out error by partition</h2><p>Bars are means; ticks are the 99.9th percentile and the largest error."
        f"{_legend_entry('fdda', 'FDDA')}{_legend_entry('linear', 'linear skinning alone')}</p>{error_chart}"
    )


def _surface_table(report: dict) -> str:
    if not report.get("normals"):
        return ""
    rows = ""
    for method, name in (("fdda", "FDDA"), ("linear", "linear skinning")):
        normals, edges = report["normals"][method], report["edges"][method]
        cells = [f"{normals[statistic]:.2f}&deg;" for statistic in ("mean", "p99", "max")]
        cells += [
            "-" if edges[edge_kind] is None else f"{100 * edges[edge_kind]:.2f} %"
            for edge_kind in ("inside", "beside", "across")
        ]
        rows += f"<tr><td>{name}</td>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
    headings = ("normals: mean", "99 %", "max", "edges: inside partitions", "beside boundaries", "across boundaries")
    return (
        "<h2>Surface</h2><p>Shading of held-out poses: angles to the normals of the true rig, and errors of edge "
        'lengths relative to the rest length.</p><div class="scroll"><table><thead><tr><th></th>'
        f"{''.join(f'<th>{heading}</th>' for heading in headings)}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _largest_errors_table(partitions: list[dict]) -> str:
    """Render the table of the largest errors, the largest first."""
    rows = ""
    for partition in sorted(partitions, key=lambda partition: -partition["held_out"]["max"]):
        analysis = partition["largest_errors"]
        joint_text = f"{escape(analysis['joint'])}, {analysis['extreme']:.1f} times" if analysis["joint"] else "-"
        boundary_text = "-" if analysis["boundary"] is None else f"{analysis['boundary']:.1f} times"
        remedy = REMEDY_BY_CAUSE.get(analysis["cause"], analysis["cause"])
        cells = (
            *(f"{partition['held_out'][statistic]:.3f}" for statistic in ("mean", "p999", "max")),
            *(f"{analysis['poses']:,}", f"{analysis['vertices']:,}", f"{100 * analysis['truncation']:.0f} %"),
            *(boundary_text, joint_text, f"{analysis['distance']:.1f} times"),
            *(f"{analysis['generalization']:.1f} times", escape(remedy)),
        )
        rows += f"<tr><td>{_joint_label(partition)}</td>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
    headings = (
        *(
            "partition",
            "mean",
            "99.9 %",
            "max",
            "poses",
            "vertices",
            "not in the components",
            "at boundaries",
            "most extreme joint",
        ),
        *("from training poses", "over training errors", "what helps"),
    )
    return (
        "<h2>The largest errors</h2><p>The table describes the half percent of held-out vertices with the largest "
        "errors: the number of poses and vertices, the part of the error that no component represents, and how much "
        "more often than other vertices they lie beside another partition. It also names the joint that is furthest "
        "from its mean. It compares the distance to the nearest training pose with the median distance, and the 99.9th "
        "percentile of the errors with that of the training poses.</p>"
        '<div class="scroll"><table><thead><tr>'
        f"{''.join(f'<th>{heading}</th>' for heading in headings)}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _learning_curve(curve: dict, low: float, high: float) -> str:
    return learning_curves(curve["training"], curve["validation"], curve["worst"], low, high)


def _learning_curves(report: dict) -> str:
    curves = [partition["curve"] for partition in report["partitions"]]
    low, high = curve_limits(
        [values for curve in curves for values in (curve["training"], curve["validation"], curve["worst"])]
    )
    figures = "".join(
        f"<figure>{_learning_curve(partition['curve'], low, high)}"
        f"<figcaption><b>{_joint_label(partition)}</b> &middot; best at {partition['curve']['best_epoch']}</figcaption>"
        "</figure>"
        for partition in report["partitions"]
    )
    return (
        "<h2>Learning curves</h2><p>Error of the poses in mm after each epoch. All charts have the same scale. "
        f"{_legend_entry('train', 'training')}{_legend_entry('fdda', 'validation')}"
        f"{_legend_entry('worst', 'worst validation pose')}</p>"
        f'<div class="multiples">{figures}</div>'
    )


def _partition_table(partitions: list[dict], fdda: dict, linear: dict, report: dict) -> str:
    has_controls = bool(report.get("controls"))
    headings = "<th>partition</th><th>vertices</th><th>joints</th>" + "<th>controls</th>" * has_controls
    headings += "<th>inputs</th><th>components</th><th>train mean</th>"
    headings += (
        "".join(f"<th>{name}</th>" for name in STATISTIC_LABELS.values()) + "<th>linear mean</th><th>of linear</th>"
    )
    rows = []
    for partition in partitions:
        influencing = escape(", ".join(partition["influencing"])) or "none"
        merged = escape(", ".join(name or STATIC_JOINT_LABEL for name in partition.get("merged", [])))
        rows.append(
            f'<tr><td title="{f"with {merged}" if merged else ""}">{_joint_label(partition)}</td>'
            f"<td>{partition['vertices']:,}</td>"
            f'<td title="{influencing}">{len(partition["influencing"])}</td>'
            f"{_controls_cell(partition) if has_controls else ''}"
            f"<td>{partition['features']}</td><td>{partition['basis']}</td><td>{partition['training']['mean']:.4f}</td>"
            + "".join(f"<td>{partition['held_out'][statistic]:.4f}</td>" for statistic in STATISTIC_LABELS)
            + f"<td>{partition['linear']['mean']:.3f}</td>"
            f"<td>{_format_share(partition['held_out']['mean'], partition['linear']['mean'])}</td></tr>"
        )
    total_row = (
        f'<tr class="total"><td>all</td><td>{report["vertices"]:,}</td><td>{report["joints"]}</td>'
        + (f"<td>{len(report['controls'])}</td>" if has_controls else "")
        + f"<td></td><td>{sum(partition['basis'] for partition in partitions)}</td>"
        f"<td>{report['fdda']['training']['mean']:.4f}</td>"
        + "".join(f"<td>{fdda[statistic]:.4f}</td>" for statistic in STATISTIC_LABELS)
        + f"<td>{linear['mean']:.3f}</td><td>{_format_share(fdda['mean'], linear['mean'])}</td></tr>"
    )
    return (
        "<h2>Partitions</h2><p>Errors are in mm. All except the training mean are errors of held-out poses.</p>"
        f'<div class="scroll"><table><thead><tr>{headings}</tr></thead>'
        f"<tbody>{''.join(rows)}{total_row}</tbody></table></div>"
    )


def _controls_cell(partition: dict) -> str:
    names = partition.get("controls", [])
    return f'<td title="{escape(", ".join(names)) or "none"}">{len(names)}</td>'


def _joint_label(partition: dict) -> str:
    return escape(partition["joint"] or STATIC_JOINT_LABEL)


def _settings_list(report: dict) -> str:
    values = {**report["training"], "largest difference to PyTorch": f"{report['parity']:.2g} mm"}
    if "constant_bytes" in report:
        values["constants, bytes"] = f"{report['constant_bytes']:,}"
    rows = "".join(
        f"<dt>{escape(str(key).replace('_', ' '))}</dt><dd>{escape(_format_value(value))}</dd>"
        for key, value in values.items()
    )
    return f"<h2>Settings</h2><dl>{rows}</dl>"


def _format_value(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _format_mm(value: float) -> str:
    return f"{value:.3g} mm" if value < 100 else f"{value:.0f} mm"


def _format_share(value: float, whole: float) -> str:
    return f"{100 * value / whole:.1f} %" if whole > 0 else "-"
