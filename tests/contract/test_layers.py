# SPDX-License-Identifier: GPL-3.0-or-later
"""The layer rule, read from the imports: who may import whom, and which packages each layer may use.

Imports inside functions count too: a rule that a late import gets around is no rule.
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
from .layers import ADDON, LAYERS, ROOT, import_graph, imported_names, module_of, package_graph

STANDARD = sys.stdlib_module_names
BLENDER = {"bpy", "bpy_extras", "mathutils", "bmesh", "gpu", "gpu_extras", "blf", "idprop", "pxr"}


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
    assert [
        pair for pair in names if f"{pair[1]}.".startswith("fdda_addon.") and "fdda_addon.core." not in pair[1]
    ] == []


def test_the_farm_needs_no_blender_and_only_its_engine_needs_dask():
    allowed = {"dask", "distributed", "fdda_addon", "farm"}
    assert foreign_imports("farm", allowed) == []
    importing = {file.name for file in python_files("farm") for name in imported_names(file) if "distributed" in name}
    assert importing == {"cluster.py"}


def test_the_farm_uses_only_the_core_of_the_addon():
    names = {name for file in python_files("farm") for name in imported_names(file) if name.startswith("fdda_addon")}
    assert names and [name for name in sorted(names) if not name.startswith("fdda_addon.core.")] == []


@pytest.mark.skipif(systems.WINDOWS, reason="The farm does not run on Windows.")
def test_importing_the_farm_needs_no_dask():
    """`farm --task` runs on the workers of other engines, and the add-on's verb starts it only when it is asked to."""
    modules = [module_of(file) for file in python_files("farm") if file.name != "__main__.py"]
    blocked = f"import sys; sys.modules.update(dict.fromkeys({sorted(BLENDER | {'dask', 'distributed', 'torch'})}))"
    command = [sys.executable, "-c", f"{blocked}\nimport {', '.join(modules)}"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def without_blender(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a verb in a Python that has no bpy; the trainer's Python is one that says its name and nothing else."""
    trainer = folder / ("python.cmd" if systems.WINDOWS else "python")
    trainer.write_text("@echo the trainer\n" if systems.WINDOWS else "#!/bin/sh\necho the trainer\n")
    trainer.chmod(0o755)
    blocked = f"import sys; sys.modules.update(dict.fromkeys({sorted(BLENDER)}))"
    call = f"from fdda_addon.cli.main import main; sys.exit(main({list(arguments)}, 'fdda'))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "FDDA_TRAINER_PYTHON": str(trainer)}
    command = [sys.executable, "-c", f"{blocked}\n{call}"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_shards_are_merged_without_blender(tmp_path):
    done = without_blender(tmp_path, "merge-recordings", "no", "out")
    assert done.returncode == 1
    assert done.stderr == "Error: 'no' is not a recording: it has no recording.json; make one with record.\n"


def test_a_training_is_started_without_blender(tmp_path):
    done = without_blender(tmp_path, "train", "--help")
    assert done.returncode == 0 and done.stdout.startswith("the trainer\n"), done.stderr


def test_the_examples_need_nothing_of_ours():
    assert foreign_imports("examples", {"numpy", "onnxruntime", "bpy"}) == []


def test_every_file_of_the_addon_is_in_a_package():
    packages = {package for layer in LAYERS for package in layer}
    assert set(package_graph()) == packages


def test_imports_in_the_addon_point_down():
    layer_of = {package: number for number, layer in enumerate(LAYERS) for package in layer}
    wrong = [
        f"{package} imports from {other}, which is not below it"
        for package, imported in package_graph().items()
        for other in imported
        if layer_of[other] <= layer_of[package]
    ]
    assert wrong == []


@pytest.mark.parametrize("folder", ["fdda_addon", "trainer", "farm"])
def test_files_do_not_import_in_a_circle(folder):
    try:
        TopologicalSorter(import_graph(folder)).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_only_registration_and_entry_points_are_loose():
    assert sorted(file.name for file in ADDON.glob("*.py")) == ["__init__.py", "__main__.py", "registration.py"]


def test_packages_are_docstrings_and_lists_of_modules():
    """What a package's file imports is imported with any of its modules: Blender starts without numpy."""
    heavy = [
        module
        for module, imported in import_graph("fdda_addon").items()
        if (ROOT / Path(*module.split("."))).is_dir() and imported and module != "fdda_addon"
    ]
    assert heavy == []


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
    files = [ROOT / "fdda_addon/__init__.py", *python_files("fdda_addon/core")]
    modules = [module_of(file) for file in files]
    blocked = f"import sys; sys.modules.update(dict.fromkeys({sorted(BLENDER)}))"
    command = [sys.executable, "-c", f"{blocked}\nimport {', '.join(modules)}"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_importing_the_addon_costs_nothing():
    code = "import sys, fdda_addon; print(sorted({'numpy', 'onnxruntime', 'bpy'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_only_registration_adds_handlers():
    """What is added elsewhere is in no table: nothing removes it, and a Ctrl-C that strikes there is lost."""
    users = {
        f.relative_to(ADDON).as_posix()
        for f in python_files("fdda_addon")
        if "getattr(bpy.app.handlers" in f.read_text()
    }
    assert users == {"registration.py"}
    assert [
        str(file)
        for file in python_files("fdda_addon")
        if re.search(r"app\.handlers\.\w+\.(append|insert|remove)", file.read_text())
    ] == []


def test_one_file_reads_and_writes_arrays_of_blender():
    """There their type and shape are stated and checked; elsewhere Blender would convert them, or take half of them."""
    files = [file for file in python_files("fdda_addon") if "foreach_" in file.read_text("utf-8")]
    found = {file.relative_to(ADDON).as_posix() for file in files}
    assert found == {"scene/arrays.py"}
