# SPDX-License-Identifier: GPL-3.0-or-later
"""The documentation names only existing files and functions; docs/development.md names all packages and handlers."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from .layers import ADDON, LAYERS, ROOT, module_of, package_of

PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
DEVELOPMENT = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")
MAP = (ROOT / "docs" / "pictures" / "map.svg").read_text(encoding="utf-8")
PATH_PATTERN = r"(?:fdda_addon|trainer|tests|benchmarks|blend_fixtures|examples|setup|docs)/[\w./-]*"
TIMER_PATTERN = r"timers\.register\(|event_timer_add\("
HANDLER_PATTERN = r"draw_handler_add\(|draw_handler_add$|bpy\.app\.handlers\b|atexit\.register\(|signal\.signal\("
THREAD_PATTERN = r"Thread\(|ThreadPoolExecutor\(|subprocess\.(?:run|Popen)\("


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


@pytest.mark.parametrize(("chapter", "steps"), [("A frame", 6), ("A recorded pose", 8), ("A training", 6)])
def test_a_pose_takes_at_most_eight_steps_which_name_functions(chapter: str, steps: int):
    text = chapter_text(chapter)
    assert len(re.findall(r"^\d\. ", text, re.MULTILINE)) == steps <= 8
    assert len(re.findall(rf"`{PATH_PATTERN}\.py`\s+\(`", text)) >= steps


def test_every_package_is_in_the_text_and_in_the_map():
    packages = [package for layer in LAYERS for package in layer]
    assert [package for package in packages if f"`{package}`" not in chapter_text("Layers")] == []
    drawn_packages = re.findall(r"<!-- (.+?) -->", MAP)
    assert [package for package in packages if package not in drawn_packages] == [], (
        "The map is outdated; draw it with `make map`."
    )


def test_documented_packages_are_in_a_layer():
    documented_packages = re.findall(
        r"`([\w.]+)`", "".join(re.findall(r"^\| (`[^|]+) \|", chapter_text("Layers"), re.MULTILINE))
    )
    assert [name for name in documented_packages if package_of(name) != name] == []


def test_threads_timers_and_handlers_are_in_the_table():
    table = chapter_text("Threads, timers and handlers")
    undocumented = []
    for file in sorted([*ADDON.rglob("*.py"), *(ROOT / "trainer").rglob("*.py")]):
        text = file.read_text(encoding="utf-8")
        if re.search(f"{TIMER_PATTERN}|{HANDLER_PATTERN}|{THREAD_PATTERN}", text, re.MULTILINE):
            rows = [row for row in table.splitlines() if f"`{file.relative_to(ROOT).as_posix()}`" in row]
            handler_names = [name for name in _handler_names(text) if not any(f"`{name}`" in row for row in rows)]
            undocumented += [module_of(file)] * (not rows) + [f"{module_of(file)}: {name}" for name in handler_names]
    assert undocumented == []


def test_files_in_the_table_have_threads_timers_or_handlers():
    rows = "\n".join(row for row in chapter_text("Threads, timers and handlers").splitlines() if row.startswith("|"))
    for path in re.findall(rf"`({PATH_PATTERN}\.py)`", rows):
        text = (ROOT / path).read_text(encoding="utf-8")
        assert re.search(f"{TIMER_PATTERN}|{HANDLER_PATTERN}|{THREAD_PATTERN}", text, re.MULTILINE), path


def _handler_names(text: str) -> Iterator[str]:
    """Yield the names of Blender's handlers in the table `HANDLERS` of a module."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).startswith("HANDLERS"):
            keys = node.value.keys if isinstance(node.value, ast.Dict) else [node.targets[0].slice]
            yield from (key.value for key in keys)


def test_the_state_diagram_is_drawn_from_the_table():
    command = [sys.executable, str(ROOT / "docs" / "pictures" / "make_states.py")]
    drawn = subprocess.run([*command, "-"], input=DEVELOPMENT, capture_output=True, text=True, check=True).stdout
    assert drawn == DEVELOPMENT, "The state diagram is outdated; draw it with `make map`."
