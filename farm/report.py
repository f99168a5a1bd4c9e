# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the report of all characters: `report.json` and an HTML page. docs/farm.md lists the keys."""

import time
from pathlib import Path
from typing import Any

from fdda_addon.core.output import write_json, write_text

from .characters import Character, Plan
from .fingerprints import MAX_RECORDED_VALUE, TaskManifest, read_json, read_manifest
from .page import render_page
from .run import BLOCKED, SUCCESS_STATES, Outcome
from .task import REPORT, Task
from .tasks import BIND, EVALUATE, EVALUATION, KINDS, PICTURE, REFINE

FORMAT, VERSION = "fdda-farm-report", 1
DONE_STATE, UNFINISHED_STATE, FAILED_STATE = "done", "not done", "failed"
MAX_PICTURE_BYTES = 8 << 20
ERRORS_SCHEMA = {str: float}
MODEL_SCHEMA = {
    **{"name": str, "file": str, "round": int, "rounds": int, "poses_added": bool, "vertices": int},
    **{"fdda": ERRORS_SCHEMA, "linear": ERRORS_SCHEMA, "verdict": str, "warnings": [str]},
}
FAILURE_SCHEMA = {"task": str, "state": str, "sentence": str}
SUMMARY_SCHEMA = {
    **{"state": str, "models": [MODEL_SCHEMA]},
    **{"seconds": {str: float}, "failures": [FAILURE_SCHEMA]},
}
CHARACTER_SCHEMA = {
    **SUMMARY_SCHEMA,
    **{"rig": str, "output": str, "goal_mm": float, "peak_mb": float, "hosts": [str], "tasks": int, "ran_now": int},
    **{"key": str, "before": (SUMMARY_SCHEMA, None)},
}
"""Schema of a character: [x] is a list of x, {str: x} a dictionary with values x, a tuple a choice."""


def write_report(plan: Plan, tasks: dict[str, Task], outcomes: dict[str, Outcome], page: Path) -> None:
    """Write the report as an HTML page and as `report.json`, and compare it with the existing `report.json`.

    Args:
        plan, tasks: the graph. A character without tasks keeps its entry of the existing report.
        outcomes: outcomes of the tasks of this run, by task name.
        page: path of the HTML page; the JSON file is beside it.

    Raises:
        OutputError: a file cannot be written.
    """
    path = page.with_suffix(".json")
    last_report = _read_last_report(path)
    updated_names = {task.character for task in tasks.values()}
    characters = {}
    for character in plan.characters:
        if character.name in updated_names:
            character_tasks = {name: task for name, task in tasks.items() if task.character == character.name}
            characters[character.name] = _character_report(character, character_tasks, outcomes)
        elif character.name in last_report:
            characters[character.name] = last_report[character.name]
    for name, value in characters.items():
        # A run without changes keeps the comparison of the last run, instead of comparing with equal values.
        last = last_report.get(name, {})
        value["before"] = last.get("before") if not _differs_from_last(value, last) else _summary(last)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "plan": plan.path.name,
        "written": time.strftime("%Y-%m-%d %H:%M:%S"),
        "characters": characters,
    }
    write_json(path, content)
    pictures = {character.name: _read_heat_maps(tasks, character) for character in plan.characters}
    write_text(page, render_page(content, pictures))


def _character_report(character: Character, tasks: dict[str, Task], outcomes: dict[str, Outcome]) -> dict:
    manifests = {name: read_manifest(task) for name, task in tasks.items()}
    failures = [
        {"task": name, "state": outcomes[name].state, "sentence": outcomes[name].sentence}
        for name in tasks
        if name in outcomes and outcomes[name].state not in (*SUCCESS_STATES, BLOCKED)
    ]
    bind = next(task for task in tasks.values() if task.kind == BIND)
    is_bound = manifests[bind.name] is not None and not failures and bind.name not in _unfinished_tasks(outcomes)
    ran_manifests = {
        name: manifest for name, manifest in manifests.items() if manifest is not None and not manifest.skipped
    }
    return {
        "state": DONE_STATE if is_bound else FAILED_STATE if failures else UNFINISHED_STATE,
        "rig": character.rig.name,
        "output": str(character.output),
        "failures": failures,
        "goal_mm": character.goal_mm,
        "models": _model_reports(tasks, bind, manifests[bind.name]) if is_bound else [],
        "seconds": {
            kind: round(sum(s.seconds for n, s in ran_manifests.items() if tasks[n].kind == kind), 1) for kind in KINDS
        },
        "peak_mb": max((manifest.peak_mb for manifest in ran_manifests.values()), default=0.0),
        "hosts": sorted({manifest.host for manifest in ran_manifests.values() if manifest.host}),
        "tasks": len(tasks),
        "ran_now": sum(outcomes[name].state == "done" for name in tasks if name in outcomes),
        "key": manifests[bind.name].key if is_bound else "",
    }


