# SPDX-License-Identifier: GPL-3.0-or-later
"""Every name that a module imports from another one of ours is defined there, also inside functions that no test may
reach: there is one route to each name."""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("fdda_addon", "trainer", "farm", "tests", "benchmarks", "blend_fixtures")


@functools.cache
def names_of(file: Path) -> set[str]:
    """The names that a module defines at its top level, submodules of a package included; not those it imports.

    Args:
        file: a module, or a folder of modules that is no package.
    """
    if file.is_dir():
        return {path.stem for path in file.iterdir()}
    found = {path.stem for path in file.parent.iterdir()} if file.name == "__init__.py" else set()
    for node in _top_level(ast.parse(file.read_text(encoding="utf-8")).body):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif not isinstance(node, ast.Import | ast.ImportFrom):
            found |= {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
    return found


def _top_level(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    for node in body:
        if isinstance(node, ast.If | ast.Try | ast.With):
            yield from _top_level([*node.body, *getattr(node, "orelse", [])])
        else:
            yield node


def missing(file: Path) -> Iterator[str]:
    """What a file imports from modules of ours that do not have it."""
    package = file.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom):
            continue
        base = package[: len(package) - node.level + 1] if node.level else ()
        target = ROOT.joinpath(*base, *(node.module.split(".") if node.module else ()))
        candidates = (target.with_suffix(".py"), target / "__init__.py", target)
        source = next((path for path in candidates if path.exists()), None)
        if source is None or source.relative_to(ROOT).parts[0] not in PACKAGES:
            if node.level:
                yield f"{file.relative_to(ROOT)}:{node.lineno} {node.module}"
            continue
        known = names_of(source)
        yield from (f"{file.relative_to(ROOT)}:{node.lineno} {a.name}" for a in node.names if a.name not in known)


def test_every_name_that_is_imported_is_defined_there():
    files = [file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))]
    assert len(files) > 100
    assert [wrong for file in files for wrong in missing(file)] == []


def test_tests_import_each_other_relatively():
    """By its bare name a module is another one in each tier, and pytest alone would find only the first."""
    bare = []
    for file in (ROOT / "tests").rglob("*/*.py"):
        beside = {path.stem for path in file.parent.glob("*.py")} if (file.parent / "__init__.py").exists() else set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and not node.level and node.module in beside:
                bare.append(f"{file.relative_to(ROOT)}:{node.lineno} {node.module}")
    assert bare == [], "write: from .module import name"
