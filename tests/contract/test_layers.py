# SPDX-License-Identifier: GPL-3.0-or-later
"""The layer rule, read from the imports: who may import whom, and which packages each layer may use.

Imports inside functions count too: a rule that a late import gets around is no rule.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

STANDARD = sys.stdlib_module_names
BLENDER = {"bpy", "bpy_extras", "mathutils", "bmesh", "gpu", "gpu_extras", "blf", "idprop"}

# The layers of fdda_addon, lowest first. A module may import from its own layer and from those below; whatever is in
# no other layer (recording, training, evaluation, runtime, arm, …) does the work: WORK.
LAYERS = (
    {"core"},
    {"scene"},
    (WORK := set()),
    {"settings", "properties", "preferences", "operators"},
    {"panels", "cli", "demo", "__main__", "__init__"},
)


def imported_names(file: Path) -> Iterator[str]:
    """Absolute dotted names of everything that a file imports, relative imports resolved."""
    package = list(file.relative_to(ROOT).with_suffix("").parts[:-1])
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base += node.module.split(".") if node.module else []
            # `from . import name` imports the module name; elsewhere the last part may be a class, which does no harm.
            yield from (".".join([*base, alias.name]) for alias in node.names)


def unit_of(name: str) -> str:
    """The part of fdda_addon that a dotted name belongs to: 'core', 'recording', …, or '__init__'."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def layer_of(unit: str) -> int:
    return next((index for index, units in enumerate(LAYERS) if unit in units), LAYERS.index(WORK))


def python_files(folder: str) -> list[Path]:
    files = sorted(file for file in (ROOT / folder).rglob("*.py") if "node_modules" not in file.parts)
    assert files, f"{folder} has no Python files: the rule would hold for nothing"
    return files


def foreign_imports(folder: str, allowed: set[str]) -> list[str]:
    """Imports of packages outside the standard library that are not `allowed`."""
    return [
        f"{file.relative_to(ROOT)} imports {name}"
        for file in python_files(folder)
        for name in imported_names(file)
        if name.split(".")[0] not in STANDARD | allowed
    ]


def test_core_uses_numpy_and_the_standard_library():
    assert foreign_imports("fdda_addon/core", {"numpy", "fdda_addon"}) == []


def test_the_addon_uses_what_blender_and_the_extension_bring():
    assert foreign_imports("fdda_addon", {"numpy", "onnxruntime", "fdda_addon"} | BLENDER) == []


def test_the_trainer_needs_no_blender():
    allowed = {"numpy", "torch", "onnx", "onnxruntime", "matplotlib", "scipy", "trainer", "fdda_addon"}
    assert foreign_imports("trainer", allowed) == []


def test_the_trainer_uses_only_the_core_of_the_addon():
    names = [(file.name, name) for file in python_files("trainer") for name in imported_names(file)]
    assert [pair for pair in names if pair[1].startswith("fdda_addon") and unit_of(pair[1]) != "core"] == []


def test_the_examples_need_nothing_of_ours():
    assert foreign_imports("examples", {"numpy", "onnxruntime"}) == []


def test_imports_in_the_addon_point_one_way():
    wrong = []
    for file in python_files("fdda_addon"):
        unit = file.relative_to(ROOT / "fdda_addon").parts[0].removesuffix(".py")
        for name in imported_names(file):
            if name.startswith("fdda_addon") and layer_of(unit_of(name)) > layer_of(unit):
                wrong.append(f"{file.relative_to(ROOT)} imports {name}, of a layer above")
    assert wrong == []


def test_parts_of_the_addon_do_not_import_in_a_circle():
    graph: dict[str, set[str]] = {}
    for file in python_files("fdda_addon"):
        unit = file.relative_to(ROOT / "fdda_addon").parts[0].removesuffix(".py")
        imported = {unit_of(name) for name in imported_names(file) if name.startswith("fdda_addon")}
        graph.setdefault(unit, set()).update(imported - {unit})
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_the_addon_imports_itself_relatively():
    """Installed as an extension it is called bl_ext.user_default.fdda.fdda_addon."""
    absolute = []
    for file in python_files("fdda_addon"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names.append(node.module)
            absolute += [f"{file.relative_to(ROOT)} imports {name}" for name in names if name.startswith("fdda_addon")]
    assert absolute == []


def test_the_addon_and_its_core_import_without_blender():
    modules = ["fdda_addon"] + [f"fdda_addon.core.{file.stem}" for file in python_files("fdda_addon/core")]
    blocked = f"import sys; sys.modules.update(dict.fromkeys({sorted(BLENDER)}))"
    command = [sys.executable, "-c", f"{blocked}\nimport {', '.join(modules)}"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_importing_the_addon_costs_nothing():
    code = "import sys, fdda_addon; print(sorted({'numpy', 'onnxruntime', 'bpy'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_ctrl_c_waits_in_every_module_whose_functions_blender_calls():
    """Blender prints what leaves a handler and goes on: a Ctrl-C that is raised there is lost."""
    handlers = {
        ".".join(file.relative_to(ROOT / "fdda_addon").with_suffix("").parts)
        for file in python_files("fdda_addon")
        if re.search(r"^@persistent$", file.read_text(), re.MULTILINE)
    }
    text = (ROOT / "fdda_addon/cli/interruption.py").read_text()
    assert handlers and [name for name in sorted(handlers) if f'"{name}"' not in text] == []
