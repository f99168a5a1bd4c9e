# SPDX-License-Identifier: GPL-3.0-or-later
"""Rules for source files that ruff cannot check: no pickled arrays, no empty file names, no host names."""

import ast
import os
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "fdda_addon",
    "trainer",
    "farm",
    "benchmarks",
    "tests",
    "blend_fixtures",
    "setup",
    "requirements",
    "docs",
    "examples",
    ".ci",
)
GENERATED_FOLDERS = {"node_modules", "dist"}
"""Names of folders that other programs generate; their files are not checked."""
PROCESS_FUNCTIONS = ("Popen", "run", "call", "check_call", "check_output")
SPDX = "# SPDX-License-Identifier: GPL-3.0-or-later"

# These names do not say what a file contains, so everything would be added to it.
FORBIDDEN_NAMES = {
    "util",
    "utils",
    "helper",
    "helpers",
    "function",
    "functions",
    "misc",
    "common",
    "manager",
    "service",
}

# Each machine chooses the mirror from which it installs packages, so no file may name one.
REGISTRY_HOST = re.compile(
    "|".join(
        "".join(parts)
        for parts in (("py", "pi"), ("python", "hosted"), ("npm", "js"), ("deb.", "debian"), ("load.", "pytorch"))
    )
)


def text_files() -> Iterator[tuple[Path, str]]:
    """Yield the path and the text of every text file of the project."""
    files = [file for file in ROOT.iterdir() if file.is_file() and not file.name.startswith(".venv")]
    for folder, subfolders, names in (walk_step for top in FOLDERS for walk_step in os.walk(ROOT / top)):
        subfolders[:] = sorted(set(subfolders) - GENERATED_FOLDERS)
        files += [Path(folder, name) for name in names]
    for file in files:
        try:
            yield file.relative_to(ROOT), file.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue


WEB_FILES = (".js", ".mjs", ".css", ".html")

PYTHON_FILES = {str(path): text for path, text in sorted(text_files()) if path.suffix == ".py"}


def test_web_files_name_their_license():
    texts = {str(path): text for path, text in text_files() if path.suffix in WEB_FILES}
    assert texts and [path for path, text in texts.items() if SPDX[2:] not in "".join(text.splitlines()[:2])] == []


def test_no_file_loads_pickled_arrays():
    unsafe_arguments = {("allow_pickle", True), ("weights_only", False)}  # of numpy.load and torch.load
    violations = [
        f"{path}:{node.value.lineno}: {node.arg}={node.value.value}"
        for path, text in PYTHON_FILES.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.keyword)
        and isinstance(node.value, ast.Constant)
        and (node.arg, node.value.value) in unsafe_arguments
    ]
    assert violations == []


def test_file_names_say_what_the_files_contain():
    assert [path for path in PYTHON_FILES if FORBIDDEN_NAMES & set(Path(path).with_suffix("").parts)] == []


def test_no_file_names_a_package_registry():
    assert [str(path) for path, text in text_files() if REGISTRY_HOST.search(text)] == []


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
