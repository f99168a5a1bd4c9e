# SPDX-License-Identifier: GPL-3.0-or-later
"""Rules for source files that ruff cannot check: no pickled arrays, no console windows."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("fdda_addon", "trainer", "farm", "benchmarks", "tests", "blend_fixtures", "setup", "docs", "examples")
PROCESS_FUNCTIONS = ("Popen", "run", "call", "check_call", "check_output")


def test_no_file_loads_pickled_arrays():
    unsafe_arguments = {("allow_pickle", True), ("weights_only", False)}  # of numpy.load and torch.load
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    violations = [
        f"{path}:{node.value.lineno}: {node.arg}={node.value.value}"
        for path in files
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.keyword)
        and isinstance(node.value, ast.Constant)
        and (node.arg, node.value.value) in unsafe_arguments
    ]
    assert files and violations == []


def test_processes_of_blender_open_no_console_window():
    """`child_options` prevents the window on Windows. Verbs are exempt: their processes print into the open console."""
    call_count, calls_without_options = 0, []
    for file in sorted((ROOT / "fdda_addon").rglob("*.py")):
        if "cli" in file.parts:
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in {f"subprocess.{n}" for n in PROCESS_FUNCTIONS}:
                call_count += 1
                if not any(k.arg is None and "options" in ast.unparse(k.value) for k in node.keywords):
                    calls_without_options.append(f"{file.relative_to(ROOT).as_posix()}:{node.lineno}")
    assert call_count > 4 and calls_without_options == []
