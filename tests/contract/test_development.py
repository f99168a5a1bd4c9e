# SPDX-License-Identifier: GPL-3.0-or-later
"""The pages name files and functions that exist; that for developers names every package, thread, timer and handler."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from .layers import ADDON, LAYERS, ROOT, module_of, package_of

PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
DEVELOPMENT = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")
MAP = (ROOT / "docs" / "pictures" / "map.svg").read_text(encoding="utf-8")
PATH = r"(?:fdda_addon|trainer|tests|benchmarks|blend_fixtures|examples|setup|docs)/[\w./-]*"
TIMERS = r"timers\.register\(|event_timer_add\("
HANDLERS = r"draw_handler_add\(|draw_handler_add$|bpy\.app\.handlers\b|atexit\.register\(|signal\.signal\("
THREADS = r"Thread\(|ThreadPoolExecutor\(|subprocess\.(?:run|Popen)\("


def chapter(name: str) -> str:
    """The text of a chapter of the page."""
    return DEVELOPMENT.partition(f"\n## {name}\n")[2].partition("\n## ")[0]


def defined(file: Path) -> set[str]:
    """What a module defines, `name` and `Class.name`."""
    found = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        for name in _names(node):
            found.add(name)
            if isinstance(node, ast.ClassDef):
                found |= {f"{name}.{inner}" for statement in node.body for inner in _names(statement)}
    return found


def _names(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        yield node.name
    elif isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        yield from (name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_path_that_a_page_names_exists(page: Path):
    paths = set(re.findall(rf"(?<![\w/.-]){PATH}", page.read_text(encoding="utf-8")))
    paths |= set(re.findall(r"`(\w+/[\w/]+\.py)`", page.read_text(encoding="utf-8")))
    assert [path for path in sorted(paths) if not (ROOT / path.rstrip(".")).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_name_that_a_page_places_in_a_file_is_there(page: Path):
    wrong = []
    for path, names in re.findall(rf"`({PATH}\.py)`\s+\((`[^)]*`)\)", page.read_text(encoding="utf-8")):
        known = defined(ROOT / path)
        wrong += [f"{path} has no {name}" for name in re.findall(r"`([\w.]+)`", names) if name not in known]
    assert wrong == []


def test_the_path_of_a_pose_is_named_by_functions():
    assert len(re.findall(rf"`{PATH}\.py`\s+\(`", chapter("The path of a pose"))) > 25


def test_every_package_is_on_the_page_and_in_the_picture():
    packages = [package for layer in LAYERS for package in layer]
    assert [package for package in packages if f"`{package}`" not in chapter("Layers")] == []
    drawn = re.findall(r"<!-- (.+?) -->", MAP)
    assert [package for package in packages if package not in drawn] == [], "draw it again: make map"


def test_every_package_that_the_page_names_is_in_a_layer():
    named = re.findall(r"`([\w.]+)`", "".join(re.findall(r"^\| (`[^|]+) \|", chapter("Layers"), re.MULTILINE)))
    assert [name for name in named if package_of(name) != name] == []


def test_every_thread_timer_and_handler_is_in_the_table():
    table = chapter("Threads, timers and handlers")
    missing = []
    for file in sorted([*ADDON.rglob("*.py"), *(ROOT / "trainer").rglob("*.py")]):
        text = file.read_text(encoding="utf-8")
        if re.search(f"{TIMERS}|{HANDLERS}|{THREADS}", text, re.MULTILINE):
            rows = [row for row in table.splitlines() if f"`{file.relative_to(ROOT).as_posix()}`" in row]
            names = [name for name in _handlers(text) if not any(f"`{name}`" in row for row in rows)]
            missing += [module_of(file)] * (not rows) + [f"{module_of(file)}: {name}" for name in names]
    assert missing == []


def test_every_file_in_that_table_has_one():
    rows = "\n".join(row for row in chapter("Threads, timers and handlers").splitlines() if row.startswith("|"))
    for path in re.findall(rf"`({PATH}\.py)`", rows):
        text = (ROOT / path).read_text(encoding="utf-8")
        assert re.search(f"{TIMERS}|{HANDLERS}|{THREADS}", text, re.MULTILINE), path


def _handlers(text: str) -> Iterator[str]:
    """The handlers of Blender's that a module has in its table."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).startswith("HANDLERS"):
            keys = node.value.keys if isinstance(node.value, ast.Dict) else [node.targets[0].slice]
            yield from (key.value for key in keys)
