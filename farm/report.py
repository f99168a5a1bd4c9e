# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of all characters: `report.json` and a page. docs/farm.md has the keys."""

import time
from pathlib import Path
from typing import Any

from fdda_addon.core.output import write_json, write_text

from .characters import Character, Plan
from .fingerprints import MAX_RECORDED_VALUE, TaskManifest, read_json, read_manifest
from .page import render_page
from .run import BLOCKED, SUCCESS_STATES, Outcome
from .tasks import BIND, EVALUATE, EVALUATION, KINDS, PICTURE, REFINE, REPORT, Task

FORMAT, VERSION = "fdda-farm-report", 1
BOUND, UNFINISHED, BROKEN = "done", "not done", "failed"
MAX_PICTURE_BYTES = 8 << 20
ERRORS = {str: float}
MODEL = {
    **{"name": str, "file": str, "round": int, "rounds": int, "poses_added": bool, "vertices": int},
    **{"fdda": ERRORS, "linear": ERRORS, "verdict": str, "warnings": [str]},
}
FAILURE = {"task": str, "state": str, "sentence": str}
SUMMARY = {"state": str, "models": [MODEL], "seconds": {str: float}, "failures": [FAILURE]}
CHARACTER = {
    **SUMMARY,
    **{"rig": str, "output": str, "goal_mm": float, "peak_mb": float, "hosts": [str], "tasks": int, "ran_now": int},
    **{"key": str, "before": (SUMMARY, None)},
}
"""What a report says of a character: lists of, dictionaries of, or one of several."""


def write_report(plan: Plan, tasks: dict[str, Task], outcomes: dict[str, Outcome], page: Path) -> None:
    """Write `report.html` and, beside it, `report.json`; what it said before is what it compares with.

    Args:
        plan, tasks: the farm; of characters that have no tasks here nothing is said anew.
        outcomes: of the tasks that ran now, by their names.
        page: the .html file.

    Raises:
        OutputError: it cannot be written.
    """
    path = page.with_suffix(".json")
    before = _read(path)
    asked = {task.character for task in tasks.values()}
    characters = {}
    for character in plan.characters:
        if character.name in asked:
            own = {name: task for name, task in tasks.items() if task.character == character.name}
            characters[character.name] = _character(character, own, outcomes)
        elif character.name in before:
            characters[character.name] = before[character.name]
    for name, value in characters.items():
        # A run that did nothing is compared with what the last that did something was compared with.
        last = before.get(name, {})
        value["before"] = last.get("before") if not _differs_from_last(value, last) else _summary(last)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "plan": plan.path.name,
        "written": time.strftime("%Y-%m-%d %H:%M:%S"),
        "characters": characters,
    }
    write_json(path, content)
    pictures = {character.name: _pictures(tasks, character) for character in plan.characters}
    write_text(page, render_page(content, pictures))


def _character(character: Character, tasks: dict[str, Task], outcomes: dict[str, Outcome]) -> dict:
    manifests = {name: read_manifest(task) for name, task in tasks.items()}
    failures = [
        {"task": name, "state": outcomes[name].state, "sentence": outcomes[name].sentence}
        for name in tasks
        if name in outcomes and outcomes[name].state not in (*SUCCESS_STATES, BLOCKED)
    ]
    bind = next(task for task in tasks.values() if task.kind == BIND)
    is_bound = manifests[bind.name] is not None and not failures and bind.name not in _unfinished_tasks(outcomes)
    ran = {name: manifest for name, manifest in manifests.items() if manifest is not None and not manifest.skipped}
    return {
        "state": BOUND if is_bound else BROKEN if failures else UNFINISHED,
        "rig": character.rig.name,
        "output": str(character.output),
        "failures": failures,
        "goal_mm": character.goal_mm,
        "models": _models(tasks, bind, manifests[bind.name]) if is_bound else [],
        "seconds": {kind: round(sum(s.seconds for n, s in ran.items() if tasks[n].kind == kind), 1) for kind in KINDS},
        "peak_mb": max((manifest.peak_mb for manifest in ran.values()), default=0.0),
        "hosts": sorted({manifest.host for manifest in ran.values() if manifest.host}),
        "tasks": len(tasks),
        "ran_now": sum(outcomes[name].state == "done" for name in tasks if name in outcomes),
        "key": manifests[bind.name].key if is_bound else "",
    }


