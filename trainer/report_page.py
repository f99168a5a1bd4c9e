# SPDX-License-Identifier: GPL-3.0-or-later
"""The report as one self-contained HTML page."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from fdda_addon.core.input_file import read_input
from fdda_addon.core.rig import STATIC_JOINT_LABEL

from .charts import curve_limits, error_bars, histogram, learning_curves
from .error_causes import CAUSES
from .report_style import STYLE

MAX_PICTURE_BYTES = 256 << 20
STATISTIC_LABELS = {"mean": "mean", "rms": "rms", "p99": "99 %", "p999": "99.9 %", "max": "max"}
"""Table heading of each statistic of errors, by its key in reports and evaluations."""


def render_html(report: dict, pictures: Sequence[Path] = (), evaluation: dict | None = None) -> str:
    """Render the page.

    Args:
        report: content of `report.json`.
        pictures: PNG or JPEG files, shown in this order with their names.
        evaluation: content of the JSON that `evaluate` wrote; None without one.

    Returns:
        The HTML.
    """
    parts = [
        _head(report),
        _warnings(report),
        _pictures(pictures),
        _evaluation(evaluation),
        _errors(report),
        _surface(report),
        _largest_errors(report["partitions"]),
        _curves(report),
        _table(report["partitions"], report["fdda"]["held_out"], report["linear"]["held_out"], report),
        _settings(report),
    ]
    title = escape(report["model"])
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}: training report</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
        f"{''.join(parts)}</body></html>\n"
    )


def _key(kind: str, text: str) -> str:
    return f'<span class="key" style="background: var(--{kind})"></span>{text}'


REPEATED = "mean distance between two ways to the same pose: no model can be closer"


def _head(report: dict) -> str:
    held_out, linear, training = report["fdda"]["held_out"], report["linear"]["held_out"], report["training"]
    cards = [
        (
            _mm(held_out["mean"]),
            f"held-out mean error, {_share(held_out['mean'], linear['mean'])} of linear skinning's",
        ),
        *([(_mm(report["repeatability"]["distance_mm"]["mean"]), REPEATED)] if "repeatability" in report else []),
        (_mm(held_out["p999"]), f"99.9 % of vertices below; linear skinning {_mm(linear['p999'])}"),
        (_mm(held_out["max"]), f"largest error, {_share(held_out['max'], linear['max'])} of linear skinning's"),
        (f"{training['seconds']:.0f} s", f"training on {escape(training['device'])}, {training['epochs']} epochs"),
        (f"{report['model_bytes'] / 1e6:.1f} MB", f"model of {len(report['partitions'])} partitions"),
    ]
    shown = "".join(
        f'<div class="card{" main" if not index else ""}"><b>{value}</b><span>{text}</span></div>'
        for index, (value, text) in enumerate(cards)
    )
    return (
        f"<h1>{escape(report['model'])}</h1><p>{escape(report['object'])}: {report['vertices']:,} vertices, "
        f"{report['joints']} joints. Trained on {training['training_poses']:,} poses of the recording "
        f"<strong>{escape(report['recording'])}</strong>, measured on {training['held_out_poses']:,} others "
        "that were not used for training.</p>"
        f'<div class="cards">{shown}</div>'
    )


def _warnings(report: dict) -> str:
    if not report.get("warnings"):
        return ""
    rows = "".join(f"<dt>{escape(w['name'])}</dt><dd>{escape(w['text'])}</dd>" for w in report["warnings"])
    return f"<h2>Warnings</h2><p>Possible problems of the recording.</p><dl>{rows}</dl>"


def _pictures(pictures: Sequence[Path]) -> str:
    if not pictures:
        return ""
    figures = []
    for path in pictures:
        kind = "jpeg" if path.suffix.lower() in (".jpg", ".jpeg") else "png"
        data = base64.b64encode(read_input(path, MAX_PICTURE_BYTES)).decode("ascii")
        name = escape(path.stem.replace("_", " "))
        figures.append(
            f'<figure><img alt="{name}" src="data:image/{kind};base64,{data}"><figcaption>{name}</figcaption></figure>'
        )
    return f'<h2>Pictures</h2><div class="pictures">{"".join(figures)}</div>'


def _evaluation(evaluation: dict | None) -> str:
    if not evaluation:
        return ""
    rows = "".join(
        f"<tr><td>{name}</td>" + "".join(f"<td>{_mm(evaluation[key][k])}</td>" for k in STATISTIC_LABELS) + "</tr>"
        for key, name in (("fdda", "FDDA"), ("linear", "linear skinning"))
    )
    heads = "".join(f"<th>{STATISTIC_LABELS[k]}</th>" for k in STATISTIC_LABELS)
    return (
        f"<h2>Evaluation against the true rig</h2><p>{evaluation['poses']:,} poses that training never saw.</p>"
        f'<div class="scroll"><table><thead><tr><th></th>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _errors(report: dict) -> str:
    partitions = report["partitions"]
    bars = error_bars(
        [p["joint"] or STATIC_JOINT_LABEL for p in partitions],
        [p["held_out"]["mean"] for p in partitions],
        [p["linear"]["mean"] for p in partitions],
        [p["held_out"]["p999"] for p in partitions],
        [p["held_out"]["max"] for p in partitions],
    )
    counts = report["histogram"]
    return (
        "<h2>Held-out error</h2><p>Share of vertices by their distance to the true rig."
        f"{_key('fdda', 'FDDA')}{_key('linear', 'linear skinning alone')}</p>"
        f"{histogram(counts['edges'], counts['fdda'], counts['linear'])}"
        "<h2>Held-out error by partition</h2><p>Bars are means, the ticks the 99.9th percentile and the largest error."
        f"{_key('fdda', 'FDDA')}{_key('linear', 'linear skinning alone')}</p>{bars}"
    )


def _surface(report: dict) -> str:
    if not report.get("normals"):
        return ""
    rows = ""
    for way, name in (("fdda", "FDDA"), ("linear", "linear skinning")):
        normals, edges = report["normals"][way], report["edges"][way]
        cells = [f"{normals[key]:.2f}&deg;" for key in ("mean", "p99", "max")]
        cells += ["-" if edges[k] is None else f"{100 * edges[k]:.2f} %" for k in ("inside", "beside", "across")]
        rows += f"<tr><td>{name}</td>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
    heads = ("normals: mean", "99 %", "max", "edges: inside partitions", "beside boundaries", "across boundaries")
    return (
        "<h2>Surface</h2><p>Shading of held-out poses: angles to the true normals, and errors of edge lengths "
        'relative to the rest length.</p><div class="scroll"><table><thead><tr><th></th>'
        f"{''.join(f'<th>{head}</th>' for head in heads)}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _largest_errors(partitions: list[dict]) -> str:
    """Render the table of the largest errors, the largest first."""
    rows = ""
    for p in sorted(partitions, key=lambda p: -p["held_out"]["max"]):
        analysis = p["largest_errors"]
        extreme = f"{escape(analysis['joint'])}, {analysis['extreme']:.1f} times" if analysis["joint"] else "-"
        boundary = "-" if analysis["boundary"] is None else f"{analysis['boundary']:.1f} times"
        cause = CAUSES.get(analysis["cause"], analysis["cause"])
        cells = (
            *(f"{p['held_out'][k]:.3f}" for k in ("mean", "p999", "max")),
            *(f"{analysis['poses']:,}", f"{analysis['vertices']:,}", f"{100 * analysis['truncation']:.0f} %"),
            *(boundary, extreme, f"{analysis['distance']:.1f} times"),
            *(f"{analysis['generalization']:.1f} times", escape(cause)),
        )
        rows += f"<tr><td>{_joint(p)}</td>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
    heads = (
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
        "<h2>The largest errors</h2><p>The half percent of held-out vertices with the largest errors, relative to all: "
        "the number of poses and vertices, the part that no component represents, how much more often they lie beside "
        "another partition, the joint that is furthest from its mean, the distance to the nearest training pose, and "
        "the 99.9th percentile over that of the training poses.</p>"
        '<div class="scroll"><table><thead><tr>'
        f"{''.join(f'<th>{head}</th>' for head in heads)}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _curve(curve: dict, low: float, high: float) -> str:
    return learning_curves(curve["training"], curve["validation"], curve["worst"], low, high)


def _curves(report: dict) -> str:
    curves = [p["curve"] for p in report["partitions"]]
    low, high = curve_limits([values for c in curves for values in (c["training"], c["validation"], c["worst"])])
    figures = "".join(
        f"<figure>{_curve(p['curve'], low, high)}"
        f"<figcaption><b>{_joint(p)}</b> &middot; best at {p['curve']['best_epoch']}</figcaption></figure>"
        for p in report["partitions"]
    )
    return (
        "<h2>Learning curves</h2><p>Error of the poses in mm, by epoch, one scale for all. "
        f"{_key('train', 'training')}{_key('fdda', 'validation')}{_key('worst', 'its worst pose')}</p>"
        f'<div class="multiples">{figures}</div>'
    )


def _table(partitions: list[dict], fdda: dict, linear: dict, report: dict) -> str:
    controlled = bool(report.get("controls"))
    heads = "<th>partition</th><th>vertices</th><th>joints</th>" + "<th>controls</th>" * controlled
    heads += "<th>inputs</th><th>components</th><th>train mean</th>"
    heads += (
        "".join(f"<th>{name}</th>" for name in STATISTIC_LABELS.values()) + "<th>linear mean</th><th>of linear</th>"
    )
    rows = []
    for p in partitions:
        influencing = escape(", ".join(p["influencing"])) or "none"
        merged = escape(", ".join(name or STATIC_JOINT_LABEL for name in p.get("merged", [])))
        rows.append(
            f'<tr><td title="{f"with {merged}" if merged else ""}">{_joint(p)}</td><td>{p["vertices"]:,}</td>'
            f'<td title="{influencing}">{len(p["influencing"])}</td>{_controls(p) if controlled else ""}'
            f"<td>{p['features']}</td><td>{p['basis']}</td><td>{p['training']['mean']:.4f}</td>"
            + "".join(f"<td>{p['held_out'][k]:.4f}</td>" for k in STATISTIC_LABELS)
            + f"<td>{p['linear']['mean']:.3f}</td><td>{_share(p['held_out']['mean'], p['linear']['mean'])}</td></tr>"
        )
    total = (
        f'<tr class="total"><td>all</td><td>{report["vertices"]:,}</td><td>{report["joints"]}</td>'
        + (f"<td>{len(report['controls'])}</td>" if controlled else "")
        + f"<td></td><td>{sum(p['basis'] for p in partitions)}</td><td>{report['fdda']['training']['mean']:.4f}</td>"
        + "".join(f"<td>{fdda[k]:.4f}</td>" for k in STATISTIC_LABELS)
        + f"<td>{linear['mean']:.3f}</td><td>{_share(fdda['mean'], linear['mean'])}</td></tr>"
    )
    return (
        "<h2>Partitions</h2><p>Errors in mm; all but the training mean are of held-out poses.</p>"
        f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{"".join(rows)}{total}</tbody></table></div>'
    )


def _controls(partition: dict) -> str:
    names = partition.get("controls", [])
    return f'<td title="{escape(", ".join(names)) or "none"}">{len(names)}</td>'


def _joint(partition: dict) -> str:
    return escape(partition["joint"] or STATIC_JOINT_LABEL)


def _settings(report: dict) -> str:
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


def _mm(value: float) -> str:
    return f"{value:.3g} mm" if value < 100 else f"{value:.0f} mm"


def _share(value: float, whole: float) -> str:
    return f"{100 * value / whole:.1f} %" if whole > 0 else "-"
