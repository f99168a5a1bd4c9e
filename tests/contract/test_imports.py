# SPDX-License-Identifier: GPL-3.0-or-later
"""Every name that a module imports from another module of this project is defined there.

Imports inside functions are checked too, also where no test executes them. Names that a module only imports itself
do not count, so each name has one location.
"""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("fdda_addon", "trainer", "farm", "tests", "benchmarks", "blend_fixtures")


@functools.cache
def defined_names(file: Path) -> set[str]:
    """Return the names that a module defines at its top level, including submodules of a package, without its imports.

    Args:
        file: a module, or a folder of modules that is not a package.
    """
    if file.is_dir():
        return {path.stem for path in file.iterdir()}
    names = {path.stem for path in file.parent.iterdir()} if file.name == "__init__.py" else set()
    for node in _top_level_statements(ast.parse(file.read_text(encoding="utf-8")).body):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif not isinstance(node, ast.Import | ast.ImportFrom):
            names |= {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
    return names


def _top_level_statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield the statements of a module that are not in functions or classes, also those below if, try and with."""
    for node in body:
        if isinstance(node, ast.If | ast.Try | ast.With):
            yield from _top_level_statements([*node.body, *getattr(node, "orelse", [])])
        else:
            yield node


def undefined_imports(file: Path) -> Iterator[str]:
    """Yield the imports of a file from modules of this project that do not define the imported name."""
    package = file.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom):
            continue
        base = package[: len(package) - node.level + 1] if node.level else ()
        target_path = ROOT.joinpath(*base, *(node.module.split(".") if node.module else ()))
        candidates = (target_path.with_suffix(".py"), target_path / "__init__.py", target_path)
        source = next((path for path in candidates if path.exists()), None)
        if source is None or source.relative_to(ROOT).parts[0] not in PACKAGES:
            if node.level:
                yield f"{file.relative_to(ROOT)}:{node.lineno} {node.module}"
            continue
        names = defined_names(source)
        yield from (f"{file.relative_to(ROOT)}:{node.lineno} {a.name}" for a in node.names if a.name not in names)


def test_imported_names_are_defined_in_their_modules():
    files = [file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))]
    assert len(files) > 100
    assert [undefined_import for file in files for undefined_import in undefined_imports(file)] == []


def test_tests_import_each_other_relatively():
    """Tiers have modules of the same name, so an import by the bare name would find the module of another tier."""
    absolute_imports = []
    for file in (ROOT / "tests").rglob("*/*.py"):
        sibling_modules = (
            {path.stem for path in file.parent.glob("*.py")} if (file.parent / "__init__.py").exists() else set()
        )
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and not node.level and node.module in sibling_modules:
                absolute_imports.append(f"{file.relative_to(ROOT)}:{node.lineno} {node.module}")
    assert absolute_imports == [], "Write `from .module import name`."
