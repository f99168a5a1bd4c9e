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
    "__init__.py": ("_cli_command",),
    "cli/interruption.py": ("_callback_modules", "_pending_signal"),
    "core/recording/lock.py": ("_held_lock_paths",),
    "evaluation/heat_map.py": ("_colors",),
    "evaluation/last_evaluation.py": ("_evaluations",),
    "evaluation/timeline.py": ("graph",),
    "jobs/background.py": ("_runner",),
    "jobs/job.py": ("_running", "_states"),
    "models/model_list.py": ("_info_cache",),
    "operators/clipboard.py": ("_keymap_items",),
    "operators/frame_profile.py": ("_profiles",),
    "operators/rig.py": ("_measured_costs",),
    "panels/checks.py": ("_changed_meshes", "_checks", "_outdated", "_requested"),
    "panels/curves.py": ("_drawn_key", "_previews"),
    "panels/limits.py": ("_limits_cache",),
    "panels/models.py": ("_problem_values", "_rig_cache"),
    "panels/playback.py": ("_confidence_value",),
    "panels/recording.py": ("_content_cache",),
    "panels/section.py": ("_wrap",),
    "panels/trained_file.py": ("_mismatch_cache",),
    "panels/training.py": ("_assessment_cache", "_report_cache"),
    "poses/action_range.py": ("_cache",),
    "recording/preview.py": ("_shown_pose",),
    "registration.py": ("_is_registered",),
    "runtime/session.py": ("session",),
    "scene/draw_cache.py": ("_caches", "_expires_at"),
    "scene/stored_paths.py": ("_running_saves",),
    "scene/undo.py": ("_pending_message",),
    "scene/unkeyed_changes.py": ("_request",),
    "timing/frame_times.py": ("_frame_times",),
    "training/detached_process.py": ("_child_processes",),
    "training/environment/session.py": ("_folder_state", "check_result", "notice"),
}


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


def test_state_is_found():
    source = """
import functools
from x import imported
_count, _table, CONSTANT, _object = 0, {}, {1: 2}, Session()
_draw_handles: list = []
def count():
    global _count
    _count += 1
    _table["a"].b = 1
    imported.attribute = 2
    CONSTANT.get(1)
def add():
    local = []
    local.append(1)
    _draw_handles.append(1)
@functools.lru_cache
def cached():
    return CONSTANT[1]
"""
    assert state_of(source) == {"_count", "_table", "_draw_handles", "cached"}
    assert state_of("session = Session()\n") == {"session"}


def test_no_module_has_state_that_is_not_listed():
    for path in sorted(ADD_ON.rglob("*.py")):
        name = path.relative_to(ADD_ON).as_posix()
        unlisted = state_of(path.read_text(encoding="utf-8")) - set(STATE.get(name, ()))
        assert not unlisted, f"{name} has new global state {unlisted}: keep it in an object that someone owns"


def test_the_only_state_of_playback_is_the_session():
    assert {path: names for path, names in STATE.items() if path.startswith("runtime/")} == {
        "runtime/session.py": ("session",)
    }
    assert sum(map(len, STATE.values())) <= 43