def _unfinished_tasks(outcomes: dict[str, Outcome]) -> set[str]:
    return {name for name, outcome in outcomes.items() if outcome.state not in SUCCESS_STATES}


def _model_reports(tasks: dict[str, Task], bind: Task, manifest: TaskManifest) -> list[dict]:
    """Return the report of each bound model: its errors, its round and its warnings."""
    model_reports = []
    for model_name, rounds in bind.choices:
        bound = manifest.notes.get("bound")
        train = bound.get(model_name) if isinstance(bound, dict) else None
        if train not in [name for name, _ in rounds]:
            train = rounds[0][0]
        errors = _read_json(bind.folder / Path(model_name).with_name(EVALUATION))
        report = _read_json(bind.folder / Path(model_name).with_name(REPORT[0]))
        refine_tasks = [name for name, task in tasks.items() if task.kind == REFINE and not _was_skipped(task)]
        rounds_done = sum(
            not _was_skipped(tasks[evaluate]) for _, evaluate in rounds if tasks[evaluate].kind == EVALUATE
        )
        model_reports.append(
            {
                "name": Path(model_name).stem,
                "file": model_name,
                "round": int(train.rpartition("-")[2]),
                "rounds": rounds_done,
                "poses_added": len(refine_tasks) > 0,
                "vertices": _value_or_default(errors.get("vertices"), int, 0),
                "fdda": _valid_errors(errors.get("fdda")),
                "linear": _valid_errors(errors.get("linear")),
                "verdict": _value_or_default(_value_or_default(report.get("goal"), dict, {}).get("verdict"), str, ""),
                "warnings": [
                    warning["text"] for warning in _value_or_default(report.get("warnings"), [{"text": str}], [])
                ],
            }
        )
    return model_reports


def _was_skipped(task: Task) -> bool:
    manifest = read_manifest(task)
    return manifest is None or bool(manifest.skipped)


def _read_heat_maps(tasks: dict[str, Task], character: Character) -> list[tuple[str, bytes]]:
    """Read the heat maps of the bound models of a character; return each with the name of its model."""
    bind = tasks.get(f"{character.name}/{BIND}")
    heat_maps = []
    for model_name, _ in bind.choices if bind else ():
        path = bind.folder / Path(model_name).with_name(PICTURE)
        if path.is_file() and path.stat().st_size <= MAX_PICTURE_BYTES:
            heat_maps.append((Path(model_name).stem, path.read_bytes()))
    return heat_maps


def _differs_from_last(value: dict, last: dict) -> bool:
    keys = ("state", "key", "models", "failures")
    return any(value.get(key) != last.get(key) for key in keys)


def _summary(last: dict) -> dict | None:
    """Return the values of the last report that the new one compares with; None where there is no last report."""
    if not last:
        return None
    return {key: last.get(key) for key in ("state", "models", "seconds", "failures")}


def _read_last_report(path: Path) -> dict:
    """Read the valid characters of the last report, by name."""
    value = _read_json(path)
    characters = value.get("characters")
    if (value.get("format"), value.get("version")) != (FORMAT, VERSION) or not isinstance(characters, dict):
        return {}
    return {name: report for name, report in characters.items() if _matches_schema(report, CHARACTER_SCHEMA)}


def _read_json(path: Path) -> dict:
    try:
        return read_json(path)
    except (OSError, ValueError):
        return {}


def _valid_errors(value: object) -> dict[str, float]:
    values = _value_or_default(value, dict, {})
    return {key: values[key] for key in ("mean", "p999", "max") if _matches_schema(values.get(key), float)}


def _value_or_default(value: object, kind: Any, default: Any) -> Any:
    return value if _matches_schema(value, kind) else default


def _matches_schema(value: object, kind: Any) -> bool:
    """Return whether a JSON value matches a schema such as `CHARACTER_SCHEMA`."""
    if isinstance(kind, tuple):
        return any(_matches_schema(value, choice) for choice in kind)
    if isinstance(kind, list):
        return isinstance(value, list) and all(_matches_schema(item, kind[0]) for item in value)
    if isinstance(kind, dict):
        value_kind = kind.get(str)
        return isinstance(value, dict) and (
            all(_matches_schema(item, value_kind) for item in value.values())
            if value_kind
            else all(_matches_schema(value.get(name), item_kind) for name, item_kind in kind.items())
        )
    if kind in (int, float):
        is_number = isinstance(value, (int, kind)) and not isinstance(value, bool)
        return is_number and abs(value) < MAX_RECORDED_VALUE
    return value is None if kind is None else isinstance(value, kind)
