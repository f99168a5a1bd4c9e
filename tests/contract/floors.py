# SPDX-License-Identifier: GPL-3.0-or-later
"""The floors of fdda_addon, and who imports whom, read from the code. docs/development.md draws it."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ADDON = ROOT / "fdda_addon"

FLOORS: tuple[tuple[str, ...], ...] = (
    ("__init__", "__main__"),
    ("cli",),
    ("registration",),
    ("panels",),
    ("operators",),
    ("properties",),
    ("models", "timing", "baking"),
    ("recording", "evaluation"),
    ("training", "runtime", "jobs"),
    ("rig",),
    ("poses", "arm"),
    ("scene",),
    ("core.checks",),
    ("core.recording",),
    ("core",),
)
"""From the top down. A file imports from its own room and from floors below, not from another room of its floor."""


def room_of(name: str) -> str:
    """The room of a dotted name below fdda_addon: "core.recording" for "core.recording.index", "__init__" for ""."""
    rooms = [room for floor in FLOORS for room in floor]
    return max((room for room in rooms if f"{name}.".startswith(f"{room}.")), key=len, default=name or "__init__")


def module_of(file: Path) -> str:
    """The dotted name of a file below the repository, "fdda_addon.core.rig"; of a package that of its folder."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imported_names(file: Path) -> Iterator[str]:
    """Absolute dotted names of everything that a file imports, relative imports resolved, inside functions as well."""
    package = list(file.relative_to(ROOT).with_suffix("").parts[:-1])
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base += node.module.split(".") if node.module else []
            # `from . import name` imports the module name; elsewhere the last part may be a class, which does no harm.
            yield from (".".join([*base, alias.name]) for alias in node.names)


def import_graph(folder: str) -> dict[str, set[str]]:
    """The modules of a folder, each with those of the folder that it imports."""
    files = {module_of(file): file for file in (ROOT / folder).rglob("*.py")}
    graph: dict[str, set[str]] = {}
    for module, file in files.items():
        found = (name if name in files else name.rpartition(".")[0] for name in imported_names(file))
        graph[module] = {name for name in found if name in files and name != module}
    return graph


def room_graph() -> dict[str, set[str]]:
    """The rooms of fdda_addon, each with those that it imports from."""
    graph: dict[str, set[str]] = {room: set() for floor in FLOORS for room in floor}
    for module, imported in import_graph("fdda_addon").items():
        room = _room(module)
        graph.setdefault(room, set()).update({_room(name) for name in imported} - {room})
    return graph


def _room(module: str) -> str:
    return room_of(module.removeprefix("fdda_addon").lstrip("."))
