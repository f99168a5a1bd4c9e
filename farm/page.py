# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of all characters as a self-contained HTML page."""

import base64
from html import escape

from fdda_addon.core.recording.estimate import format_duration

from .tasks import KINDS

STYLE = """
:root { color-scheme: light dark; --ink: #1c1f24; --soft: #666d78; --paper: #fff; --card: #f5f6f8; --line: #dfe2e7;
  --fdda: #c65a12; --bad: #b3261e; --good: #2f7d4f; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaee; --soft: #98a0ad; --paper: #16181c; --card: #1f2228;
  --line: #343942; --fdda: #f0964a; --bad: #ff8a80; --good: #7fd1a0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 40px 28px 80px; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; font-variant-numeric: tabular-nums; }
h1 { font-size: 26px; margin: 0; font-weight: 650; } h2 { font-size: 17px; margin: 40px 0 6px; font-weight: 650; }
p { margin: 2px 0 14px; color: var(--soft); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin-top: 22px; }
.card { background: var(--card); border-radius: 8px; padding: 12px 16px; }
.card b { display: block; font-size: 23px; font-weight: 650; line-height: 1.25; }
.card span { color: var(--soft); font-size: 12.5px; } .card.bad b { color: var(--bad); }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: 13px; white-space: nowrap; }
th, td { padding: 5px 9px; text-align: right; border-bottom: 1px solid var(--line); } th { font-weight: 600; }
th:first-child, td:first-child, td.text, th.text { text-align: left; } thead th { color: var(--soft); }
.bad { color: var(--bad); } .good { color: var(--good); } .soft { color: var(--soft); }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 18px; margin: 8px 0; }
dt { font-weight: 600; } dd { margin: 0; overflow-wrap: anywhere; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(420px, 1fr)); gap: 20px; }
figure { margin: 0; } figure img { width: 100%; border-radius: 8px; display: block; }
figcaption { font-size: 13px; color: var(--soft); }
"""
NOTHING = '<td class="soft">&ndash;</td>'


def render_page(report: dict, pictures: dict[str, list[tuple[str, bytes]]]) -> str:
    """Return the page as HTML.

    Args:
        report: what `report.json` holds.
        pictures: by the name of a character, PNG files each with a name.
    """
    title = f"{escape(str(report['plan']))}: characters"
    parts = [
        _head(report),
        _failures(report),
        _errors(report),
        _times_table(report),
        _warnings(report),
        _pictures(pictures),
    ]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
        f"{''.join(parts)}</body></html>\n"
    )


def _head(report: dict) -> str:
    characters = report["characters"].values()
    states = [own["state"] for own in characters]
    seconds = sum(sum(own["seconds"].values()) for own in characters)
    cards = [
        (f"{states.count('done')} of {len(states)}", "characters are done", ""),
        (str(states.count("failed")), "failed", "bad" if "failed" in states else ""),
        (str(sum(_misses_goal(own) for own in characters)), "done, and miss their goal", ""),
        (str(sum(own["ran_now"] for own in characters)), "tasks ran now, the others were up to date", ""),
        (format_duration(seconds).removeprefix("about "), "of processes, one after the other", ""),
        (f"{max((own['peak_mb'] for own in characters), default=0):,.0f} MB", "most memory of a process", ""),
    ]
    shown = "".join(
        f'<div class="card {kind}"><b>{escape(value)}</b><span>{text}</span></div>' for value, text, kind in cards
    )
    name, written = escape(str(report["plan"])), escape(str(report["written"]))
    return f'<h1>{name}</h1><p>Written {written}.</p><div class="cards">{shown}</div>'


def _misses_goal(own: dict) -> bool:
    return any(own["goal_mm"] and model["fdda"].get("p999", 0) > own["goal_mm"] for model in own["models"])


def _failures(report: dict) -> str:
    rows = [
        f"<dt>{escape(failure['task'])}</dt><dd><span class='bad'>{escape(failure['state'])}</span>: "
        f"{escape(failure['sentence'])}</dd>"
        for own in report["characters"].values()
        for failure in own["failures"]
    ]
    return f"<h2>What failed</h2><dl>{''.join(rows)}</dl>" if rows else ""


