# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders that hold a recording, or a model, for each of several meshes."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..core.errors import FDDAError, ModelError, OutputError
from ..core.model import read_model_info
from ..scene.scene_rig import SceneRig, find_rig
from .files import open_file


def mesh_folders(rigs: Sequence[SceneRig], folder: Path) -> list[tuple[SceneRig, Path]]:
    """A folder of its own for each mesh, named as its object.

    Raises:
        OutputError: two would have the same name.
    """
    taken: dict[str, str] = {}
    found = []
    for scene_rig in rigs:
        name = scene_rig.mesh_object.name
        clean = bpy.path.clean_name(name)
        # Some disks do not tell small letters from capital ones.
        if (other := taken.setdefault(clean.lower(), name)) != name:
            raise OutputError(
                f"'{other}' and '{name}' would both be recorded into '{folder / clean}'; rename one of them."
            )
        found.append((scene_rig, folder / clean))
    return found


def open_rigs(options: argparse.Namespace) -> dict[str, tuple[SceneRig, Path]]:
    """Open a file, and find the rig of its model; of each where `options.model` is a folder, or of that of one object.

    Returns:
        Rig and model by the name of the object; under "" where the model is one file.

    Raises:
        FDDAError: as `open_rig`; a model of the folder does not say of which object it is, or the file lacks that.
    """
    if not options.model.is_dir():
        open_file(options.rig)
        return {"": (find_rig(options.object), options.model)}
    models = _models_of_objects(options.model)
    if options.object and options.object not in models:
        names = ", ".join(f"'{name}'" for name in models)
        raise ModelError(f"'{options.model}' has no model of '{options.object}'; it has those of {names}.")
    open_file(options.rig)
    if options.object:
        return {"": (find_rig(options.object), models[options.object])}
    found = {}
    for name, model in models.items():
        scene_object = bpy.context.scene.objects.get(name)
        if scene_object is None or scene_object.type != "MESH":
            raise FDDAError(
                f"'{model}' is a model of the object '{name}', and '{options.rig}' has no mesh object of that name; "
                "rename the object as it was, or use the models of the folder one by one."
            )
        found[name] = find_rig(name), model
    return found


def by_object(values: dict[str, dict]) -> dict:
    """What is written as JSON about the rigs of `open_rigs`, by their names: one alone is not told from others."""
    return values.get("", {"objects": values})


def headed(name: str, text: str) -> str:
    """Text about one of the rigs of `open_rigs`."""
    return f"'{name}':\n{text}" if name else text


def _models_of_objects(folder: Path) -> dict[str, Path]:
    """The models in a folder and the folders in it, by the name of their object."""
    paths = sorted([*folder.glob("*.onnx"), *folder.glob("*/*.onnx")])
    if not paths:
        raise ModelError(f"The folder '{folder}' holds no model; give one that train made of several recordings.")
    found: dict[str, Path] = {}
    for path in paths:
        name = read_model_info(path).object_name
        if not name:
            raise ModelError(f"'{path}' does not say of which object it is; give it by itself, with --object NAME.")
        if name in found:
            raise ModelError(f"'{found[name]}' and '{path}' are both models of '{name}'; remove one of them.")
        found[name] = path
    return found
