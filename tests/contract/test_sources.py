# SPDX-License-Identifier: GPL-3.0-or-later
"""What source files keep to and ruff cannot check: no pickled arrays, names that mean something, no host names."""

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
INSTALLED = {"node_modules", "dist"}
"""Folders of others, inside of ours."""
NEW_PROCESS = ("Popen", "run", "call", "check_call", "check_output")
SPDX = "# SPDX-License-Identifier: GPL-3.0-or-later"

# Names that say nothing about what is inside: such a file grows without end.
EMPTY_NAMES = {"util", "utils", "helper", "helpers", "function", "functions", "misc", "common", "manager", "service"}

# Which mirror packages come from is up to the machine that installs them.
REGISTRY_HOST = re.compile(
    "|".join(
        "".join(parts)
        for parts in (("py", "pi"), ("python", "hosted"), ("npm", "js"), ("deb.", "debian"), ("load.", "pytorch"))
    )
)


def text_files() -> Iterator[tuple[Path, str]]:
    """Every text file of the project, with its text."""
    files = [file for file in ROOT.iterdir() if file.is_file() and not file.name.startswith(".venv")]
    for folder, inner, names in (step for top in FOLDERS for step in os.walk(ROOT / top)):
        inner[:] = sorted(set(inner) - INSTALLED)
        files += [Path(folder, name) for name in names]
    for file in files:
        try:
            yield file.relative_to(ROOT), file.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue


WEB_FILES = (".js", ".mjs", ".css", ".html")

PYTHON_FILES = {str(path): text for path, text in sorted(text_files()) if path.suffix == ".py"}


def test_files_of_web_pages_name_their_license():
    texts = {str(path): text for path, text in text_files() if path.suffix in WEB_FILES}
    assert texts and [path for path, text in texts.items() if SPDX[2:] not in "".join(text.splitlines()[:2])] == []


def test_no_file_loads_pickled_arrays():
    unsafe = {("allow_pickle", True), ("weights_only", False)}  # of numpy.load and torch.load
    found = [
        f"{path}:{node.value.lineno}: {node.arg}={node.value.value}"
        for path, text in PYTHON_FILES.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.keyword)
        and isinstance(node.value, ast.Constant)
        and (node.arg, node.value.value) in unsafe
    ]
    assert found == []


def test_files_are_named_for_what_they_hold():
    assert [path for path in PYTHON_FILES if EMPTY_NAMES & set(Path(path).with_suffix("").parts)] == []


def test_no_file_names_a_package_registry():
    assert [str(path) for path, text in text_files() if REGISTRY_HOST.search(text)] == []


def test_processes_of_blender_open_no_console_window():
    """`popen_options` keeps Windows from it. A verb has a console already, and what it starts prints there."""
    calls, bare = 0, []
    for file in sorted((ROOT / "fdda_addon").rglob("*.py")):
        if "cli" in file.parts:
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in {f"subprocess.{n}" for n in NEW_PROCESS}:
                calls += 1
                if not any(k.arg is None and ast.unparse(k.value).startswith("popen_options(") for k in node.keywords):
                    bare.append(f"{file.relative_to(ROOT).as_posix()}:{node.lineno}")
    assert calls > 4 and bare == []