def _unfinished_tasks(outcomes: dict[str, Outcome]) -> set[str]:
    return {name for name, outcome in outcomes.items() if outcome.state not in SUCCESS_STATES}


def _models(tasks: dict[str, Task], bind: Task, manifest: TaskManifest) -> list[dict]:
    """Return errors and round of each bound model."""
    found = []
    for place, rounds in bind.choices:
        bound = manifest.notes.get("bound")
        train = bound.get(place) if isinstance(bound, dict) else None
        if train not in [name for name, _ in rounds]:
            train = rounds[0][0]
        errors = _read_json(bind.folder / Path(place).with_name(EVALUATION))
        report = _read_json(bind.folder / Path(place).with_name(REPORT[0]))
        refined = [name for name, task in tasks.items() if task.kind == REFINE and not _was_skipped(task)]
        rounds_done = sum(
            not _was_skipped(tasks[evaluate]) for _, evaluate in rounds if tasks[evaluate].kind == EVALUATE
        )
        found.append(
            {
                "name": Path(place).stem,
                "file": place,
                "round": int(train.rpartition("-")[2]),
                "rounds": rounds_done,
                "poses_added": len(refined) > 0,
                "vertices": _value_or_default(errors.get("vertices"), int, 0),
                "fdda": _errors(errors.get("fdda")),
                "linear": _errors(errors.get("linear")),
                "verdict": _value_or_default(_value_or_default(report.get("goal"), dict, {}).get("verdict"), str, ""),
                "warnings": [own["text"] for own in _value_or_default(report.get("warnings"), [{"text": str}], [])],
            }
        )
    return found


def _was_skipped(task: Task) -> bool:
    manifest = read_manifest(task)
    return manifest is None or bool(manifest.skipped)


def _pictures(tasks: dict[str, Task], character: Character) -> list[tuple[str, bytes]]:
    """Return the heat maps of the bound models of a character, by model name."""
    bind = tasks.get(f"{character.name}/{BIND}")
    found = []
    for place, _ in bind.choices if bind else ():
        path = bind.folder / Path(place).with_name(PICTURE)
        if path.is_file() and path.stat().st_size <= MAX_PICTURE_BYTES:
            found.append((Path(place).stem, path.read_bytes()))
    return found


def _differs_from_last(value: dict, last: dict) -> bool:
    keys = ("state", "key", "models", "failures")
    return any(value.get(key) != last.get(key) for key in keys)


def _summary(last: dict) -> dict | None:
    """Return the values that the next report compares with; None without a report."""
    if not last:
        return None
    return {key: last.get(key) for key in ("state", "models", "seconds", "failures")}


def _read(path: Path) -> dict:
    """Read the characters of the last report, without invalid ones."""
    value = _read_json(path)
    characters = value.get("characters")
    if (value.get("format"), value.get("version")) != (FORMAT, VERSION) or not isinstance(characters, dict):
        return {}
    return {name: own for name, own in characters.items() if _matches_schema(own, CHARACTER)}


def _read_json(path: Path) -> dict:
    try:
        return read_json(path)
    except (OSError, ValueError):
        return {}


def _errors(value: object) -> dict[str, float]:
    values = _value_or_default(value, dict, {})
    return {key: values[key] for key in ("mean", "p999", "max") if _matches_schema(values.get(key), float)}


def _value_or_default(value: object, kind: Any, default: Any) -> Any:
    return value if _matches_schema(value, kind) else default


def _matches_schema(value: object, kind: Any) -> bool:
    """Return whether a JSON value matches a schema such as `CHARACTER`."""
    if isinstance(kind, tuple):
        return any(_matches_schema(value, one) for one in kind)
    if isinstance(kind, list):
        return isinstance(value, list) and all(_matches_schema(one, kind[0]) for one in value)
    if isinstance(kind, dict):
        of_all = kind.get(str)
        return isinstance(value, dict) and (
            all(_matches_schema(one, of_all) for one in value.values())
            if of_all
            else all(_matches_schema(value.get(name), one) for name, one in kind.items())
        )
    if kind in (int, float):
        is_number = isinstance(value, (int, kind)) and not isinstance(value, bool)
        return is_number and abs(value) < MAX_RECORDED_VALUE
    return value is None if kind is None else isinstance(value, kind)
