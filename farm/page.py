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
EMPTY_CELL = '<td class="soft">&ndash;</td>'


def render_page(report: dict, pictures: dict[str, list[tuple[str, bytes]]]) -> str:
    """Return the page as HTML.

    Args:
        report: content of `report.json`.
        pictures: for each character, the name of each model and its PNG file.
    """
    title = f"{escape(str(report['plan']))}: characters"
    parts = [
        _summary_cards(report),
        _failures_list(report),
        _errors_table(report),
        _times_table(report),
        _warnings_list(report),
        _heat_maps(pictures),
    ]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
        f"{''.join(parts)}</body></html>\n"
    )


def _summary_cards(report: dict) -> str:
    characters = report["characters"].values()
    states = [character["state"] for character in characters]
    seconds = sum(sum(character["seconds"].values()) for character in characters)
    cards = [
        (f"{states.count('done')} of {len(states)}", "characters are done", ""),
        (str(states.count("failed")), "failed", "bad" if "failed" in states else ""),
        (str(sum(_misses_goal(character) for character in characters)), "done, but miss their goal", ""),
        (
            str(sum(character["ran_now"] for character in characters)),
            "tasks ran now, the others were up to date",
            "",
        ),
        (format_duration(seconds).removeprefix("about "), "total time of all processes", ""),
        (
            f"{max((character['peak_mb'] for character in characters), default=0):,.0f} MB",
            "largest memory of a process",
            "",
        ),
    ]
    cards_html = "".join(
        f'<div class="card {kind}"><b>{escape(value)}</b><span>{text}</span></div>' for value, text, kind in cards
    )
    name, written = escape(str(report["plan"])), escape(str(report["written"]))
    return f'<h1>{name}</h1><p>Written {written}.</p><div class="cards">{cards_html}</div>'


def _misses_goal(character: dict) -> bool:
    return any(
        character["goal_mm"] and model["fdda"].get("p999", 0) > character["goal_mm"] for model in character["models"]
    )


def _failures_list(report: dict) -> str:
    rows = [
        f"<dt>{escape(failure['task'])}</dt><dd><span class='bad'>{escape(failure['state'])}</span>: "
        f"{escape(failure['sentence'])}</dd>"
        for character in report["characters"].values()
        for failure in character["failures"]
    ]
    return f"<h2>Failed tasks</h2><dl>{''.join(rows)}</dl>" if rows else ""


def _errors_table(report: dict) -> str:
    header = "".join(
        f"<th{attribute}>{text}</th>"
        for text, attribute in (
            ("", ""),
            ("", ' class="text"'),
            ("vertices", ""),
            *(
                (text, "")
                for text in ("mean", "p99.9", "max", "linear skinning: mean", "p99.9", "goal p99.9", "rounds")
            ),
            ("change from the last run: mean", ""),
            ("p99.9", ""),
        )
    )
    rows = "".join(_error_rows(name, character) for name, character in report["characters"].items())
    return (
        "<h2>Errors</h2><p>Distances of the model and of linear skinning from the rig on held-out poses, mm.</p>"
        f'<div class="scroll"><table><thead><tr>{header}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _error_rows(name: str, character: dict) -> str:
    css_class = {"done": "good", "failed": "bad"}.get(character["state"], "soft")
    state = f'<td class="text {css_class}">{escape(character["state"])}</td>'
    if not character["models"]:
        return f"<tr><td>{escape(name)}</td>{state}{EMPTY_CELL * 10}</tr>"
    last_models = {model["name"]: model for model in (character.get("before") or {}).get("models") or []}
    rows = []
    for model in character["models"]:
        label = name if len(character["models"]) == 1 else f"{name}: {model['name']}"
        fdda, linear, goal = model["fdda"], model["linear"], character["goal_mm"]
        is_met = bool(goal) and fdda.get("p999", 0) <= goal
        verdict = f'<td class="{"good" if is_met else "bad"}">{goal:g} {"met" if is_met else "missed"}</td>'
        last_errors = last_models.get(model["name"], {}).get("fdda", {})
        cells = [
            f"<td>{model['vertices']:,}</td>",
            *(_millimeter_cell(fdda.get(key)) for key in ("mean", "p999", "max")),
            *(_millimeter_cell(linear.get(key)) for key in ("mean", "p999")),
            verdict if goal else EMPTY_CELL,
            f"<td>{model['round']} of {model['rounds'] - 1}</td>" if model["rounds"] > 1 else EMPTY_CELL,
            *(_change_cell(fdda.get(key), last_errors.get(key)) for key in ("mean", "p999")),
        ]
        rows.append(f"<tr><td>{escape(label)}</td>{state}{''.join(cells)}</tr>")
    return "".join(rows)


def _millimeter_cell(value: float | None) -> str:
    return EMPTY_CELL if value is None else f"<td>{value:.3f}</td>"


def _change_cell(value: float | None, last_value: float | None) -> str:
    if value is None or not last_value:
        return EMPTY_CELL
    change = value / last_value - 1
    css_class = "soft" if abs(change) < 0.02 else "bad" if change > 0 else "good"
    return f'<td class="{css_class}">{100 * change:+.0f} %</td>'


def _times_table(report: dict) -> str:
    header = "".join(f"<th>{kind}</th>" for kind in KINDS)
    rows = []
    for name, character in report["characters"].items():
        seconds = [character["seconds"].get(kind, 0) for kind in KINDS]
        last_seconds = sum(((character.get("before") or {}).get("seconds") or {}).values())
        cells = "".join(f"<td>{value:,.1f}</td>" if value else EMPTY_CELL for value in seconds)
        rows.append(
            f"<tr><td>{escape(name)}</td>{cells}<td>{sum(seconds):,.1f}</td>{_change_cell(sum(seconds), last_seconds)}"
            f"<td>{character['peak_mb']:,.0f}</td><td>{character['ran_now']} of {character['tasks']}</td></tr>"
        )
    return (
        "<h2>Times</h2><p>Seconds of the processes of each kind of task in its last run.</p>"
        f'<div class="scroll"><table><thead><tr><th></th>{header}<th>total</th><th>change from the last run</th>'
        f"<th>peak MB</th><th>ran now</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _warnings_list(report: dict) -> str:
    rows = [
        f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>"
        for name, character in report["characters"].items()
        for model in character["models"]
        for text in model["warnings"]
    ]
    return f"<h2>Warnings</h2><p>Possible problems of the recordings.</p><dl>{''.join(rows)}</dl>" if rows else ""


def _heat_maps(pictures: dict[str, list[tuple[str, bytes]]]) -> str:
    figures = []
    for character, named_pictures in pictures.items():
        for name, content in named_pictures:
            text = escape(character if name == character else f"{character}: {name}")
            data = base64.b64encode(content).decode("ascii")
            figures.append(
                f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
            )
    if not figures:
        return ""
    return (
        "<h2>Heat maps</h2><p>The rig, linear skinning and the model; the color shows the distance from the rig.</p>"
        f'<div class="pictures">{"".join(figures)}</div>'
    )
