# SPDX-License-Identifier: GPL-3.0-or-later
"""Imports follow the layers: which package may import which, and which third-party packages each layer may use.

Imports inside functions are checked too.
"""

import ast
import os
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from .. import systems
from .layers import ADDON, LAYERS, ROOT, TRAINER_LAYERS, import_graph, imported_names, module_of, package_graph

STANDARD_LIBRARY = sys.stdlib_module_names
BLENDER_MODULES = {"bpy", "bpy_extras", "mathutils", "bmesh", "gpu", "gpu_extras", "blf", "idprop", "pxr"}


def python_files(folder: str) -> list[Path]:
    """Return the Python files in a folder of the repository, of which there must be some."""
    files = sorted(file for file in (ROOT / folder).rglob("*.py") if "node_modules" not in file.parts)
    assert files, f"{folder} has no Python files, so nothing would be checked."
    return files


def forbidden_imports(folder: str, allowed: set[str]) -> list[str]:
    """Return the imports of a folder that are neither of the standard library nor `allowed`."""
    return [
        f"{file.relative_to(ROOT)} imports {name}"
        for file in python_files(folder)
        for name in imported_names(file)
        if name.split(".")[0] not in STANDARD_LIBRARY | allowed
    ]


TRAINER_PACKAGES = {"numpy", "torch", "onnx", "onnxruntime", "scipy", "jinja2", "trainer", "fdda_addon"}


@pytest.mark.parametrize(
    ("folder", "packages"),
    [
        ("fdda_addon/core", {"numpy", "fdda_addon"}),
        # The Python of the training environment runs the file that imports pip.
        ("fdda_addon", {"numpy", "onnxruntime", "fdda_addon", "pip"} | BLENDER_MODULES),
        ("trainer", TRAINER_PACKAGES),
        ("examples", {"numpy", "onnxruntime", "bpy"}),
        ("farm", {"fdda_addon"}),
    ],
)
def test_a_folder_imports_only_these_packages(folder, packages):
    assert forbidden_imports(folder, packages) == []


def test_the_trainer_uses_only_the_core_of_the_addon():
    names = [(file.name, name) for file in python_files("trainer") for name in imported_names(file)]
    assert [
        pair for pair in names if f"{pair[1]}.".startswith("fdda_addon.") and "fdda_addon.core." not in pair[1]
    ] == []


def test_imports_of_the_trainer_point_down_its_layers():
    layer_of = {unit: index for index, layer in enumerate(TRAINER_LAYERS) for unit in layer}
    upward_imports, units = [], set()
    for module, imported in import_graph("trainer").items():
        for name in imported - {"trainer"}:
            unit, imported_unit = (dotted.split(".")[1] for dotted in (module, name))
            units |= {unit, imported_unit}
            if unit != imported_unit and layer_of[unit] >= layer_of[imported_unit]:
                upward_imports.append(f"{module} imports {name}")
    assert upward_imports == []
    assert units == set(layer_of), "TRAINER_LAYERS names folders that do not exist, or lacks some."


def test_the_steps_of_the_farm_use_only_the_core_of_the_addon():
    names = {name for file in python_files("farm") for name in imported_names(file) if name.startswith("fdda_addon")}
    assert names and [name for name in sorted(names) if not name.startswith("fdda_addon.core.")] == []


def run_verb_without_blender(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a verb in a Python without bpy, with a script that prints "the trainer" as the trainer's Python."""
    trainer_script = folder / ("python.cmd" if systems.WINDOWS else "python")
    trainer_script.write_text("@echo the trainer\n" if systems.WINDOWS else "#!/bin/sh\necho the trainer\n")
    trainer_script.chmod(0o755)
    block_code = f"import sys; sys.modules.update(dict.fromkeys({sorted(BLENDER_MODULES)}))"
    call_code = f"from fdda_addon.cli.main import main; sys.exit(main({list(arguments)}, 'fdda'))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "FDDA_TRAINER_PYTHON": str(trainer_script)}
    command = [sys.executable, "-c", f"{block_code}\n{call_code}"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_the_trainer_is_started_without_blender(tmp_path):
    result = run_verb_without_blender(tmp_path, "train", "--help")
    assert result.returncode == 0 and result.stdout.startswith("the trainer\n"), result.stderr


def test_every_file_of_the_addon_is_in_a_package():
    packages = {package for layer in LAYERS for package in layer}
    assert set(package_graph()) == packages


def test_imports_in_the_addon_point_down():
    layer_of = {package: layer_index for layer_index, layer in enumerate(LAYERS) for package in layer}
    violations = [
        f"{package} imports from {imported_package}, which is not below it"
        for package, imported in package_graph().items()
        for imported_package in imported
        if layer_of[imported_package] <= layer_of[package]
    ]
    assert violations == []


@pytest.mark.parametrize("folder", ["fdda_addon", "trainer", "farm"])
def test_files_have_no_circular_imports(folder):
    try:
        TopologicalSorter(import_graph(folder)).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_package_files_import_nothing():
    """Importing a module also imports the `__init__.py` of its package."""
    importing_packages = [
        module
        for module, imported in import_graph("fdda_addon").items()
        if (ROOT / Path(*module.split("."))).is_dir() and imported and module != "fdda_addon"
    ]
    assert importing_packages == []


def test_the_addon_imports_itself_relatively():
    """As an installed extension, the package has the name bl_ext.user_default.fdda.fdda_addon."""
    absolute_imports = []
    for file in python_files("fdda_addon"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names.append(node.module)
            absolute_imports += [
                f"{file.relative_to(ROOT)} imports {name}" for name in names if name.startswith("fdda_addon")
            ]
    assert absolute_imports == []


def test_the_addon_and_its_core_import_without_blender():
    files = [ROOT / "fdda_addon/__init__.py", *python_files("fdda_addon/core")]
    modules = [module_of(file) for file in files]
    block_code = f"import sys; sys.modules.update(dict.fromkeys({sorted(BLENDER_MODULES)}))"
    command = [sys.executable, "-c", f"{block_code}\nimport {', '.join(modules)}"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_importing_the_addon_imports_no_large_package():
    code = "import sys, fdda_addon; print(sorted({'numpy', 'onnxruntime', 'bpy'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_only_registration_adds_handlers():
    """A handler that is added elsewhere would not be removed with the add-on, and would swallow a Ctrl-C."""
    files_with_handlers = {
        file.relative_to(ADDON).as_posix()
        for file in python_files("fdda_addon")
        if "getattr(bpy.app.handlers" in file.read_text()
    }
    assert files_with_handlers == {"registration.py"}
    assert [
        str(file)
        for file in python_files("fdda_addon")
        if re.search(r"app\.handlers\.\w+\.(append|insert|remove)", file.read_text())
        # These files run in a Blender of their own, which ends with them.
        and file.relative_to(ADDON).as_posix() not in {"evaluation/video.py", "baking/export.py"}
    ] == []
