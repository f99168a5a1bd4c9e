# SPDX-License-Identifier: GPL-3.0-or-later
"""The documentation names only existing files and functions; docs/development.md names all packages and handlers."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from .layers import LAYERS, ROOT

PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
DEVELOPMENT = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")
PATH_PATTERN = r"(?:fdda_addon|trainer|tests|benchmarks|blend_fixtures|examples|setup|docs)/[\w./-]*"
TIMER_PATTERN = r"timers\.register\(|event_timer_add\("
HANDLER_PATTERN = r"draw_handler_add\(|draw_handler_add$|bpy\.app\.handlers\b|atexit\.register\(|signal\.signal\("
THREAD_PATTERN = r"Thread\(|ThreadPoolExecutor\(|subprocess\.(?:run|Popen)\(|\._popen\("


def chapter_text(name: str) -> str:
    """Return the text of a chapter of docs/development.md."""
    return DEVELOPMENT.partition(f"\n## {name}\n")[2].partition("\n## ")[0]


def defined_names(file: Path) -> set[str]:
    """Return the names that a module defines at its top level, and `Class.name` of its classes."""
    names = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        for name in _assigned_names(node):
            names.add(name)
            if isinstance(node, ast.ClassDef):
                names |= {f"{name}.{member}" for statement in node.body for member in _assigned_names(statement)}
    return names


def _assigned_names(node: ast.stmt) -> Iterator[str]:
    """Yield the names that a statement defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        yield node.name
    elif isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        yield from (name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_paths_in_the_documentation_exist(page: Path):
    paths = set(re.findall(rf"(?<![\w/.-]){PATH_PATTERN}", page.read_text(encoding="utf-8")))
    paths |= set(re.findall(r"`(\w+/[\w/]+\.py)`", page.read_text(encoding="utf-8")))
    assert [path for path in sorted(paths) if not (ROOT / path.rstrip(".")).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_in_the_documentation_are_defined_in_their_files(page: Path):
    undefined_names = []
    for path, names in re.findall(rf"`({PATH_PATTERN}\.py)`\s+\((`[^)]*`)\)", page.read_text(encoding="utf-8")):
        names_of_file = defined_names(ROOT / path)
        undefined_names += [
            f"{path} has no {name}" for name in re.findall(r"`([\w.]+)`", names) if name not in names_of_file
        ]
    assert undefined_names == []


def test_every_package_is_in_the_text():
    packages = [package for layer in LAYERS for package in layer]
    assert [package for package in packages if f"`{package}`" not in chapter_text("Layers")] == []


def test_the_diagrams_are_drawn_from_the_layers_and_the_table_of_transitions():
    command = [sys.executable, str(ROOT / "docs" / "pictures" / "make_diagrams.py")]
    drawn = subprocess.run([*command, "-"], input=DEVELOPMENT, capture_output=True, text=True, check=True).stdout
    assert drawn == DEVELOPMENT, "The diagrams are outdated; draw them with `make map`."
