# SPDX-License-Identifier: GPL-3.0-or-later
"""Every name that a module imports from another one of ours is there, also inside functions that no test may reach."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("fdda_addon", "trainer")


def names_of(file: Path) -> set[str]:
    """The names that a module has at its top level, submodules of a package included."""
    found = {path.stem for path in file.parent.iterdir()} if file.name == "__init__.py" else set()
    for node in _top_level(ast.parse(file.read_text(encoding="utf-8")).body):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
        else:
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
        source = next((path for path in (target.with_suffix(".py"), target / "__init__.py") if path.is_file()), None)
        if source is None or source.relative_to(ROOT).parts[0] not in PACKAGES:
            if node.level:
                yield f"{file.relative_to(ROOT)}:{node.lineno} {node.module}"
            continue
        known = names_of(source)
        yield from (f"{file.relative_to(ROOT)}:{node.lineno} {a.name}" for a in node.names if a.name not in known)


def test_every_name_that_is_imported_is_there():
    files = [file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))]
    assert len(files) > 100
    assert [wrong for file in files for wrong in missing(file)] == []
