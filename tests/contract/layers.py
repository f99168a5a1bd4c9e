# SPDX-License-Identifier: GPL-3.0-or-later
"""The layers of fdda_addon and its import graph, read from the code. docs/development.md shows them."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ADDON = ROOT / "fdda_addon"

LAYERS: tuple[tuple[str, ...], ...] = (
    ("__init__", "__main__"),
    ("cli",),
    ("registration",),
    ("panels",),
    ("operators",),
    ("properties",),
    ("models", "baking", "fast_rig"),
    ("recording", "evaluation", "timing"),
    ("training", "runtime", "jobs"),
    ("rig",),
    ("poses", "arm"),
    ("scene",),
    ("core.checks",),
    ("core.recording",),
    ("core.formats",),
    ("core.sentences",),
    ("core.mathematics", "core.files"),
    ("core",),
)
"""From the top down. A file imports from its own package and lower layers, not from other packages of its layer."""


TRAINER_LAYERS: tuple[tuple[str, ...], ...] = (
    ("__main__",),
    ("train",),
    ("report",),
    ("export",),
    ("compression", "model"),
    ("networks",),
    ("preparation",),
    ("inputs",),
    ("skin",),
    ("fits",),
    ("data",),
    ("config", "device", "goal", "graph_builder", "outputs", "process"),
    ("progress",),
)
"""The folders and root files of trainer/ from the top down. Each imports from its own folder and lower layers."""


def package_of(module_name: str) -> str:
    """Return the package of a module: "core.recording" for "core.recording.index", "__init__" for ""."""
    layer_packages = [package for layer in LAYERS for package in layer]
    return max(
        (package for package in layer_packages if f"{module_name}.".startswith(f"{package}.")),
        key=len,
        default=module_name or "__init__",
    )


def module_of(file: Path) -> str:
    """Return the dotted module name of a file, "fdda_addon.core.rig"; an `__init__.py` has the name of its folder."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imported_names(file: Path) -> Iterator[str]:
    """Yield the absolute dotted name of each import of a file, also of imports inside functions."""
    package = list(file.relative_to(ROOT).with_suffix("").parts[:-1])
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base += node.module.split(".") if node.module else []
            # The last part is a module in `from . import name`; elsewhere it may be a class, which is harmless.
            yield from (".".join([*base, alias.name]) for alias in node.names)


def import_graph(folder: str) -> dict[str, set[str]]:
    """Return, for each module of a folder, the modules of the same folder that it imports."""
    files = {module_of(file): file for file in (ROOT / folder).rglob("*.py")}
    graph: dict[str, set[str]] = {}
    for module, file in files.items():
        imported_modules = (name if name in files else name.rpartition(".")[0] for name in imported_names(file))
        graph[module] = {name for name in imported_modules if name in files and name != module}
    return graph


def package_graph() -> dict[str, set[str]]:
    """Return, for each package of fdda_addon, the packages from which it imports."""
    graph: dict[str, set[str]] = {package: set() for layer in LAYERS for package in layer}
    for module, imported in import_graph("fdda_addon").items():
        package = _package(module)
        graph.setdefault(package, set()).update({_package(name) for name in imported} - {package})
    return graph


def _package(module: str) -> str:
    return package_of(module.removeprefix("fdda_addon").lstrip("."))