def _errors(report: dict) -> str:
    head = "".join(
        f"<th{kind}>{text}</th>"
        for text, kind in (
            ("", ""),
            ("", ' class="text"'),
            ("vertices", ""),
            *(
                (text, "")
                for text in ("mean", "p99.9", "max", "linear skinning: mean", "p99.9", "goal p99.9", "rounds")
            ),
            ("against the last run: mean", ""),
            ("p99.9", ""),
        )
    )
    rows = "".join(_error_rows(name, own) for name, own in report["characters"].items())
    return (
        "<h2>Errors</h2><p>Millimetres, on held-out poses: the model, and linear skinning, against the rig.</p>"
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _error_rows(name: str, own: dict) -> str:
    kinds = {"done": "good", "failed": "bad"}
    state = f'<td class="text {kinds.get(own["state"], "soft")}">{escape(own["state"])}</td>'
    if not own["models"]:
        return f"<tr><td>{escape(name)}</td>{state}{NOTHING * 10}</tr>"
    before = {model["name"]: model for model in (own.get("before") or {}).get("models") or []}
    rows = []
    for model in own["models"]:
        shown = name if len(own["models"]) == 1 else f"{name}: {model['name']}"
        fdda, linear, goal = model["fdda"], model["linear"], own["goal_mm"]
        is_met = bool(goal) and fdda.get("p999", 0) <= goal
        verdict = f'<td class="{"good" if is_met else "bad"}">{goal:g} {"met" if is_met else "missed"}</td>'
        last = before.get(model["name"], {}).get("fdda", {})
        cells = [
            f"<td>{model['vertices']:,}</td>",
            *(_mm(fdda.get(key)) for key in ("mean", "p999", "max")),
            *(_mm(linear.get(key)) for key in ("mean", "p999")),
            verdict if goal else NOTHING,
            f"<td>{model['round']} of {model['rounds'] - 1}</td>" if model["rounds"] > 1 else NOTHING,
            *(_change(fdda.get(key), last.get(key)) for key in ("mean", "p999")),
        ]
        rows.append(f"<tr><td>{escape(shown)}</td>{state}{''.join(cells)}</tr>")
    return "".join(rows)


def _mm(value: float | None) -> str:
    return NOTHING if value is None else f"<td>{value:.3f}</td>"


def _change(value: float | None, last: float | None) -> str:
    if value is None or not last:
        return NOTHING
    part = value / last - 1
    kind = "soft" if abs(part) < 0.02 else "bad" if part > 0 else "good"
    return f'<td class="{kind}">{100 * part:+.0f} %</td>'


def _times_table(report: dict) -> str:
    head = "".join(f"<th>{kind}</th>" for kind in KINDS)
    rows = []
    for name, own in report["characters"].items():
        seconds = [own["seconds"].get(kind, 0) for kind in KINDS]
        last = sum(((own.get("before") or {}).get("seconds") or {}).values())
        cells = "".join(f"<td>{value:,.1f}</td>" if value else NOTHING for value in seconds)
        rows.append(
            f"<tr><td>{escape(name)}</td>{cells}<td>{sum(seconds):,.1f}</td>{_change(sum(seconds), last)}"
            f"<td>{own['peak_mb']:,.0f}</td><td>{own['ran_now']} of {own['tasks']}</td></tr>"
        )
    return (
        "<h2>Times</h2><p>Seconds of the processes of each kind of task, when it was last run.</p>"
        f'<div class="scroll"><table><thead><tr><th></th>{head}<th>all</th><th>against the last run</th>'
        f"<th>peak MB</th><th>ran now</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _warnings(report: dict) -> str:
    rows = [
        f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>"
        for name, own in report["characters"].items()
        for model in own["models"]
        for text in model["warnings"]
    ]
    return f"<h2>Warnings</h2><p>What is suspicious about the recordings.</p><dl>{''.join(rows)}</dl>" if rows else ""


def _pictures(pictures: dict[str, list[tuple[str, bytes]]]) -> str:
    figures = []
    for character, own in pictures.items():
        for name, content in own:
            text = escape(character if name == character else f"{character}: {name}")
            data = base64.b64encode(content).decode("ascii")
            figures.append(
                f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
            )
    if not figures:
        return ""
    return (
        "<h2>Heat maps</h2><p>Rig, linear skinning and model; the color is the distance from the rig.</p>"
        f'<div class="pictures">{"".join(figures)}</div>'
    )
