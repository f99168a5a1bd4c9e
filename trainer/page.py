# SPDX-License-Identifier: GPL-3.0-or-later
"""The report as one page of HTML that asks for nothing from outside."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from fdda_addon.core.input_file import read_input
from fdda_addon.core.rig import STATIC_JOINT_LABEL

from .causes import CAUSES
from .charts import curve_limits, error_bars, histogram, learning_curves

MAX_PICTURE_BYTES = 256 << 20
STYLE = """
:root { color-scheme: light dark; --ink: #1c1f24; --soft: #666d78; --paper: #fff; --card: #f5f6f8; --line: #dfe2e7;
  --fdda: #e2711d; --linear: #b9c0cb; --train: #7b93b8; --worst: #b03a7a; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaee; --soft: #98a0ad; --paper: #16181c; --card: #1f2228;
  --line: #343942; --linear: #545c69; --train: #7d9ccc; --worst: #d66aa5; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1080px; padding: 40px 28px 80px; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; font-variant-numeric: tabular-nums; }
h1 { font-size: 26px; margin: 0; font-weight: 650; } h2 { font-size: 17px; margin: 44px 0 4px; font-weight: 650; }
p { margin: 2px 0 14px; color: var(--soft); } p strong { color: var(--ink); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin-top: 22px; }
.card { background: var(--card); border-radius: 8px; padding: 12px 16px; }
.card b { display: block; font-size: 23px; font-weight: 650; line-height: 1.25; }
.card span { color: var(--soft); font-size: 12.5px; } .card.main b { color: var(--fdda); }
.multiples { display: grid; grid-template-columns: repeat(auto-fill, minmax(215px, 1fr)); gap: 14px; }
figure { margin: 0; } figcaption { font-size: 13px; color: var(--soft); } figcaption b { color: var(--ink); }
svg { display: block; width: 100%; height: auto; overflow: visible; }
.grid { stroke: var(--line); } .tick { fill: var(--soft); font-size: 10px; }
.label { fill: var(--ink); font-size: 12px; }
.curve { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
.curve.training { stroke: var(--train); } .curve.validation { stroke: var(--fdda); }
.curve.worst { stroke: var(--worst); stroke-width: 1; }
.bar.linear, .area.linear { fill: var(--linear); } .bar.fdda, .area.fdda { fill: var(--fdda); }
.area { fill-opacity: .78; } .most { stroke: var(--fdda); stroke-width: 2; }
.key { display: inline-block; width: 11px; height: 11px; border-radius: 2px; margin: 0 5px 0 12px; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: 13px; white-space: nowrap; }
th, td { padding: 4px 8px; text-align: right; border-bottom: 1px solid var(--line); } th { font-weight: 600; }
th:first-child, td:first-child { text-align: left; } thead th { color: var(--soft); } tr.total td { font-weight: 650; }
.pictures { display: grid; gap: 20px; } .pictures img { width: 100%; border-radius: 8px; display: block; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; font-size: 13px; margin: 8px 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
"""


def render_html(report: dict, pictures: Sequence[Path] = (), evaluation: dict | None = None) -> str:
    """The page.

    Args:
        report: what `report.json` holds.
        pictures: PNG or JPEG files, shown in this order under their names.
        evaluation: what `evaluate --json` wrote, when there is one.
    """
    parts = [
        _head(report),
        _warnings(report),
        _pictures(pictures),
        _evaluation(evaluation),
        _errors(report),
        _surface(report),
        _worst(report["partitions"]),
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
        f'<div class="card{" main" if not number else ""}"><b>{value}</b><span>{text}</span></div>'
        for number, (value, text) in enumerate(cards)
    )
    return (
        f"<h1>{escape(report['model'])}</h1><p>{escape(report['object'])}: {report['vertices']:,} vertices, "
        f"{report['joints']} joints. Trained on {training['training_poses']:,} poses of the recording "
        f"<strong>{escape(report['recording'])}</strong>, measured on {training['held_out_poses']:,} others "
        "that neither trained nor chose anything.</p>"
        f'<div class="cards">{shown}</div>'
    )


def _warnings(report: dict) -> str:
    if not report.get("warnings"):
        return ""
    rows = "".join(f"<dt>{escape(w['name'])}</dt><dd>{escape(w['text'])}</dd>" for w in report["warnings"])
    return f"<h2>Warnings</h2><p>What is suspicious about the recording.</p><dl>{rows}</dl>"


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
        f"<tr><td>{name}</td>" + "".join(f"<td>{_mm(evaluation[key][k])}</td>" for k in STATISTICS) + "</tr>"
        for key, name in (("fdda", "FDDA"), ("linear", "linear skinning"))
    )
    heads = "".join(f"<th>{STATISTICS[k]}</th>" for k in STATISTICS)
    return (
        f"<h2>Evaluation against the true rig</h2><p>{evaluation['poses']:,} poses that training never saw.</p>"
        f'<div class="scroll"><table><thead><tr><th></th>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


STATISTICS = {"mean": "mean", "rms": "rms", "p99": "99 %", "p999": "99.9 %", "max": "max"}


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
    heads = ("normals: mean", "99 %", "max", "edges: inside partitions", "beside borders", "across borders")
    return (
        "<h2>Surface</h2><p>What shading shows of held-out poses: angles to the true normals, and errors of edge "
        'lengths as parts of the rest length.</p><div class="scroll"><table><thead><tr><th></th>'
        f"{''.join(f'<th>{head}</th>' for head in heads)}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _worst(partitions: list[dict]) -> str:
    """What the largest errors have in common, the largest first; nothing for a report that does not say it."""
    known = sorted((p for p in partitions if "worst" in p), key=lambda p: -p["held_out"]["max"])
    if not known:
        return ""
    rows = ""
    for p in known:
        w = p["worst"]
        joint = f"{escape(w['joint'])}, {w['extreme']:.1f} times" if w["joint"] else "-"
        border = "-" if w["border"] is None else f"{w['border']:.1f} times"
        cells = (
            *(f"{p['held_out'][k]:.3f}" for k in ("mean", "p999", "max")),
            *(f"{w['poses']:,}", f"{w['vertices']:,}", f"{100 * w['shapes']:.0f} %", border, joint),
            *(f"{w['distance']:.1f} times", f"{w['training']:.1f} times", escape(CAUSES.get(w["cause"], w["cause"]))),
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
            "not in the shapes",
            "at borders",
            "furthest joint",
        ),
        *("from training poses", "over training errors", "what helps"),
    )
    return (
        "<h2>The largest errors</h2><p>What the half percent of the vertices that are furthest off has in common, "
        "against what is usual: in how many poses and vertices, how much of it no shape reaches, how much more often "
        "it lies beside another partition, the joint that is furthest from its middle, how far the nearest training "
        "pose is, and the 99.9th percentile over that of the training poses.</p>"
        '<div class="scroll"><table><thead><tr>'
        f"{''.join(f'<th>{head}</th>' for head in heads)}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _curve(curve: dict, low: float, high: float) -> str:
    return learning_curves(curve["training"], curve["validation"], curve.get("worst", ()), low, high)


def _curves(report: dict) -> str:
    curves = [p["curve"] for p in report["partitions"]]
    low, high = curve_limits(
        [values for c in curves for values in (c["training"], c["validation"], c.get("worst", ()))]
    )
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
    heads += "<th>inputs</th><th>shapes</th><th>train mean</th>"
    heads += "".join(f"<th>{name}</th>" for name in STATISTICS.values()) + "<th>linear mean</th><th>of linear</th>"
    rows = []
    for p in partitions:
        seen = escape(", ".join(p["influencing"])) or "none"
        merged = escape(", ".join(name or STATIC_JOINT_LABEL for name in p.get("merged", [])))
        rows.append(
            f'<tr><td title="{f"with {merged}" if merged else ""}">{_joint(p)}</td><td>{p["vertices"]:,}</td>'
            f'<td title="{seen}">{len(p["influencing"])}</td>{_controls(p) if controlled else ""}'
            f"<td>{p['features']}</td><td>{p['basis']}</td><td>{p['training']['mean']:.4f}</td>"
            + "".join(f"<td>{p['held_out'][k]:.4f}</td>" for k in STATISTICS)
            + f"<td>{p['linear']['mean']:.3f}</td><td>{_share(p['held_out']['mean'], p['linear']['mean'])}</td></tr>"
        )
    total = (
        f'<tr class="total"><td>all</td><td>{report["vertices"]:,}</td><td>{report["joints"]}</td>'
        + (f"<td>{len(report['controls'])}</td>" if controlled else "")
        + f"<td></td><td>{sum(p['basis'] for p in partitions)}</td><td>{report['fdda']['training']['mean']:.4f}</td>"
        + "".join(f"<td>{fdda[k]:.4f}</td>" for k in STATISTICS)
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
        values["bytes that a frame reads"] = f"{report['constant_bytes']:,}"
    rows = "".join(
        f"<dt>{escape(str(key).replace('_', ' '))}</dt><dd>{escape(_shown(value))}</dd>"
        for key, value in values.items()
    )
    return f"<h2>Settings</h2><dl>{rows}</dl>"


def _shown(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _mm(value: float) -> str:
    return f"{value:.3g} mm" if value < 100 else f"{value:.0f} mm"


def _share(value: float, whole: float) -> str:
    return f"{100 * value / whole:.1f} %" if whole > 0 else "-"
