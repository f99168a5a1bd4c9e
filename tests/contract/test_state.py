# SPDX-License-Identifier: GPL-3.0-or-later
"""Global state of the add-on: each module global that changes is listed here, and the list only becomes shorter."""

import ast
from collections.abc import Iterator
from pathlib import Path

ADD_ON = Path(__file__).resolve().parents[2] / "fdda_addon"
MUTATING_METHODS = frozenset(
    {"add", "append", "appendleft", "clear", "discard", "extend", "insert", "pop", "popitem", "remove", "setdefault",
     "update"}
)  # fmt: skip
STATE = {
    "__init__.py": {"_cli_command": "made by register, dropped by unregister"},
    "cli/interruption.py": {"_pending_signal": "set by a signal, dropped when its KeyboardInterrupt is raised"},
    "evaluation/heat_map.py": {"_colors": "colors of meshes, from paint_… to clear; all end with unregister"},
    "evaluation/last_evaluation.py": {"_evaluations": "the last 4 evaluations, also of closed files, until unregister"},
    "evaluation/timeline.py": {"graph": "drawn from start to stop"},
    "jobs/job.py": {"_runners": "the last job of each verb; another file drops ended jobs"},
    "panels/checks.py": {"_changes": "what changed since the checks of rigs, until another file is opened"},
    "panels/curves.py": {"image": "made by the first drawing, freed by unregister"},
    "panels/timed_value.py": {"timed_values": "values that panels draw, until their object is removed, or unregister"},
    "runtime/session.py": {"session": "the characters of the open file; another file resets it"},
    "scene/draw_cache.py": {"_cache": "what drawing has read; another file drops all of it"},
    "scene/stored_paths.py": {"_running_saves": "each from save_pre to save_post"},
    "scene/unkeyed_changes.py": {"_request": "for two turns of the main loop"},
    "timing/measurements.py": {"_measurements": "measured times, until another file is opened"},
    "training/detached_process.py": {"_child_processes": "processes of trainings, while Blender runs"},
    "training/environment/session.py": {
        "check_result": "set by checks of the trainer's Python, dropped when another Python is chosen",
        "notice": "set and dropped with check_result",
    },
}
"""By file: each module global that changes, who makes it, and when it is dropped."""


def base_name(node: ast.AST) -> str:
    """Return the name at the start of an expression such as `name[0].attribute`; empty for other expressions."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def changed_names(function: ast.AST) -> Iterator[str]:
    """Yield the names that a function assigns globally, or whose elements or attributes it changes."""
    for node in ast.walk(function):
        if isinstance(node, ast.Global):
            yield from node.names
        elif isinstance(node, ast.Subscript | ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
            yield base_name(node)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in MUTATING_METHODS:
            yield base_name(node.func.value)


def state_of(source: str) -> set[str]:
    """Return the module globals that hold state.

    These are the globals that functions of the module change, the objects of classes, and functions with an
    `lru_cache`. Functions that are `draw_cached` share the state of `scene.draw_cache`.
    """
    tree = ast.parse(source)
    assigned = {
        name.id: statement.value
        for statement in tree.body
        if isinstance(statement, ast.Assign | ast.AnnAssign)
        for target in (statement.targets if isinstance(statement, ast.Assign) else [statement.target])
        for name in ast.walk(target)
        if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
    }
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Lambda)]
    changed = {name for function in functions for name in changed_names(function)} & assigned.keys()
    objects = {
        name
        for name, value in assigned.items()
        if name.islower() and isinstance(value, ast.Call) and base_name(value.func).lstrip("_")[:1].isupper()
    }
    cached = {
        statement.name
        for statement in tree.body
        if isinstance(statement, ast.FunctionDef)
        and any("lru_cache" in ast.unparse(decorator) for decorator in statement.decorator_list)
    }
    return changed | objects | cached


def test_no_module_has_state_that_is_not_listed():
    for path in sorted(ADD_ON.rglob("*.py")):
        name = path.relative_to(ADD_ON).as_posix()
        unlisted = state_of(path.read_text(encoding="utf-8")) - STATE.get(name, {}).keys()
        assert not unlisted, f"{name} has new global state {unlisted}: keep it in an object that someone owns"


def test_all_listed_state_exists():
    for name, state in STATE.items():
        assert state.keys() <= state_of((ADD_ON / name).read_text(encoding="utf-8")), name
